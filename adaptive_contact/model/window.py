r"""Defines the window of recent samples that one prediction rests on.

.. math:: x[k] = (\theta[k], \dots, \theta[k-N]), \quad
          u[k] = (\theta^{des}[k+M], \dots, \theta^{des}[k], \dots, \theta^{des}[k-N'])

(the paper's Eq. 6 and 7).  Lag 0 comes first, so that index i is lag i in every array.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.errors import ConfigurationError


@dataclasses.dataclass(frozen=True)
class Window:
    """Sets how far a model looks: N past positions, N' past and M future commands."""

    past_measured: int = 3
    past_desired: int = 3
    preview: int = 0

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not 0 <= value <= 20:
                raise ConfigurationError(f"window: {name} is {value}; expected 0 to 20 ticks")

    @property
    def length(self) -> int:
        """Return the number of consecutive samples needed before the first prediction."""
        return 1 + max(self.past_measured, self.past_desired)


class Rows(NamedTuple):
    """Holds windows cut from a stream, each with what came next."""

    measured: Array  # (n, N + 1, J) rad, lag 0 first
    desired: Array  # (n, N' + 1, J) rad, lag 0 first
    preview: Array  # (n, M, J) rad, the next command first
    increment: Array  # (n, J) rad, measured[k + 1] - measured[k], what a model predicts
    tick: Ints  # (n,) the index k of each row in the stream


def stack(measured: Array, desired: Array, window: Window) -> Rows:
    """Cut every window out of one unbroken stream.

    Args:
        measured: (n, J) rad, one row per control tick, no gaps.
        desired: (n, J) rad, the command written at that tick.
        window: how far to look.

    Returns:
        One row for each tick k with a full past, a full preview and a successor.
    """
    n, joints = measured.shape
    first = window.length - 1
    last = n - 1 - max(1, window.preview)
    if last < first:
        return Rows(
            np.empty((0, window.past_measured + 1, joints)),
            np.empty((0, window.past_desired + 1, joints)),
            np.empty((0, window.preview, joints)),
            np.empty((0, joints)),
            np.empty(0, dtype=np.int64),
        )
    tick = np.arange(first, last + 1)

    def lags(values: Array, depth: int) -> Array:
        # (n - depth, J, depth + 1), oldest first -> lag first.
        view = sliding_window_view(values, depth + 1, axis=0)
        return np.ascontiguousarray(view[tick - depth][:, :, ::-1].transpose(0, 2, 1))

    ahead = tick[:, None] + np.arange(1, window.preview + 1)[None, :]
    return Rows(
        measured=lags(measured, window.past_measured),
        desired=lags(desired, window.past_desired),
        preview=desired[ahead],
        increment=measured[tick + 1] - measured[tick],
        tick=tick,
    )
