"""Where, and on what motions, a model predicts badly."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.model import Domain, Library
from adaptive_contact.model.window import Rows
from adaptive_contact_sim.workspace import WORKSPACES
from adaptive_contact_studies.paper.rows import BLOCK, factor_of, noise_floor

__all__ = [
    "cylinder",
    "map_extent",
    "norm_deg",
    "paper_column",
    "residual_map",
    "where_it_fails",
]

Array = NDArray[np.float64]

# Grid of the maps, m, over reach and height of the foot.
_CELL_M: Final = 0.015
_REACH_M: Final = (0.08, 0.26)
_HEIGHT_M: Final = (-0.145, 0.13)
# Windows in a cell that make a figure.
_MIN_CELL: Final = 15


def cylinder(point: Array) -> Array:
    """(n, 3) yaw, reach, height."""
    yaw = np.arctan2(point[:, 1], point[:, 0])
    return np.stack([yaw, np.hypot(point[:, 0], point[:, 1]), point[:, 2]], axis=1)


def where_it_fails(
    library: Library, fitted: Rows, held: Rows, residual: Array, column: NDArray[np.bool_]
) -> dict[str, Any]:
    """What tells a model's bad predictions from its good ones: the place, or the motion.

    Args:
        library: the terms.
        fitted: windows it was fitted to.
        held: n windows it predicts.
        residual: (n, J) rad of those.
        column: (n,) mask of feet at places that were fitted to.

    Returns:
        Errors in degrees, of windows at known places and elsewhere, and of windows whose
        regressors together (their leverage) lie within and beyond all that was fitted to; the
        largest change of a command per tick, 99 % of either.
    """
    factor = factor_of(library, fitted, fitted.increment)
    domain = Domain.of(factor, factor.scale())
    known = _leverage(library, domain, held) <= _leverage(library, domain, fitted).max()
    step = [
        float(np.degrees(np.quantile(np.abs(w.desired[:, 0] - w.desired[:, 1]).max(axis=1), 0.99)))
        for w in (fitted, held)
    ]
    return {
        "inside_deg": norm_deg(residual[column]),
        "outside_deg": norm_deg(residual[~column]),
        "known_share": float(known.mean()) if len(known) else None,
        "known_deg": norm_deg(residual[known]),
        "unknown_deg": norm_deg(residual[~known]),
        "command_step_deg": step,
    }


def _leverage(library: Library, domain: Domain, windows: Rows) -> Array:
    """(n,) how far each window's regressors lie from those of a fit."""
    out = np.empty(len(windows.tick))
    for start in range(0, len(out), BLOCK):
        part = slice(start, start + BLOCK)
        theta = library.evaluate(
            windows.measured[part], windows.desired[part], windows.preview[part]
        )
        out[part] = domain.leverage(theta)
    return out


def paper_column(point: Array) -> NDArray[np.bool_]:
    """Mask of feet within the paper's subspaces, or between them, where its segments pass."""
    low, high = WORKSPACES["paper"]
    yaw, reach, height = cylinder(point).T
    inside = (yaw >= low.yaw_rad[0]) & (yaw <= low.yaw_rad[1])
    inside &= (reach >= low.reach_m[0]) & (reach <= low.reach_m[1])
    return np.asarray(inside & (height >= low.height_m[0]) & (height <= high.height_m[1]))


def norm_deg(residual: Array) -> float | None:
    """Root mean square over all joints, degrees; None without rows."""
    return float(np.degrees(np.sqrt(np.square(residual).mean()))) if len(residual) else None


def _edges(span: tuple[float, float]) -> Array:
    """Lower edges of the cells that cover a span; the last may reach beyond it."""
    cells = int(np.ceil((span[1] - span[0]) / _CELL_M - 1e-9))
    return np.asarray(span[0] + _CELL_M * np.arange(cells))


def map_extent() -> list[float]:
    """Reach and height of the maps' outer edges, m: whole cells, not the spans asked for."""
    ends = [(edges[0], edges[-1] + _CELL_M) for edges in map(_edges, (_REACH_M, _HEIGHT_M))]
    return [float(v) for pair in ends for v in pair]


def residual_map(point: Array, residual: Array) -> list[list[float | None]]:
    """Root mean square over the floor, by height (rows) and reach (columns)."""
    reach = np.hypot(point[:, 0], point[:, 1])
    columns, lines = _edges(_REACH_M), _edges(_HEIGHT_M)
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
