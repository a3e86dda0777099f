"""Resident memory of a process over its life: its growth and its slope.

Growth after the warm-up tells a service that swells; it cannot tell one that fills its buffers
and stays from one that leaks, for the same few MB may be either.  The slope of the last half of
a life can: a plateau has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

_BLOCK_S: Final = 10.0
# The last half of a life must be so long to have a slope: in less, one buffer is a leak.
_SLOPE_S: Final = 300.0
_EDGE: Final = 0.2  # of a life, at its begin and at its end, whose medians are compared
_FEWEST: Final = 5
_MOST: Final = 500
_QUANTILE: Final = 0.4


class Resident(NamedTuple):
    """Resident memory of a service, MB, so many seconds after its start; ``life`` counts them."""

    life: int
    after_s: float
    mb: float


class Grown(NamedTuple):
    """What memory did in one life.

    Attributes:
        growth_mb: from the end of the warm-up to the end, between medians.
        last_mb: at the end.
        slope_mb_min: of the last half, None where that is shorter than five minutes.
    """

    growth_mb: float
    last_mb: float
    slope_mb_min: float | None


def grown(resident: Sequence[Resident], warm_up_s: float) -> list[Grown]:
    """Growth of each life after the warm-up, for those long enough to have one."""
    found = []
    for life in range(max((one.life for one in resident), default=-1) + 1):
        rows = [(one.after_s, one.mb) for one in resident if one.life == life]
        mb = [mb for after_s, mb in rows if after_s >= warm_up_s]
        if len(mb) >= _FEWEST:
            edge = max(2, int(_EDGE * len(mb)))
            growth = float(np.median(mb[-edge:]) - np.median(mb[:edge]))
            half = [row for row in rows if row[0] >= rows[-1][0] / 2.0]
            found.append(Grown(growth, mb[-1], slope_of(half)))
    return found


def slope_of(rows: Sequence[tuple[float, float]]) -> float | None:
    """Slope of memory over time, MB/min.

    A quantile of the slopes between any two points (Theil 1950, Sen 1968), a little below the
    median: half of the pairs at most see one step, such as a buffer that doubles, and that is no
    slope; a staircase has nearly that of its ramp.

    Args:
        rows: s and MB, in order of time.

    Returns:
        The slope, or None where they span less than five minutes.
    """
    if not rows or rows[-1][0] - rows[0][0] < _SLOPE_S:
        return None
    # A day has more pairs of points than memory has room for.
    block_s = max(_BLOCK_S, (rows[-1][0] - rows[0][0]) / _MOST)
    blocks: dict[int, list[tuple[float, float]]] = {}
    for row in rows:
        blocks.setdefault(int(row[0] / block_s), []).append(row)
    coarse = np.array([np.median(block, axis=0) for _, block in sorted(blocks.items())])
    first, second = np.triu_indices(len(coarse), 1)
    rise = coarse[second] - coarse[first]
    return 60.0 * float(np.quantile(rise[:, 1] / rise[:, 0], _QUANTILE))
