r"""Reading right after another controller's writes.

In observe mode somebody else writes goals at the control rate, at times of its own.  A sample
pairs positions with the goals in force until the next reading, so the reading has to come right
*after* the writes: before them, the goals it sees would be those of the tick that just ended.

Once a tick a servo's goal is read a lead :math:`\delta` ahead of the main reading.  A goal that
changes between the two was written within :math:`\delta` before the reading: in lock.  One that
changed since the last tick, but not within :math:`\delta`, was written earlier: the schedule
moves earlier by :math:`\delta/2` until it meets the writes, at the latest after one turn.  Where a
lock is lost, the writes have most likely slipped to just behind the reading: then the first move
is a later one.  Goals that stand still tell nothing, and the schedule stays.
"""

from __future__ import annotations

import dataclasses
from typing import Final

__all__ = ["PhaseLock"]

# Of the control period: 3 ms at 50 Hz.
LEAD_SHARE: Final = 0.15
# Ticks with moving goals, in a row, after which a lock that is not confirmed is given up: one late
# write is no change of schedule.
LOST_AFTER: Final = 3


@dataclasses.dataclass
class PhaseLock:
    """Where the writes lie against our reading.

    Args:
        period_s: control tick.

    Attributes:
        locked: the last goals that moved were written right before the reading.
    """

    period_s: float
    locked: bool = False
    _unconfirmed: int = 0

    @property
    def lead_s(self) -> float:
        """How far ahead of the main reading the goal is to be read."""
        return LEAD_SHARE * self.period_s

    def update(self, *, before: int | None, now: int | None, last: int | None) -> float:
        """Take in one tick's goals of one servo, in steps; None for a reading that did not come.

        Args:
            before: read a lead ahead of the main reading.
            now: read with it.
            last: read with the main reading a tick ago.

        Returns:
            Seconds to move the schedule by; below zero for earlier.
        """
        if before is None or now is None or last is None or now == last:
            return 0.0
        if before != now:
            self.locked, self._unconfirmed = True, 0
            return 0.0
        self._unconfirmed += 1
        if self.locked:
            if self._unconfirmed < LOST_AFTER:
                return 0.0
            self.locked = False
            return 0.5 * self.lead_s
        return -0.5 * self.lead_s
