"""Infers swing and stance from the commands alone.

The commanded foot height in the leg's frame decides: a swing begins when it rises out of the
recent low, and ends when, after a descent, it stops changing.  Only commands are used: a leg
that is held back by an obstacle is still in swing as long as its controller moves it down.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from typing import Any, Final

from adaptive_contact.arrays import Array, Ints, Mask, np
from adaptive_contact.robot.description import Leg

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
class PhaseState:
    """Holds what inferring one leg's phase needs from tick to tick."""

    leg_size: float  # in the hexapod's
    swing_phase: bool = False  # at the last tick
    apex: float = -math.inf  # m, highest command of the swing
    still: int = 0  # ticks in which it did not change
    # of the ring of the last heights: how many there are, and where the next one goes
    low_n: int = 0
    low_next: int = 0


def infer_next_phase(leg: PhaseState, height: float, low: Any) -> bool:
    """Infer the phase of the next tick; the tick of the learners compiles this.

    Args:
        leg: what is known of it so far, changed.
        height: of the commanded foot in the leg's frame, m.
        low: (LOW_TICKS,) m, ring of the last heights, changed.

    Returns:
        True in a swing.
    """
    before = low[(leg.low_next - 1) % LOW_TICKS] if leg.low_n else height
    low[leg.low_next] = height
    leg.low_next = (leg.low_next + 1) % LOW_TICKS
    leg.low_n = min(leg.low_n + 1, LOW_TICKS)
    if not leg.swing_phase:
        least = height
        for k in range(leg.low_n):
            least = min(least, low[(leg.low_next - 1 - k) % LOW_TICKS])
        if height > before and height - least > RISE_M * leg.leg_size:
            leg.swing_phase, leg.apex, leg.still = True, height, 0
    else:
        leg.apex = max(leg.apex, height)
        still = abs(height - before) < STILL_M * leg.leg_size
        still = still and height < leg.apex - RISE_M * leg.leg_size
        leg.still = leg.still + 1 if still else 0
        if leg.still >= STILL_TICKS:
            leg.swing_phase = False
            low[0] = height
            leg.low_n, leg.low_next = 1, 1
    return leg.swing_phase


def infer_phase(desired: Array, leg: Leg) -> Mask | None:
    """Infer the swing mask, (n,) bool, from commands, (n, J) rad; None without geometry."""
    if leg.chain is None:
        return None
    state, low = PhaseState(leg.chain.size), [0.0] * LOW_TICKS
    heights = leg.chain.foot(desired)[:, 2].tolist()
    return np.array([infer_next_phase(state, height, low) for height in heights], dtype=bool)


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
