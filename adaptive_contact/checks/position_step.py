"""Estimates the step of a servo's positions, from readings alone."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array

# Least number of different readings that show a step, and the range of steps, rad.
_STEP_READINGS: Final = 24
LEAST_STEP_RAD: Final = 4e-4
_MOST_STEP_RAD: Final = 0.1
_STEP_SHARE: Final = 0.85  # of readings on one grid; of a grid at random it is below 0.5
# Least number of lines that show a grid.  Of 1,000 grids one fits some resting places of a joint
# without steps by chance: each place is near a line in one case of five, ten more in one of 10^7.
_LEAST_LINES: Final = 12
STEP_TOLERANCE: Final = 0.05
# Most readings that are examined: they show a grid as well as those of an hour.
_MOST_VALUES: Final = 400
# Width of the bins: an eighth of the least step.  It lowers the finest grid's mean to 0.974;
# densities are an eighth of a peak's half width apart, or less.
_BIN_RAD: Final = LEAST_STEP_RAD / 8.0


def position_step(angles: Array, expected_rad: float | None = None) -> float | None:
    """Find the grid that a joint's readings lie on.

    For each step q the readings' phases 2π x / q are averaged as unit vectors: on a grid of q, or
    of a multiple, the mean has length 1, elsewhere near 0.  The largest q of length near 1 is the
    step; an offset and rounding to fewer decimals do not matter.  Readings that lie between the
    lines do not make the step finer.

    Args:
        angles: (n,) rad.
        expected_rad: looked at first; what is coarser is searched, and what is finer only where
            readings do not lie on this one.

    Returns:
        The step in rad; None where there are too few different readings, or none is found.
    """
    values, times = np.unique(angles, return_counts=True)
    # Readings on a line repeat; those between two lines hardly ever do.
    again = values[times > 1]
    if len(again) >= _STEP_READINGS:
        values = again
    # Readings within two turns are examined, one per cell: a place where a joint rests counts no
    # more than one it passes.
    values = values[values < values[:1] + (4.0 * math.pi)]
    cells = np.floor(values / (LEAST_STEP_RAD / 2.0))
    values = values[np.unique(cells, return_index=True)[1]]
    if len(values) > _MOST_VALUES:
        # At irregular places: every second reading of a grid lies on one twice as coarse.
        places = np.arange(_MOST_VALUES) * ((math.sqrt(5.0) - 1.0) / 2.0) % 1.0 * len(values)
        values = values[np.unique(places.astype(int))]
    if len(values) < _STEP_READINGS:
        return None
    span = float(values[-1] - values[0])
    coarse, fine = 1.0 / _MOST_STEP_RAD, 1.0 / LEAST_STEP_RAD
    if expected_rad is None or expected_rad <= (1.0 + STEP_TOLERANCE) * LEAST_STEP_RAD:
        found = _on_grid(values, coarse, fine, _STEP_SHARE)
        return None if found is None else _multiple(values, found, span, None)
    until = (1.0 + STEP_TOLERANCE) / expected_rad
    found = _on_grid(values, coarse, until, _STEP_SHARE)
    if found is not None:
        return found
    # A step finer than robot.toml says must fit nearly all readings.  Readings between the lines
    # (corrected to their tick's moment, interpolated) are near lines of a half, a third or a sixth
    # of the step where they are few.  Of AX-12A on a busy computer up to a third are such.
    found = _on_grid(values, until, fine, 0.95)
    return None if found is None else _multiple(values, found, span, expected_rad)


def _multiple(values: Array, step_rad: float, span: float, expected_rad: float | None) -> float:
    """Return the largest multiple of a grid's step, or the expected one, that values lie on.

    The step itself where every multiple holds as many values as it would by chance.
    """
    if expected_rad is None:
        most = min(_MOST_STEP_RAD, span / (_LEAST_LINES - 1))
        multiples = list(range(int(most / step_rad), 1, -1))
    else:
        k = round(expected_rad / step_rad)
        near = k > 1 and abs(k * step_rad / expected_rad - 1.0) <= STEP_TOLERANCE
        multiples = [k] if near else []
    # No multiple of it may hold more readings than a grid's every k-th line does, but for one
    # case in so many: n phases at random have a mean longer than sqrt(2 ln(1/p) / n) with less than
    # p, also where there are but two phases.
    chance = 1e-2 / max(len(multiples), 1)
    by_chance = math.sqrt(2.0 * math.log(1.0 / chance) / len(values))
    centred = values - values.mean()
    for k in multiples:
        # The step was found to a part of a line over the whole span; so is its multiple.
        density = 1.0 / (k * step_rad) + np.linspace(-1.0, 1.0, 9) / (8.0 * span)
        length = np.abs(np.exp(2j * math.pi * np.outer(density, centred)).mean(axis=1))
        if length.max() > by_chance:
            return float(1.0 / density[np.argmax(length)])
    return step_rad


def _on_grid(values: Array, least: float, most: float, share: float) -> float | None:
    """Return the first grid, of ``least`` to ``most`` steps per rad, with enough values on it."""
    bins = np.bincount(((values - values[0]) / _BIN_RAD).astype(int))
    count = 1 << (8 * len(bins)).bit_length()
    length = np.abs(np.fft.rfft(bins, count)) / len(values)
    per_index = 1.0 / (count * _BIN_RAD)
    begin, end = math.ceil(least / per_index), math.ceil(most / per_index)
    tried = 0
    for k in np.flatnonzero(length[begin:end] > 0.97 * share) + begin:
        peak = int(k + np.argmax(length[k : k + 16]))
        if peak > tried and _by_lines(peak * per_index * values) > share:
            return 1.0 / (peak * per_index)
        tried = peak
    return None


def _by_lines(turns: Array) -> float:
    """Return the length of the mean phase vector, every line counted once; 0 of too few lines.

    Args:
        turns: (n,) readings in steps of the grid.
    """
    vectors = np.exp(2j * math.pi * turns)
    at = np.rint(turns - np.angle(vectors.mean()) / math.tau)
    _, line = np.unique(at, return_inverse=True)
    counts = np.bincount(line)
    if len(counts) < _LEAST_LINES:
        return 0.0
    real, imag = (np.bincount(line, part) / counts for part in (vectors.real, vectors.imag))
    return float(np.hypot(real.mean(), imag.mean()))
