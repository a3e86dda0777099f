"""Infers swing and stance from the commands alone.

The commanded foot height in the leg's frame decides: a swing begins when it rises out of the
recent low, and ends when, after a descent, it stops changing.  Only commands are used: a leg
that is held back by an obstacle is still in swing as long as its controller moves it down.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections import deque
from typing import Final

from adaptive_contact.arrays import Array, Ints, Mask, np
from adaptive_contact.robot.description import Leg
from adaptive_contact.wire import Phase

# Lengths are of a leg of 0.256 m, and in proportion for others (`Chain.size`).
# A swing begins once the command has risen this far out of the low of the last LOW_TICKS.  The
# posture control of a walking robot moves stance feet by less within a fifth of a second.
RISE_M: Final = 0.004
LOW_TICKS: Final = 10
# It ends after this many ticks of a height that changes by less than STILL_M each, below the apex.
STILL_TICKS: Final = 2
STILL_M: Final = 0.0008
# Ticks after the command lifts off in which the foot may still be loaded: the servo follows its
# command three to four ticks late, and the stance's load has to let go first.
LIFT_OFF_TICKS: Final = 5


class Direction(enum.IntEnum):
    """Names the direction of a swing's command; the values index conditional statistics."""

    LIFT = 0
    DESCENT = 1


@dataclasses.dataclass
class PhaseTracker:
    """Follows the height of one leg's commanded foot, one tick at a time."""

    phase: Phase = "stance"  # at the last tick
    size: float = 1.0  # of the leg, in the hexapod's
    _heights: deque[float] = dataclasses.field(default_factory=lambda: deque(maxlen=LOW_TICKS))
    _apex: float = -math.inf
    _still: int = 0

    def update(self, height: float) -> Phase:
        """Process the next command.

        Args:
            height: of the commanded foot in the leg's frame, m.

        Returns:
            The phase at this tick.
        """
        rise_m = RISE_M * self.size
        before = self._heights[-1] if self._heights else height
        self._heights.append(height)
        if self.phase == "stance":
            if height > before and height - min(self._heights) > rise_m:
                self.phase, self._apex, self._still = "swing", height, 0
        else:
            self._apex = max(self._apex, height)
            still = abs(height - before) < STILL_M * self.size and height < self._apex - rise_m
            self._still = self._still + 1 if still else 0
            if self._still >= STILL_TICKS:
                self.phase = "stance"
                self._heights.clear()
                self._heights.append(height)
        return self.phase


def infer_phase(desired: Array, leg: Leg) -> Mask | None:
    """Infer the swing mask, (n,) bool, from commands, (n, J) rad; None without geometry."""
    if leg.chain is None:
        return None
    tracker = PhaseTracker(size=leg.chain.size)
    heights = leg.chain.foot(desired)[:, 2].tolist()
    return np.array([tracker.update(height) == "swing" for height in heights], dtype=bool)


def directions(desired: Array, leg: Leg) -> Ints:
    """Return each tick's direction: the height of its command against the one before.

    Args:
        desired: (n, J) rad, one row per tick without gaps.
        leg: its geometry; without one everything counts as descent, the cautious choice
            (a descent may hold a contact, a lift may not).

    Returns:
        (n,) values of :class:`Direction`.
    """
    if leg.chain is None:
        return np.full(len(desired), int(Direction.DESCENT))
    height = leg.chain.foot(desired)[:, 2]
    rise = np.diff(height, prepend=height[:1])
    return np.where(rise > 0, int(Direction.LIFT), int(Direction.DESCENT))
