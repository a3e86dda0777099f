r"""Sets thresholds from the largest statistics of a leg's own free ticks.

A tail that is pooled over legs and extrapolated by four decades is cautious by a factor of two to
seven.  Who touches softly pays for it: of a light hexapod's touches a quarter was found, and the
others were learned as if they were the leg.  How far the largest value :math:`M` of :math:`n`
free ticks lies above that of Gaussian residuals is extrapolated instead, for each window and
direction (lift, descent, after the turn to stance, where the command stops or goes another way):

.. math:: t(p) = M \, Q(p) / Q(1 / n) , \qquad Q(p) = \text{quantile exceeded with } p

More free ticks bring the factor nearer to one: they never make a leg duller by themselves.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.model.glr import free_quantile
from adaptive_contact.model.noise import AFTER, DIRECTIONS, LIFT, WINDOWS
from adaptive_contact.robot import ROBOT_HOUR_TICKS

# A largest value of fewer ticks says too little of a leg.
LEAST_TICKS: Final = 300
# In its swings a leg that walks is jolted; the largest values are those of one that hangs.
MARGIN: Final = 1.3


def beyond(false_alarms_per_hour: ArrayLike, ticks: ArrayLike) -> Array:
    """Compute how far a threshold lies above the largest statistic of so many free ticks.

    Args:
        false_alarms_per_hour: split over the windows.
        ticks: that it is of.
    """
    per_tick = np.asarray(false_alarms_per_hour) / ROBOT_HOUR_TICKS / len(WINDOWS)
    seen = 1.0 / np.asarray(ticks)
    return free_quantile(np.minimum(per_tick, seen)) / free_quantile(seen)


class Peaks(NamedTuple):
    """Holds the largest statistics of a leg's free ticks."""

    largest: Array  # (directions, windows), NaN where there were too few ticks
    ticks: tuple[int, ...]  # (directions,) that they are of

    @classmethod
    def from_values(cls, values: Array, directions: Ints) -> Peaks | None:
        """Find the peaks of values; None where there are too few ticks in every direction.

        Args:
            values: (n, windows) of the statistic on free ticks; NaN where there is none.
            directions: (n,) of each.
        """
        ticks = np.bincount(directions, minlength=DIRECTIONS)
        largest = np.full((DIRECTIONS, len(WINDOWS)), np.nan)
        for direction in np.flatnonzero(ticks >= LEAST_TICKS):
            inside = values[directions == direction]
            found = np.fmax.reduce(inside, axis=0, initial=0.0)
            largest[direction] = found if found.all() else np.nan
        if np.isnan(largest).all():
            return None
        return cls(largest, tuple(ticks.tolist()))

    def thresholds(self, false_alarms_per_hour: Array) -> Array:
        """Compute (directions, windows) thresholds, NaN where nothing is known.

        Args:
            false_alarms_per_hour: (directions,) rates of false alarms, split over the windows.
        """
        factor = beyond(false_alarms_per_hour, np.maximum(self.ticks, LEAST_TICKS))
        factor[:AFTER] *= MARGIN
        return np.asarray(self.largest * factor[:, None])

    def excess(self, value: float, ticks: int) -> float:
        """Compute how large the largest of so many ticks of a lift is, over what it should be."""
        counts = np.array([ticks, self.ticks[LIFT]])
        here, there = free_quantile(1.0 - 0.5 ** (1.0 / counts))  # medians of largest values
        return value / float(self.largest[LIFT, 0] * here / there)
