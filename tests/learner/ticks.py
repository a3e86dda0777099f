"""Ticks to learn from, one by one, and the rows they make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.model.labelled_swing import NO_ROWS, ROW, Rows

Array = NDArray[np.float64]


class Tick(NamedTuple):
    """One row, with what was known of it."""

    theta: Array
    target: Array
    nis: float = 1.0
    value: float = 1.0
    context: int = 0
    t_ns: int = 0
    lift: bool = True
    was_free: bool = True
    cleared: bool = True
    ratio: float = 0.1


def rows_of(ticks: Sequence[Tick]) -> Rows:
    """The rows of ticks."""
    if not ticks:
        return NO_ROWS
    known = np.zeros(len(ticks), dtype=ROW)
    for name in ("nis", "value", "ratio", "context", "t_ns", "lift", "was_free", "cleared"):
        known[name] = [getattr(tick, name) for tick in ticks]
    target = np.array([tick.target for tick in ticks])
    values = np.concatenate([np.array([tick.theta for tick in ticks]), target, target], axis=1)
    return Rows(values, known, target.shape[1])
