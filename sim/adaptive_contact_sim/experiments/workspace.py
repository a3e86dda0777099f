"""One model of the whole workspace, or several: what the paper leaves to an ensemble.

The workspace is cut into eight regions by medians of yaw, reach and height of the foot.  Every
region has one compressed factor, so that any selection of regions is fitted by merging.  Compared
on held-out streams: the model of the paper's two subspaces (before), one model of all regions, a
model per region, and, for a region that training has not seen, one model of all others against the
best other region's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.identify import (
    Factor,
    FitSettings,
    Library,
    LibraryName,
    Window,
    fit_sparse,
    leg_library,
)
from adaptive_contact.identify.window import Rows
from adaptive_contact.robot import Robot, foot
from adaptive_contact_sim.experiments.data import Stream
from adaptive_contact_sim.experiments.identification import PAPER_WINDOW
from adaptive_contact_sim.experiments.rows import (
    blockwise,
    factor_of,
    free_rows,
    noise_floor,
    pick,
    rms_deg,
)

__all__ = ["workspace"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

REGIONS: Final = 8
# Grid of the maps, m, over reach and height of the foot.
_CELL_M: Final = 0.015
_REACH_M: Final = (0.08, 0.26)
_HEIGHT_M: Final = (-0.145, 0.13)
# Windows in a cell that make a figure.
_MIN_CELL: Final = 15
# λ in units of the residual: an eighth of the data must not keep every term.
_THRESHOLD: Final = 0.1


def workspace(
    robot: Robot, paper: Stream, train: Sequence[Stream], test: Sequence[Stream]
) -> dict[str, Any]:
    """Compare one model with several, for both libraries.

    Args:
        robot: whose leg it is.
        paper: the paper's training segments of this leg.
        train: free streams of the same leg over the whole workspace.
        test: others, of other seeds.

    Returns:
        A tree of figures and maps.
    """
    names: tuple[tuple[LibraryName, Window], ...] = (("servo", Window()), ("paper", PAPER_WINDOW))
    return {
        "floor_deg": float(np.degrees(noise_floor())),
        "cell_m": _CELL_M,
        "reach_m": _REACH_M,
        "height_m": _HEIGHT_M,
        "libraries": {n: _compare(robot, n, w, paper, train, test) for n, w in names},
    }


def _compare(
    robot: Robot,
    name: LibraryName,
    window: Window,
    paper: Stream,
    train: Sequence[Stream],
    test: Sequence[Stream],
) -> dict[str, Any]:
    leg = robot.leg(paper.leg)
    library = leg_library(robot, leg, name, window)
    fitted, held = _joined(train, library), _joined(test, library)
    assert leg.lengths_m is not None
    where = foot(fitted.measured[:, 0], leg.lengths_m, leg.joint_axes)
    tried = foot(held.measured[:, 0], leg.lengths_m, leg.joint_axes)
    edges = np.median(_cylinder(where), axis=0)
    region, held_region = _region(where, edges), _region(tried, edges)
    factors = [
        factor_of(library, pick(fitted, region == r), fitted.increment[region == r])
        for r in range(REGIONS)
    ]
    subspaces = free_rows(paper, library).windows
    before = _fit(factor_of(library, subspaces, subspaces.increment))
    one = _fit(Factor.merged(factors, library.size, 3))
    own = [_fit(factor) for factor in factors]
    others = [
        _fit(Factor.merged((f for i, f in enumerate(factors) if i != r), library.size, 3))
        for r in range(REGIONS)
    ]
    residual_before = held.increment - blockwise(library, held, before)
    residual_one = held.increment - blockwise(library, held, one)
    residual_own = np.empty_like(residual_one)
    unseen, neighbour = np.empty_like(residual_one), np.empty_like(residual_one)
    for r in range(REGIONS):
        inside = held_region == r
        part = pick(held, inside)
        residual_own[inside] = part.increment - blockwise(library, part, own[r])
        unseen[inside] = part.increment - blockwise(library, part, others[r])
        # The neighbour is chosen on training rows of the region, the kindest choice there is.
        chosen = min(
            (i for i in range(REGIONS) if i != r), key=lambda i: float(factors[r].rms(own[i]).sum())
        )
        neighbour[inside] = part.increment - blockwise(library, part, own[chosen])
    return {
        "train_rows": len(fitted.tick),
        "test_rows": len(held.tick),
        "region_rows": [int(np.count_nonzero(region == r)) for r in range(REGIONS)],
        "rms_deg": {
            "paper's subspaces": rms_deg(residual_before),
            "one model": rms_deg(residual_one),
            "one per region": rms_deg(residual_own),
            "region unseen, one model of the others": rms_deg(unseen),
            "region unseen, nearest region's model": rms_deg(neighbour),
        },
        "by_region_deg": {
            "one model": [_norm(residual_one[held_region == r]) for r in range(REGIONS)],
            "one per region": [_norm(residual_own[held_region == r]) for r in range(REGIONS)],
        },
        "map_before": _map(tried, residual_before),
        "map_after": _map(tried, residual_one),
    }


def _joined(streams: Sequence[Stream], library: Library) -> Rows:
    parts = [free_rows(s, library).windows for s in streams]
    return Rows(
        np.concatenate([p.measured for p in parts]),
        np.concatenate([p.desired for p in parts]),
        np.concatenate([p.preview for p in parts]),
        np.concatenate([p.increment for p in parts]),
        np.concatenate([p.tick for p in parts]),
    )


def _cylinder(point: Array) -> Array:
    """(n, 3) yaw, reach, height."""
    yaw = np.arctan2(point[:, 1], point[:, 0])
    return np.stack([yaw, np.hypot(point[:, 0], point[:, 1]), point[:, 2]], axis=1)


def _region(point: Array, edges: Array) -> Ints:
    above = (_cylinder(point) > edges).astype(np.int64)
    return np.asarray(above @ np.array([4, 2, 1]))


def _fit(factor: Factor) -> Array:
    """Coefficients of the thresholded fit; of the plain one where that loses a joint."""
    plain = fit_sparse(factor, FitSettings())
    unit = tuple(np.maximum(plain.rms, 1e-9).tolist())
    fit = fit_sparse(factor, FitSettings(threshold=_THRESHOLD, unit=unit))
    return fit.coefficients if fit.status == "ok" else plain.coefficients


def _norm(residual: Array) -> float | None:
    """Root mean square over all joints, degrees; None without rows."""
    return float(np.degrees(np.sqrt(np.square(residual).mean()))) if len(residual) else None


def _map(point: Array, residual: Array) -> list[list[float | None]]:
    """Root mean square over the floor, by height (rows) and reach (columns)."""
    reach = np.hypot(point[:, 0], point[:, 1])
    columns = np.arange(*_REACH_M, _CELL_M)
    lines = np.arange(*_HEIGHT_M, _CELL_M)
    square = np.square(residual).mean(axis=1)
    grid: list[list[float | None]] = []
    for low in lines:
        line: list[float | None] = []
        for left in columns:
            inside = (reach >= left) & (reach < left + _CELL_M)
            inside &= (point[:, 2] >= low) & (point[:, 2] < low + _CELL_M)
            enough = np.count_nonzero(inside) >= _MIN_CELL
            line.append(float(np.sqrt(square[inside].mean()) / noise_floor()) if enough else None)
        grid.append(line)
    return grid
