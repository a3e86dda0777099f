r"""Reading right after another controller's writes.

In observe mode somebody else writes goals at the control rate, at times of its own.  A sample
pairs positions with the goals in force until the next reading, so the reading has to come right
*after* the writes: before them, the goals it sees would be those of the tick that just ended.

Once a tick, one moving servo's goal is read a little ahead of the main reading, alternately a
*far* lead :math:`\delta` and a *near* one :math:`\delta/3`.  A goal that changes between the two
readings was written in between.  The writes are wanted between far and near lead:

- far, no change: they came earlier; the schedule moves earlier, by half a lead until it meets them
  (at the latest after one turn), by a sixth once it has;
- near, change: they come so close that the next may be too late; the schedule moves later.

Goals that stand still tell nothing, and the schedule stays.
"""

from __future__ import annotations

import dataclasses
from typing import Final

__all__ = ["PhaseLock"]

# Of the control period: 2.4 ms at 50 Hz.
FAR_SHARE: Final = 0.12
NEAR_SHARE: Final = FAR_SHARE / 3
# Far readings with moving goals, in a row, after which a lock that is not confirmed is given up.
LOST_AFTER: Final = 8


@dataclasses.dataclass
class PhaseLock:
    """Where the writes lie against our reading.

    Args:
        period_s: control tick.

    Attributes:
        locked: the writes come right before the reading, as far as could be seen.
    """

    period_s: float
    locked: bool = False
    _near: bool = False
    _unconfirmed: int = 0

    @property
    def lead_s(self) -> float:
        """How far ahead of the main reading the goal is to be read in this tick."""
        return (NEAR_SHARE if self._near else FAR_SHARE) * self.period_s

    def update(self, *, before: int | None, now: int | None, last: int | None) -> float:
        """Take in one tick's goals of one servo, in steps; None for a reading that did not come.

        Args:
            before: read :attr:`lead_s` ahead of the main reading.
            now: read with it.
            last: read with the main reading a tick ago.

        Returns:
            Seconds to move the schedule by; below zero for earlier.
        """
        if before is None or now is None or last is None or now == last:
            return 0.0
        between = before != now
        far = FAR_SHARE * self.period_s
        if self._near:
            self._near = False
            return far / 6 if between else 0.0
        if between:
            self.locked, self._unconfirmed = True, 0
            self._near = True
            return 0.0
        if not self.locked:
            return -far / 2
        self._unconfirmed += 1
        if self._unconfirmed >= LOST_AFTER:
            self.locked, self._unconfirmed = False, 0
        return -far / 6
