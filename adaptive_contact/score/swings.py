"""Swings of a leg: runs of swing samples, the lift of each, and the ticks that follow its turn."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]
Flags = NDArray[np.bool_]

# A hole this long in the samples (in median ticks) ends a swing: what happened inside is unknown.
GAP_TICKS: Final = 10
# The lift is over once the command comes this close to the highest point of its swing.  A swing's
# top is flat: its last ticks rise by fractions of a millimetre.
TOP_M: Final = 0.001
# A gait says "stance" when it plans to touch; for so many ticks the foot may be on its way.
AFTER_TICKS: Final = 16


class Swings(NamedTuple):
    """Swings in order of time.

    Attributes:
        start: (s,) index of the first swing sample.
        stop: (s,) index after the last one.
        of_tick: (n,) which swing a sample belongs to, -1 in stance.
        after_tick: (n,) which swing a sample follows, up to 16 ticks after its turn to stance; -1
            elsewhere.
    """

    start: Index
    stop: Index
    of_tick: Index
    after_tick: Index


def longest_gap(t_ns: NDArray[np.int64]) -> int:
    """Longest time between two samples, ns, that still counts as one stretch."""
    if len(t_ns) < 2:
        return 0
    return int(GAP_TICKS * np.median(np.diff(t_ns)))


def find_swings(t_ns: NDArray[np.int64], swing: Flags) -> Swings:
    """Split a leg's samples into swings.

    Args:
        t_ns: (n,) strictly increasing.
        swing: (n,) whether the sample's tick is commanded swing.

    Returns:
        The maximal runs of swing samples without a gap longer than :func:`longest_gap`.
    """
    n = len(t_ns)
    if n == 0:
        nothing = np.zeros(0, np.int64)
        return Swings(nothing, nothing, nothing, nothing)
    broken = np.concatenate(([True], np.diff(t_ns) > longest_gap(t_ns)))
    before = np.concatenate(([False], swing[:-1]))
    begins = swing & (broken | ~before)
    start = np.flatnonzero(begins)
    after = np.concatenate((~swing[1:] | broken[1:], [True]))
    stop = np.flatnonzero(swing & after) + 1
    newest = np.cumsum(begins) - 1
    of_tick = np.where(swing, newest, -1)
    after_tick = np.full(n, -1)
    if len(start):
        # A swing that a hole in the samples ends was not seen to turn.
        last = stop[newest] - 1
        stretch = np.cumsum(broken)
        follows = (newest >= 0) & ~swing & (stretch == stretch[last])
        follows &= np.arange(n) - last <= AFTER_TICKS
        after_tick[follows] = newest[follows]
    return Swings(start, stop, of_tick, after_tick)


def lift_by_height(swings: Swings, height_m: NDArray[np.float64]) -> Flags:
    """Lift ticks from the height of the command.

    Args:
        swings: of n samples.
        height_m: (n,) m, height of the commanded foot position.

    Returns:
        (n,) True from a swing's first tick until the command first comes within a millimetre of
        the highest it reaches in that swing.
    """
    n = len(swings.of_tick)
    if len(swings.start) == 0:
        return np.zeros(n, dtype=bool)
    in_swing = swings.of_tick >= 0
    # Ticks of stance lie between the starts of two swings; they are given values that never win.
    top = np.maximum.reduceat(np.where(in_swing, height_m, -np.inf), swings.start)
    near = in_swing & (height_m >= top[swings.of_tick] - TOP_M)
    ticks = np.arange(n)
    first_near = np.minimum.reduceat(np.where(near, ticks, n), swings.start)
    return in_swing & (ticks < first_near[swings.of_tick])


def lift_by_halves(swings: Swings) -> Flags:
    """Lift ticks where the leg's geometry is not known: the first half of every swing, (n,)."""
    half = (swings.start + swings.stop) // 2
    if len(half) == 0:
        return np.zeros(len(swings.of_tick), dtype=bool)
    return (swings.of_tick >= 0) & (np.arange(len(swings.of_tick)) < half[swings.of_tick])
