"""Estimates the step of a servo's positions, from readings alone.

Neighbours of the values that a joint reads are whole steps apart.  Readings that lie between the
lines, as those corrected to their tick's moment, hardly ever repeat; so those that repeat are
looked at where there are enough.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from adaptive_contact.arrays import Array

# Least number of values that repeat, and of gaps between values, that show a step; its range, rad.
_REPEATED: Final = 24
_LEAST_GAPS: Final = 12
LEAST_STEP_RAD: Final = 4e-4
_MOST_STEP_RAD: Final = 0.1
# Gaps off a whole number of steps by less than a tenth: of any value one in five is by chance.  Of
# a grid so many are, by whether values have repeated.
_NEAR: Final = 0.1
_SHARE: Final = {True: 0.85, False: 0.95}
STEP_TOLERANCE: Final = 0.05


def position_step(angles: Array) -> float | None:
    """Find the grid that a joint's readings lie on.

    Args:
        angles: (n,) rad.

    Returns:
        The step in rad; None where there are too few different readings, or none is found.
    """
    values, times = np.unique(np.round(angles, 6), return_counts=True)
    again = values[times > 1]
    repeated = len(again) >= _REPEATED
    gaps = np.diff(again if repeated else values)
    gaps = gaps[gaps > LEAST_STEP_RAD]
    if len(gaps) < _LEAST_GAPS:
        return None
    # The largest first: what is whole in a step is so in its fractions, which a stray gap is.
    for step in np.unique(gaps[gaps < _MOST_STEP_RAD])[::-1]:
        steps = np.round(gaps / step)
        whole = (steps > 0) & (np.abs(gaps / step - steps) < _NEAR)
        if whole.mean() >= _SHARE[repeated]:
            return float(gaps[whole].sum() / steps[whole].sum())
    return None
