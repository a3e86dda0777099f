r"""The detectors that are compared, on the same streams.

With e = θ - θ̂ the residual of a model's one-step prediction, and J joints:

``naive``
    :math:`\big|\,|\Delta\theta[k]| - |\Delta\theta[k-1]|\,\big|`, the paper's rule on the naive
    prediction (no motion).
``tracking``
    :math:`|\theta^{des}[k-1-d] - \theta[k]|`, the position error that force-threshold controllers
    use (Mrva and Faigl 2015, the paper's [1]), at the lag d of the servo.
``rule``
    :math:`\big|\,|e[k]| - |e[k-1]|\,\big|`, the paper's section 3.
``ratio``
    the likelihood ratio of :mod:`adaptive_contact.model.glr`, on the residuals of any model.

A statistic has channels (joints, or windows).  Each gets the threshold that free ticks exceed with
the same small probability, by a tail fitted to free ticks; a tick's score is the largest channel
over its threshold, so that one number is swept for a ROC curve.

One state machine makes events of scores, with the rules of the tick
(:mod:`~adaptive_contact.core.detect.detector`).  A swing begins loaded: the foot may still be held
by the stance before.  It is free once the score was calm (below half the threshold) for
:data:`CALM_TICKS`, or once the command descends.  A free leg whose score passes the threshold is
reported to touch, and may be reported again after :data:`REARM_TICKS` calm ticks.  A NaN score
changes nothing.

Models are learned from the training streams of each leg-run; noise, tails, the lag of the tracking
error and the joints a rule looks at are chosen on tuning streams.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, NamedTuple, Self

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.core.detect.contact import CALM_SCORE, CALM_TICKS, REARM_TICKS
from adaptive_contact.fit.train import swing_ticks
from adaptive_contact.model import LegModel
from adaptive_contact.model.glr import stream_statistic
from adaptive_contact.model.noise import WINDOWS, NoiseModel, context, fit_noise, lagged
from adaptive_contact.model.tail import Tail, fit_tail
from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot
from adaptive_contact.robot.gait_phase import directions
from adaptive_contact.score import Events, find_swings, match, summarise
from adaptive_contact_studies.evaluate import leg_stream
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.rows import predictions

# Ticks after the command lifts off in which the foot may still be loaded: the same for all.
JUDGED_AFTER_TICKS: Final = 5
JOINTS: Final = 3
MODELS: Final = ("servo", "paper")


class Motion(NamedTuple):
    """What every detector sees of one leg, row k being control tick k."""

    measured: Array  # (n, J) rad, read at the start of tick k
    desired: Array  # (n, J) rad, written right after
    swing_tick: Ints  # (n,) ticks of the swing so far, 1 at its first, 0 in stance
    direction: Ints  # (n,) 0 where the command rises, 1 where it falls

    @property
    def judged(self) -> Mask:
        """(n,) ticks on which a detector may decide."""
        return np.asarray(self.swing_tick > JUDGED_AFTER_TICKS)


class Prediction(NamedTuple):
    """A model's one-step predictions for a stream, NaN where it made none."""

    residual: Array  # (n, J) rad, reading k minus what was predicted at k - 1
    increment: Array  # (n, J) rad, the movement predicted from k - 1 to k

    @classmethod
    def of(cls, model: LegModel, measured: Array, desired: Array) -> Self:
        """Of the readings and commands of a stream, (n, J) rad each."""
        predicted = predictions(model, measured, desired)
        increment = np.full_like(measured, np.nan)
        increment[1:] = predicted[1:] - measured[:-1]
        return cls(measured - predicted, increment)


@dataclass(frozen=True, eq=False)
class Evidence:
    """One stream with every model's predictions."""

    stream: Stream  # what was recorded
    motion: Motion  # what detectors see
    predictions: dict[str, Prediction]  # by name of `MODELS`
    swing_of_tick: Ints  # (n,) number of the swing, -1 in stance

    @classmethod
    def of(cls, robot: Robot, stream: Stream, models: Mapping[str, LegModel]) -> Self:
        """Of a stream and the models of its leg-run."""
        measured, desired = stream.arrays.measured, stream.arrays.desired
        heading = directions(desired, robot.leg(stream.leg))
        return cls(
            stream,
            Motion(measured, desired, swing_ticks(stream.arrays.swing), heading),
            {name: Prediction.of(model, measured, desired) for name, model in models.items()},
            find_swings(stream.run.t_ns, stream.arrays.swing).of_tick,
        )

    @property
    def descending(self) -> Mask:
        """(n,) whether the command in force is past the lift."""
        falling = np.roll(self.motion.direction, 1) == 1
        return np.asarray(falling & self.motion.judged)

    @property
    def free(self) -> Mask:
        """(n,) judged ticks that no contact is near."""
        return self.motion.judged & self.stream.stretch.free


def alarm_ticks(
    score: Array, swing: Ints, threshold: float = 1.0, descending: Mask | None = None
) -> Ints:
    """Ticks at which a contact is reported.

    Args:
        score: (n,), NaN on ticks that are not judged.
        swing: (n,) number of the swing of every tick, -1 in stance.
        threshold: on the score.
        descending: (n,) the command is past the lift; without it every swing begins free.

    Returns:
        Indices, rising.
    """
    above = np.flatnonzero((score > threshold) & (swing >= 0))
    calm_below = CALM_SCORE * threshold
    found: list[int] = []
    position = 0
    freed_in, free_from = -1, 0
    while position < len(above):
        tick = int(above[position])
        if descending is not None:
            if swing[tick] != freed_in:
                freed_in = int(swing[tick])
                first = tick
                while first > 0 and swing[first - 1] == freed_in:
                    first -= 1
                free_from = _calm(score, swing, first, calm_below, CALM_TICKS, descending)
            if tick < free_from:
                position = int(np.searchsorted(above, free_from, side="left"))
                continue
        found.append(tick)
        rearmed = _calm(score, swing, tick, calm_below, REARM_TICKS, None)
        position = int(np.searchsorted(above, rearmed, side="left"))
    return np.array(found, dtype=np.int64)


def alarms(t_ns: Ints, score: Array, swing: Ints, threshold: float, descending: Mask) -> Events:
    """:func:`alarm_ticks` as the events of a stream with times ``t_ns``."""
    when = t_ns[alarm_ticks(score, swing, threshold, descending)]
    return Events(when, np.ones(len(when), dtype=bool), when)


def _calm(
    score: Array, swing: Ints, at: int, calm_below: float, ticks: int, descending: Mask | None
) -> int:
    """First tick of a swing after so many calm ones from ``at`` on, or after a descending one.

    Without any within the swing the tick after it: what comes next has a swing, and a load, of its
    own.
    """
    number, calm = swing[at], 0
    while at < len(score) and swing[at] == number:
        value = score[at]
        if value == value:
            calm = calm + 1 if value < calm_below else 0
            if calm >= ticks or (descending is not None and descending[at]):
                return at + 1
        at += 1
    return at


def rule(error: Array) -> Array:
    """The paper's rule: change of the absolute prediction error, (n, J) rad."""
    return np.abs(np.diff(np.abs(error), axis=0, prepend=np.nan))


def tracking_error(motion: Motion, lag: int) -> Array:
    """Absolute position error against the command of ``lag`` ticks before, (n, J) rad.

    At lag 0 the command in force when the reading was taken: that of the tick before.
    """
    out = np.full_like(motion.measured, np.nan)
    past = lag + 1
    out[past:] = np.abs(motion.desired[:-past] - motion.measured[past:])
    return out


def learn_noise(
    motion: Motion, prediction: Prediction, free: Mask, quantum_rad: float
) -> NoiseModel:
    """Covariances of a model's residuals on free judged ticks.

    Args:
        motion: the stream.
        prediction: of a model that was not fitted to it.
        free: (n,) ticks without contact.
        quantum_rad: position step.

    Raises:
        IdentificationError: too few ticks.
    """
    history, _, where, usable = _windows(motion, prediction, quantum_rad)
    rows = free & (usable >= len(WINDOWS))
    return fit_noise(history[rows], where[rows], quantum_rad)


def likelihood_ratio(
    motion: Motion, prediction: Prediction, noise: NoiseModel, quantum_rad: float
) -> Array:
    """The likelihood-ratio statistic of every window, (n, windows); NaN where not judged."""
    history, rollout, where, usable = _windows(motion, prediction, quantum_rad)
    out = np.full((len(usable), len(WINDOWS)), np.nan)
    rows = usable > 0
    out[rows] = stream_statistic(history[rows], rollout[rows], where[rows], usable[rows], noise)
    return out


def _windows(
    motion: Motion, prediction: Prediction, quantum_rad: float
) -> tuple[Array, Array, Ints, Ints]:
    """Residual and movement histories, contexts, and how many lags lie in this swing's judged part.

    The command that moved the leg to reading k was written at k - 1.
    """
    depth = len(WINDOWS)
    history = lagged(prediction.residual, depth)
    rollout = lagged(prediction.increment, depth)
    tick = np.arange(len(motion.desired))
    command, before = (motion.desired[np.maximum(tick - back, 0)] for back in (1, 2))
    where = context(command, before, motion.direction[np.maximum(tick - 1, 0)], quantum_rad)
    sound = np.isfinite(history).all(axis=2)
    run = np.cumprod(sound, axis=1).sum(axis=1)
    usable = np.minimum(run, np.maximum(motion.swing_tick - JUDGED_AFTER_TICKS, 0))
    return history, rollout, where, np.asarray(usable, dtype=np.int64)


@dataclass(frozen=True)
class Calibration:
    """Thresholds of a statistic's channels."""

    tails: tuple[Tail, ...]  # of every channel on free ticks
    channels: tuple[int, ...]  # those that are used

    @classmethod
    def of(cls, statistics: Sequence[Array]) -> Self:
        """Fit every channel's tail on free judged ticks, (n, channels) of each stream.

        Raises:
            IdentificationError: too few ticks for a tail.
        """
        tails = tuple(map(fit_tail, np.concatenate(statistics).T))
        return cls(tails, tuple(range(len(tails))))

    def score(self, statistic: Array, per_tick: float) -> Array:
        """(n,) largest channel over its threshold, above 1 for a contact; NaN if none is known.

        Args:
            statistic: (n, channels).
            per_tick: probability of a false alarm on a free tick; split evenly over channels.
        """
        share = per_tick / len(self.channels)
        tails = [self.tails[c] for c in self.channels]
        thresholds = [tail.quantile(min(share, tail.rate)) for tail in tails]
        used = statistic[:, list(self.channels)] / np.array(thresholds)
        known = np.isfinite(used)
        best = np.where(known, used, -np.inf).max(axis=1)
        return np.where(known.any(axis=1), best, np.nan)


@dataclass(frozen=True, eq=False)
class Bench:
    """All that the compared detectors learned besides their models."""

    lag: int  # of the tracking error, ticks
    noise: dict[str, dict[str, NoiseModel]]  # by model, then by leg-run's name
    calibrations: dict[str, Calibration]  # by detector
    quantum_rad: float  # position step
    aim_per_hour: float  # false alarms per robot-hour, the target rate of thresholds

    def score(self, detector: str, evidence: Evidence) -> Array:
        """(n,) over the target rate's threshold; NaN on ticks that are not judged."""
        statistic = DETECTORS[detector].statistic(self, evidence)
        per_tick = self.aim_per_hour / ROBOT_HOUR_TICKS
        values = self.calibrations[detector].score(statistic, per_tick)
        return np.where(evidence.motion.judged, values, np.nan)


class Detector(NamedTuple):
    """One detector that is compared."""

    title: str  # for tables
    statistic: Callable[[Bench, Evidence], Array]  # of a stream, (n, channels)
    joints: bool  # whether channels are joints, of which a rule may use some


def _ratio(model: str) -> Callable[[Bench, Evidence], Array]:
    def statistic(bench: Bench, evidence: Evidence) -> Array:
        noise = bench.noise[model][evidence.stream.leg_run]
        return likelihood_ratio(
            evidence.motion, evidence.predictions[model], noise, bench.quantum_rad
        )

    return statistic


# The default detector, which learns as it goes, is played sample by sample (evaluation.py).
DETECTORS: Final[dict[str, Detector]] = {
    "servo ratio": Detector("servo law, likelihood ratio (frozen)", _ratio("servo"), False),
    "servo rule": Detector(
        "servo law, paper's rule", lambda _, e: rule(e.predictions["servo"].residual), True
    ),
    "paper ratio": Detector("paper's library, likelihood ratio", _ratio("paper"), False),
    "paper rule": Detector(
        "the paper: its library, its rule",
        lambda _, e: rule(e.predictions["paper"].residual),
        True,
    ),
    "tracking": Detector(
        "tracking error", lambda bench, e: tracking_error(e.motion, bench.lag), True
    ),
    "naive": Detector(
        "naive difference",
        lambda _, e: rule(np.diff(e.motion.measured, axis=0, prepend=np.nan)),
        True,
    ),
}


def tune_bench(robot: Robot, free: Sequence[Evidence], touch: Sequence[Evidence]) -> Bench:
    """Choose lag, noise, tails and joints on tuning streams.

    Args:
        robot: whose legs they are.
        free: without contacts, of every leg-run.
        touch: with contacts.

    Raises:
        IdentificationError: too few ticks.
    """
    lags = [
        # Lags of the tracking error that are tried, ticks.
        np.concatenate([tracking_error(e.motion, lag)[e.free] for e in free])
        for lag in range(7)
    ]
    lag = int(np.argmin([np.sqrt(np.nanmean(np.square(errors))) for errors in lags]))
    own: dict[str, list[Evidence]] = {}
    for e in free:
        own.setdefault(e.stream.leg_run, []).append(e)
    noise = {
        model: {name: _joined_noise(of, model, robot.quantum_rad) for name, of in own.items()}
        for model in MODELS
    }
    bench = Bench(lag, noise, {}, robot.quantum_rad, robot.detector.false_alarms_per_hour)
    truths = [leg_stream(e.stream.run, e.stream.leg, robot) for e in touch]

    def recall(name: str, calibration: Calibration) -> float:
        bench.calibrations[name] = calibration
        outcomes = [
            match(t, alarms(t.t_ns, bench.score(name, e), e.swing_of_tick, 1.0, e.descending))
            for t, e in zip(truths, touch, strict=True)
        ]
        return summarise(outcomes).counted.recall or 0.0

    for name, detector in DETECTORS.items():
        whole = Calibration.of([detector.statistic(bench, e)[e.free] for e in free])
        subsets: list[tuple[int, ...]] = [whole.channels]
        if detector.joints:
            subsets = [c for n in range(1, JOINTS + 1) for c in combinations(range(JOINTS), n)]
        choices = [replace(whole, channels=channels) for channels in subsets]
        recalls = [recall(name, choice) for choice in choices]
        bench.calibrations[name] = choices[int(np.argmax(recalls))]
    return bench


def _joined_noise(parts: Sequence[Evidence], model: str, quantum_rad: float) -> NoiseModel:
    """Noise of one leg-run over several streams, put end to end.

    Streams end in a hold, which is stance: no window reaches over a joint.
    """
    motion = Motion(*map(np.concatenate, zip(*(p.motion for p in parts), strict=True)))
    residuals = zip(*(p.predictions[model] for p in parts), strict=True)
    free = np.concatenate([p.free for p in parts])
    return learn_noise(motion, Prediction(*map(np.concatenate, residuals)), free, quantum_rad)
