r"""Sets thresholds after the turn to stance from the largest statistics of free ticks there.

The command stops or goes another way, and the foot still follows: the tail of the descent says
nothing of it.  On a robot that hung, a baseline reported 27 contacts in the minute that it was
fitted to, all of them after turns.  How far the largest value :math:`M` of :math:`n` free ticks
lies above that of :math:`\chi^2_J` is extrapolated:

.. math:: t(p) = M \, Q(p) / Q(1 / n) , \qquad Q(p) = \chi^2_J\text{-quantile exceeded with } p

More free ticks bring the factor nearer to one: they never make a leg duller by themselves.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri  # scipy.stats takes half a second to import

from adaptive_contact.arrays import Array
from adaptive_contact.model.noise import WINDOWS
from adaptive_contact.robot import ROBOT_HOUR_TICKS

# A largest value of fewer ticks says too little of a leg.
LEAST_TICKS: Final = 300


class Peaks(NamedTuple):
    """Holds the largest statistics of free ticks after the turn to stance."""

    largest: Array  # (windows,)
    ticks: int  # that they are of
    joints: int

    @classmethod
    def of(cls, values: Array, joints: int) -> Peaks | None:
        """Find them; None where there are too few ticks.

        Args:
            values: (n, windows) of the statistic on free ticks; NaN where there is none.
            joints: of the leg.
        """
        if len(values) < LEAST_TICKS:
            return None
        return cls(np.fmax.reduce(values, axis=0, initial=0.0), len(values), joints)

    def thresholds(self, false_alarms_per_hour: float) -> Array:
        """Compute (windows,) thresholds for a rate of false alarms, split over the windows."""
        per_tick = false_alarms_per_hour / ROBOT_HOUR_TICKS / len(WINDOWS)
        seen = 1.0 / self.ticks
        further, here = chdtri(self.joints, np.array([min(per_tick, seen), seen]))
        return self.largest * float(further / here)
