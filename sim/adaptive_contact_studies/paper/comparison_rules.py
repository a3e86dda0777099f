r"""Events of a whole stream of scores at once, for sweeping thresholds.

One state machine for every detector that is compared, with the rules of
the tick (:mod:`adaptive_contact.detect.detector`) on a single score.  A swing begins loaded: the
foot may still be held by the stance before.  It is free once the score was calm (below half the
threshold) for :data:`CALM_TICKS`, or once the command descends.  A free leg whose score passes the
threshold is reported to touch, and may be reported again after :data:`REARM_TICKS` calm ticks.  A
NaN score changes nothing.

Detectors to be compared with: every one a statistic per tick, calibrated the same way.

With e = θ - θ̂ the residual of a model's one-step prediction, and J joints:

``position difference``
    :math:`\big|\,|\Delta\theta[k]| - |\Delta\theta[k-1]|\,\big|`, the paper's rule on the naive
    prediction (no motion).
``tracking error``
    :math:`|\theta^{des}[k-1-d] - \theta[k]|`, the position error that force-threshold controllers
    use (Mrva and Faigl 2015, the paper's [1]), at the lag d of the servo.
``paper's rule``
    :math:`\big|\,|e[k]| - |e[k-1]|\,\big|`, the paper's section 3.
``likelihood ratio``
    of :mod:`adaptive_contact.model.glr`, on the residuals of any model.

A statistic has channels (joints, or windows).  :func:`calibrate` gives each channel the threshold
that free ticks exceed with the same small probability, by a tail fitted to free ticks; a tick's
score is the largest channel over its threshold, so that one number is swept for a ROC curve.
No detector here knows a model: residuals come from outside.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.detect.contact import CALM_SCORE, CALM_TICKS, REARM_TICKS
from adaptive_contact.model.glr import stream_statistic
from adaptive_contact.model.noise import WINDOWS, NoiseModel, context, fit_noise, lagged
from adaptive_contact.model.tail import Tail, fit_tail
from adaptive_contact.score import Events


def alarm_ticks(
    score: Array,
    swing: Ints,
    threshold: float = 1.0,
    descending: Mask | None = None,
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


def alarms(
    t_ns: Ints,
    score: Array,
    swing: Ints,
    threshold: float,
    descending: Mask,
) -> Events:
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


# Ticks after the command lifts off in which the foot may still be loaded: the same for all.
JUDGED_AFTER_TICKS: Final = 5


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
    def of(cls, measured: Array, predicted: Array) -> Self:
        """From (n, J) rad, readings and what was predicted of them one tick before."""
        increment = np.full_like(measured, np.nan)
        increment[1:] = predicted[1:] - measured[:-1]
        return cls(measured - predicted, increment)


def position_difference(motion: Motion) -> Array:
    """The paper's rule on the naive prediction, (n, J) rad."""
    step = np.diff(motion.measured, axis=0, prepend=np.nan)
    return _difference(step)


def paper_rule(prediction: Prediction) -> Array:
    """The paper's rule: change of the absolute prediction error, (n, J) rad."""
    return _difference(prediction.residual)


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


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Thresholds of a statistic's channels."""

    tails: tuple[Tail, ...]  # of every channel on free ticks
    channels: tuple[int, ...]  # those that are used

    def thresholds(self, per_tick: float) -> Array:
        """(used channels,) thresholds that together are exceeded at most so often.

        Args:
            per_tick: probability of a false alarm on a free tick; split evenly over channels.
        """
        share = per_tick / len(self.channels)
        tails = [self.tails[c] for c in self.channels]
        return np.array([t.quantile(min(share, t.rate)) for t in tails])

    def score(self, statistic: Array, per_tick: float) -> Array:
        """(n,) largest channel over its threshold, above 1 for a contact; NaN if none is known."""
        used = statistic[:, list(self.channels)] / self.thresholds(per_tick)
        known = np.isfinite(used)
        best = np.where(known, used, -np.inf).max(axis=1)
        return np.where(known.any(axis=1), best, np.nan)


def calibrate(statistics: Sequence[ArrayLike]) -> Calibration:
    """Fit every channel's tail on free ticks.

    Args:
        statistics: (n, channels) each, of free judged ticks; legs are pooled.

    Raises:
        IdentificationError: too few ticks for a tail.
    """
    pooled = np.concatenate([np.asarray(s, dtype=np.float64) for s in statistics])
    channels = pooled.shape[1]
    tails = tuple(fit_tail(pooled[:, c]) for c in range(channels))
    return Calibration(tails, tuple(range(channels)))


def _difference(error: Array) -> Array:
    size = np.abs(error)
    return np.abs(np.diff(size, axis=0, prepend=np.nan))


def _windows(
    motion: Motion, prediction: Prediction, quantum_rad: float
) -> tuple[Array, Array, Ints, Ints]:
    """Residual and movement histories, contexts, and how many lags lie in this swing's judged part.

    The command that moved the leg to reading k was written at k - 1.
    """
    depth = len(WINDOWS)
    history = lagged(prediction.residual, depth)
    rollout = lagged(prediction.increment, depth)
    command = motion.desired[np.maximum(np.arange(len(motion.desired)) - 1, 0)]
    before = motion.desired[np.maximum(np.arange(len(motion.desired)) - 2, 0)]
    heading = motion.direction[np.maximum(np.arange(len(motion.direction)) - 1, 0)]
    where = context(command, before, heading, quantum_rad)
    sound = np.isfinite(history).all(axis=2)
    run = np.cumprod(sound, axis=1).sum(axis=1)
    usable = np.minimum(run, np.maximum(motion.swing_tick - JUDGED_AFTER_TICKS, 0))
    return history, rollout, where, np.asarray(usable, dtype=np.int64)
