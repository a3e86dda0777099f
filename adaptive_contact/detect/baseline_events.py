"""Events of a whole stream of scores at once, for sweeping thresholds.

One state machine for every detector that is compared: within a swing, a contact is told when the
score passes the threshold, and may be told again once the leg has been calm (below half the
threshold) for :data:`REARM_TICKS` judged ticks.  Every swing begins free.  A NaN score changes
nothing.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["REARM_SCORE", "REARM_TICKS", "alarm_ticks"]

REARM_TICKS: Final = 4
REARM_SCORE: Final = 0.5


def alarm_ticks(
    score: NDArray[np.float64], swing: NDArray[np.int64], threshold: float = 1.0
) -> NDArray[np.int64]:
    """Ticks at which a contact is told.

    Args:
        score: (n,), NaN on ticks that are not judged.
        swing: (n,) number of the swing of every tick, -1 in stance.
        threshold: on the score.

    Returns:
        Indices, rising.
    """
    above = np.flatnonzero((score > threshold) & (swing >= 0))
    found: list[int] = []
    n, position = len(score), 0
    while position < len(above):
        tick = int(above[position])
        found.append(tick)
        rearmed = _rearmed(score, swing, tick, n, REARM_SCORE * threshold)
        position = int(np.searchsorted(above, rearmed, side="left"))
    return np.array(found, dtype=np.int64)


def _rearmed(
    score: NDArray[np.float64], swing: NDArray[np.int64], tick: int, n: int, calm_below: float
) -> int:
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
