"""Judges the ticks of one leg by what is known of its residuals.

The statistic itself is evaluated for several legs at once (:mod:`adaptive_contact.adapt.block`);
here is what it needs of each, and what is made of its verdict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.baseline import LegBaseline
from adaptive_contact.adapt.contacts import Touch
from adaptive_contact.adapt.recent import RecentNoise
from adaptive_contact.adapt.tracker import Tracker
from adaptive_contact.detect import context_of, onset_fraction
from adaptive_contact.identify import Domain

__all__ = ["LegDetector", "Verdict", "within_domain"]

Array = NDArray[np.float64]


class Verdict(NamedTuple):
    """What is known of a tick that can be judged.

    Attributes:
        scores: statistic over threshold for each window, NaN where it reaches too far back.
        distance: of the last residual from zero, whitened and squared, in any direction.
        residual: (J,) rad, that residual.
        target: (J,) rad, the movement that was measured.
    """

    scores: list[float]
    distance: float
    residual: Array
    target: Array

    @property
    def score(self) -> float:
        """The largest."""
        # The window of one tick is always usable; longer ones may be NaN, which `max` passes over
        # when it does not come first.
        return max(self.scores)


class LegDetector:
    """One leg's.

    Args:
        known: its model at the start.
        recent: covariances and thresholds, which follow.
        quantum_rad: position step of the servos.
        period_ns: control tick.

    Attributes:
        tracker: the leg's recent past.
        recent: as given.
        context: of the tick in hand, for its covariance.
        unit: variance of its residual over the baseline's, one number or (J,).
        sigma: (J,) rad, deviation of the baseline's residuals.
        awaited: the tick in hand is after the turn to stance, where a touch is expected.
        gradient: (J,) m per rad of the foot's height on such a tick; None elsewhere, and where the
            geometry is not known.
    """

    def __init__(
        self, known: LegBaseline, recent: RecentNoise, quantum_rad: float, period_ns: int
    ) -> None:
        self.tracker = Tracker(known.model, quantum_rad)
        self.recent = recent
        self.context = 0
        self.unit: Array | float = 1.0
        self.sigma: list[float] = known.noise.rms.tolist()
        self.awaited = False
        self.gradient: Array | None = None
        self._quantum = quantum_rad
        self._period_ns = period_ns

    @property
    def thresholds(self) -> Array:
        """(windows,) of the statistic, at present."""
        return self.recent.thresholds

    @property
    def limits(self) -> list[float]:
        """(windows,) thresholds of the tick in hand."""
        return self.recent.awaited if self.awaited else self.recent.limits

    @property
    def whitening(self) -> Array:
        """(windows, J, J) for the tick in hand."""
        whiten: Array = self.recent.whiten[self.context]
        # (J,) scales the columns, as it belongs to the residual's joints.
        unit = self.unit
        return whiten / (math.sqrt(unit) if isinstance(unit, float) else np.sqrt(unit))

    def alike(self, other: LegDetector) -> bool:
        """Whether another's model is made of the same library, so that arrays can be shared."""
        ours, theirs = self.tracker.model.library, other.tracker.model.library
        return (ours is theirs or ours == theirs) and (
            self.recent.whiten.shape == other.recent.whiten.shape
        )

    def place(self, command: Sequence[float], before: Sequence[float], direction: int) -> None:
        """Find the context of the tick in hand.

        Args:
            command: (J,) rad, that caused its motion.
            before: (J,) rad, the one before that.
            direction: of the swing.
        """
        self.context = context_of(command, before, direction, self._quantum)
        self.awaited, self.gradient = False, None

    def await_touch(self, gradient: Array | None) -> None:
        """The tick in hand, once placed, is after the turn to stance.

        Args:
            gradient: (J,) m per rad, how the foot rises with each joint; None if not known.
        """
        self.awaited, self.gradient = True, gradient

    def known_score(self, verdict: Verdict) -> tuple[float, int]:
        """The largest score where the model is not asked to extrapolate; its window's ticks."""
        return within_domain(verdict.scores, self.tracker.thetas, self.recent.domain)

    def distance(self, verdict: Verdict) -> float:
        """From free motion in any direction, over the threshold of one tick."""
        return verdict.distance / self.recent.limits[0]

    def onset_ns(self, t_ns: int, ticks: int) -> int:
        """When a touch began that a window of so many ticks has shown."""
        first = ticks - 1
        tracker = self.tracker
        share = onset_fraction(tracker.residuals[first], tracker.increments[first])
        return t_ns - first * self._period_ns - round(share * self._period_ns)

    def touch(self) -> Touch:
        """The last ticks, for candidate models to be tried on."""
        tracker = self.tracker
        target = tracker.residuals + tracker.increments
        limits = np.array(self.limits)
        return Touch.of(tracker.thetas, target, self.whitening, limits, tracker.usable)


def within_domain(
    scores: Sequence[float], thetas: Sequence[Array], domain: Domain | None
) -> tuple[float, int]:
    """The largest score where the model is not asked to extrapolate.

    A window's statistic counts over one plus the mean leverage of its rows.

    Args:
        scores: statistic over threshold of each window, shortest first; NaN for none.
        thetas: (p,) regressors of each tick's prediction, newest first.
        domain: where the model has been; None if that is not known.

    Returns:
        The score, and the ticks of its window.
    """
    spread = 0.0
    best, width = 0.0, 1
    for ticks, (score, theta) in enumerate(zip(scores, thetas, strict=False), 1):
        spread += 0.0 if domain is None else float(domain.leverage(theta))
        known = score / (1.0 + spread / ticks)
        if known > best:
            best, width = known, ticks
    return best, width
