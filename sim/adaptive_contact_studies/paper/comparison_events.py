"""Events of a whole stream of scores at once, for sweeping thresholds.

One state machine for every detector that is compared, with the rules of
the tick (:mod:`adaptive_contact.detect.detector`) on a single score.  A swing begins loaded: the
foot may still be held by the stance before.  It is free once the score was calm (below half the
threshold) for :data:`CALM_TICKS`, or once the command descends.  A free leg whose score passes the
threshold is told to touch, and may be told so again after :data:`REARM_TICKS` calm ticks.  A NaN
score changes nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.detect.contact_state import CALM_SCORE, CALM_TICKS, REARM_TICKS

__all__ = ["alarm_ticks"]

Ints = NDArray[np.int64]


def alarm_ticks(
    score: NDArray[np.float64],
    swing: Ints,
    threshold: float = 1.0,
    descending: NDArray[np.bool_] | None = None,
) -> Ints:
    """Ticks at which a contact is told.

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
    n, position = len(score), 0
    freed_in, free_from = -1, 0
    while position < len(above):
        tick = int(above[position])
        if descending is not None:
            if swing[tick] != freed_in:
                freed_in = int(swing[tick])
                free_from = _freed(score, swing, descending, tick, calm_below)
            if tick < free_from:
                position = int(np.searchsorted(above, free_from, side="left"))
                continue
        found.append(tick)
        rearmed = _rearmed(score, swing, tick, n, calm_below)
        position = int(np.searchsorted(above, rearmed, side="left"))
    return np.array(found, dtype=np.int64)


def _freed(
    score: NDArray[np.float64],
    swing: Ints,
    descending: NDArray[np.bool_],
    tick: int,
    calm_below: float,
) -> int:
    """First tick of this tick's swing on which the leg is known to be free."""
    first = tick
    while first > 0 and swing[first - 1] == swing[tick]:
        first -= 1
    calm, at = 0, first
    while at < len(score) and swing[at] == swing[tick]:
        value = score[at]
        if value == value:
            calm = calm + 1 if value < calm_below else 0
            if calm >= CALM_TICKS or descending[at]:
                return at + 1
        at += 1
    # Never within this swing: what comes next has a swing, and a load, of its own.
    return at


def _rearmed(score: NDArray[np.float64], swing: Ints, tick: int, n: int, calm_below: float) -> int:
    """First tick after a contact told at ``tick`` on which another may be told."""
    calm, at = 0, tick + 1
    while at < n and swing[at] == swing[tick]:
        value = score[at]
        if value == value:
            calm = calm + 1 if value < calm_below else 0
            if calm >= REARM_TICKS:
                return at + 1
        at += 1
    return at
