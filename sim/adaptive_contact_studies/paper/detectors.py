r"""The detectors that are compared, on the same streams.

With e = θ - θ̂ the residual of a model's one-step prediction:

``naive``
    :math:`\big|\,|\Delta\theta[k]| - |\Delta\theta[k-1]|\,\big|`, the paper's rule on the naive
    prediction (no motion).
``tracking``
    :math:`|\theta^{des}[k-1-d] - \theta[k]|`, the position error that force-threshold controllers
    use (Mrva and Faigl 2015, the paper's [1]), at the lag d of the servo.
``rule``
    :math:`\big|\,|e[k]| - |e[k-1]|\,\big|`, the paper's section 3.

A statistic has a channel per joint.  Each gets the threshold that free ticks exceed with the same
small probability, by a tail fitted to free ticks; a tick's score is the largest channel over its
threshold, so that one number is swept for a ROC curve.

One state machine makes events of scores, with the rules of the tick
(:mod:`~adaptive_contact.core.detect.detector`).  A swing begins loaded: the foot may still be held
by the stance before.  It is free once the score was calm (below half the threshold) for
:data:`CALM_TICKS`, or once the command descends.  A free leg whose score passes the threshold is
reported to touch, and may be reported again after :data:`REARM_TICKS` calm ticks.  A NaN score
changes nothing.

Models are learned from the training streams of each leg-run; tails, the lag of the tracking error
and the joints a rule looks at are chosen on tuning streams.
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


@dataclass(frozen=True, eq=False)
class Evidence:
    """What every detector sees of a stream, row k being control tick k."""

    stream: Stream  # what was recorded
    measured: Array  # (n, J) rad, read at the start of tick k
    desired: Array  # (n, J) rad, written right after
    judged: Mask  # (n,) ticks on which a detector may decide
    descending: Mask  # (n,) those on which the command in force is past the lift
    # by name of `MODELS`, (n, J) rad, reading k minus what was predicted at k - 1; NaN where
    # nothing was
    residuals: dict[str, Array]
    swing_of_tick: Ints  # (n,) number of the swing, -1 in stance

    @classmethod
    def from_stream(cls, robot: Robot, stream: Stream, models: Mapping[str, LegModel]) -> Self:
        """Make the evidence of a stream, with the models of its leg-run."""
        measured, desired = stream.arrays.measured, stream.arrays.desired
        judged = swing_ticks(stream.arrays.swing) > JUDGED_AFTER_TICKS
        falling = np.roll(directions(desired, robot.leg(stream.leg)), 1) == 1
        return cls(
            stream,
            measured,
            desired,
            judged,
            falling & judged,
            {name: measured - predictions(own, measured, desired) for name, own in models.items()},
            find_swings(stream.run.t_ns, stream.arrays.swing).of_tick,
        )

    @property
    def free(self) -> Mask:
        """(n,) judged ticks that no contact is near."""
        return self.judged & self.stream.stretch.free


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


def tracking_error(evidence: Evidence, lag: int) -> Array:
    """Absolute position error against the command of ``lag`` ticks before, (n, J) rad.

    At lag 0 the command in force when the reading was taken: that of the tick before.
    """
    out = np.full_like(evidence.measured, np.nan)
    past = lag + 1
    out[past:] = np.abs(evidence.desired[:-past] - evidence.measured[past:])
    return out


@dataclass(frozen=True)
class Calibration:
    """Thresholds of a statistic's channels."""

    tails: tuple[Tail, ...]  # of every channel on free ticks
    channels: tuple[int, ...]  # those that are used

    @classmethod
    def from_statistics(cls, statistics: Sequence[Array]) -> Self:
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
    calibrations: dict[str, Calibration]  # by detector
    aim_per_hour: float  # false alarms per robot-hour, the target rate of thresholds

    def score(self, detector: str, evidence: Evidence) -> Array:
        """(n,) over the target rate's threshold; NaN on ticks that are not judged."""
        statistic = DETECTORS[detector].statistic(self, evidence)
        per_tick = self.aim_per_hour / ROBOT_HOUR_TICKS
        values = self.calibrations[detector].score(statistic, per_tick)
        return np.where(evidence.judged, values, np.nan)


class Detector(NamedTuple):
    """One detector that is compared."""

    title: str  # for tables
    statistic: Callable[[Bench, Evidence], Array]  # of a stream, (n, J)


# The product, as it learns and frozen, is played sample by sample (evaluation.py).
DETECTORS: Final[dict[str, Detector]] = {
    "servo rule": Detector("servo law, paper's rule", lambda _, e: rule(e.residuals["servo"])),
    "paper rule": Detector(
        "the paper: its library, its rule", lambda _, e: rule(e.residuals["paper"])
    ),
    "tracking": Detector("tracking error", lambda bench, e: tracking_error(e, bench.lag)),
    "naive": Detector(
        "naive difference", lambda _, e: rule(np.diff(e.measured, axis=0, prepend=np.nan))
    ),
}


def tune_bench(robot: Robot, free: Sequence[Evidence], touch: Sequence[Evidence]) -> Bench:
    """Choose lag, tails and joints on tuning streams.

    Args:
        robot: whose legs they are.
        free: without contacts, of every leg-run.
        touch: with contacts.

    Raises:
        IdentificationError: too few ticks.
    """
    lags = [
        # Lags of the tracking error that are tried, ticks.
        np.concatenate([tracking_error(e, lag)[e.free] for e in free])
        for lag in range(7)
    ]
    lag = int(np.argmin([np.sqrt(np.nanmean(np.square(errors))) for errors in lags]))
    bench = Bench(lag, {}, robot.detector.false_alarms_per_hour)
    truths = [leg_stream(e.stream.run, e.stream.leg, robot) for e in touch]

    def recall(name: str, calibration: Calibration) -> float:
        bench.calibrations[name] = calibration
        outcomes = [
            match(t, alarms(t.t_ns, bench.score(name, e), e.swing_of_tick, 1.0, e.descending))
            for t, e in zip(truths, touch, strict=True)
        ]
        return summarise(outcomes).counted.recall or 0.0

    subsets = [c for n in range(1, JOINTS + 1) for c in combinations(range(JOINTS), n)]
    for name, detector in DETECTORS.items():
        whole = Calibration.from_statistics([detector.statistic(bench, e)[e.free] for e in free])
        choices = [replace(whole, channels=channels) for channels in subsets]
        recalls = [recall(name, choice) for choice in choices]
        bench.calibrations[name] = choices[int(np.argmax(recalls))]
    return bench
