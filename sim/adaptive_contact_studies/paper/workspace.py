"""Where, and on what motions, a model predicts badly.

One model of the whole workspace, or several: what the paper leaves to an ensemble.

The workspace is cut into eight regions by medians of yaw, reach and height of the foot.  Every
region has one compressed factor, so that any selection of regions is fitted by merging.  Compared
on held-out streams of every leg-run: one model of all regions, a model per region, and, for a
region that training has not seen, one model of all others against that of the nearest region, near
by the distance of region centres: nothing of the unseen region's rows is looked at but where it
lies.  Of the leg of the paper's own dataset also the model of its two subspaces (before).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import t as student

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.fit import Fit, FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import Domain, Factor, Library, LibraryName, Window, leg_library
from adaptive_contact.model.window import Rows
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_sim.pose import WORKSPACES
from adaptive_contact_studies.cache import Store, plain
from adaptive_contact_studies.paper.data import Stream, join, load
from adaptive_contact_studies.paper.identification import shown_condition
from adaptive_contact_studies.paper.plan import LegRun, Piece, Plan, Role
from adaptive_contact_studies.paper.recording import physics_fingerprint, source_fingerprint
from adaptive_contact_studies.paper.rows import (
    NO_MODEL,
    PAPER_WINDOW,
    blockwise,
    factor_of,
    free_rows,
    noise_floor,
    pick,
    residual_unit,
    rms_deg,
    thetas,
    worst,
)

# Grid of the maps, m, over reach and height of the foot.
CELL_M: Final = 0.015
_REACH_M: Final = (0.08, 0.26)
_HEIGHT_M: Final = (-0.145, 0.13)
# Windows in a cell that make a figure.
_MIN_CELL: Final = 15


def cylinder(point: Array) -> Array:
    """(n, 3) yaw, reach, height."""
    yaw = np.arctan2(point[:, 1], point[:, 0])
    return np.stack([yaw, np.hypot(point[:, 0], point[:, 1]), point[:, 2]], axis=1)


def where_it_fails(
    library: Library, fitted: Rows, held: Rows, residual: Array, column: Mask
) -> dict[str, Any]:
    """What distinguishes a model's bad predictions from its good ones: the place, or the motion.

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
    parts = [domain.leverage(theta) for _, theta in thetas(library, windows)]
    return np.concatenate([np.zeros(0), *parts])


def paper_column(point: Array) -> Mask:
    """Mask of feet within the paper's subspaces, or between them, where its segments pass."""
    low, high = WORKSPACES["paper"]
    return replace(low, height_m=(low.height_m[0], high.height_m[1])).holds(point)


def norm_deg(residual: Array) -> float | None:
    """Root mean square over all joints, degrees; None without rows."""
    return float(np.degrees(np.sqrt(np.square(residual).mean()))) if len(residual) else None


def edges_of(span: tuple[float, float]) -> Array:
    """Lower edges of the cells that cover a span; the last may reach beyond it."""
    cells = int(np.ceil((span[1] - span[0]) / CELL_M - 1e-9))
    return np.asarray(span[0] + CELL_M * np.arange(cells))


def map_extent() -> list[float]:
    """Reach and height of the maps' outer edges, m: whole cells, not the spans asked for."""
    ends = [(edges[0], edges[-1] + CELL_M) for edges in map(edges_of, (_REACH_M, _HEIGHT_M))]
    return [float(v) for pair in ends for v in pair]


def residual_map(point: Array, residual: Array) -> list[list[float | None]]:
    """Root mean square over the floor, by height (rows) and reach (columns)."""
    reach = np.hypot(point[:, 0], point[:, 1])
    columns, lines = edges_of(_REACH_M), edges_of(_HEIGHT_M)
    square = np.square(residual).mean(axis=1)
    grid: list[list[float | None]] = []
    for low in lines:
        line: list[float | None] = []
        for left in columns:
            inside = (reach >= left) & (reach < left + CELL_M)
            inside &= (point[:, 2] >= low) & (point[:, 2] < low + CELL_M)
            enough = np.count_nonzero(inside) >= _MIN_CELL
            line.append(float(np.sqrt(square[inside].mean()) / noise_floor()) if enough else None)
        grid.append(line)
    return grid


REGIONS: Final = 8
# λ in units of the residual: an eighth of the data must not keep every term.
_THRESHOLD: Final = 0.1
_ROLES: Final[tuple[Role, ...]] = ("train", "tune", "stand")
_LIBRARIES: Final[tuple[tuple[LibraryName, Window], ...]] = (
    ("servo", Window()),
    ("paper", PAPER_WINDOW),
)
# Pairs of models whose difference is reported over all leg-runs: what is tried, against what.
_DIFFERENCES: Final = {
    "all regions seen": ("one per region", "one model"),
    "region unseen": (
        "region unseen, nearest region's model",
        "region unseen, one model of the others",
    ),
}


def workspace_pieces(plan: Plan, leg_run: LegRun) -> dict[Role, list[Piece]]:
    """The free streams of a leg-run over the whole workspace, by role."""
    return {
        role: [
            p
            for p in plan.pieces(role)
            if p.leg_run == leg_run and p.kind in ("descent", "slow", "forward")
        ]
        for role in _ROLES
    }


def study_leg_run(item: tuple[Path, Plan, LegRun]) -> tuple[str, Any]:
    """Compare the models of one leg-run, unless it was done: a work item for a process.

    Returns:
        The leg-run's name and its tree of figures.
    """
    root, plan, leg_run = item
    store = Store(root)
    pieces = workspace_pieces(plan, leg_run)
    # The paper's dataset is of one leg; only there is a before.
    before = plan.paper_pieces("train")
    if before[0].leg_run != leg_run:
        before = []
    flat = [p for own in (*pieces.values(), before) for p in own]
    key = [physics_fingerprint(), source_fingerprint(), [plain(p) for p in flat]]

    def make() -> dict[str, Any]:
        return compare_regions(
            shipped_robot(),
            [load(store, p) for p in pieces["train"] + pieces["tune"]],
            [load(store, p) for p in pieces["stand"]],
            join([load(store, p) for p in before]) if before else None,
        )

    return leg_run.name, store.tree("workspace", key, make)


def workspace(studies: Mapping[str, Any]) -> dict[str, Any]:
    """Put the leg-runs' figures together.

    Returns:
        A tree of figures, and the maps of the leg-run that has a before.
    """
    mapped = next((n for n, s in studies.items() if s["servo"].get("map_before")), None)
    libraries: dict[str, Any] = {}
    for name, _ in _LIBRARIES:
        own = {run: study[name] for run, study in studies.items()}
        models = dict.fromkeys(m for study in own.values() for m in study["rms_deg"])
        libraries[name] = {
            "rms_deg": {m: _mean([s["rms_deg"].get(m) for s in own.values()]) for m in models},
            "leg_runs": {m: sum(m in s["rms_deg"] for s in own.values()) for m in models},
            "status": {
                m: worst(FitStatus(s["status"][m]) for s in own.values() if m in s["status"]).value
                for m in models
            },
            "difference": {
                what: difference_of([(s["rms_deg"][a], s["rms_deg"][b]) for s in own.values()])
                for what, (a, b) in _DIFFERENCES.items()
            },
            "before": None if mapped is None else own[mapped]["before"],
            "map_before": None if mapped is None else own[mapped]["map_before"],
            "map_after": None if mapped is None else own[mapped]["map_after"],
        }
    return {
        "floor_deg": float(np.degrees(noise_floor())),
        "extent_m": map_extent(),
        "leg_runs": len(studies),
        "mapped": mapped,
        "libraries": libraries,
        "by_leg_run": studies,
    }


def compare_regions(
    robot: Robot, train: Sequence[Stream], test: Sequence[Stream], paper: Stream | None
) -> dict[str, Any]:
    """Compare one model with several on one leg-run, for both libraries."""
    return {n: _compare(robot, n, w, train, test, paper) for n, w in _LIBRARIES}


def _compare(
    robot: Robot,
    name: LibraryName,
    window: Window,
    train: Sequence[Stream],
    test: Sequence[Stream],
    paper: Stream | None,
) -> dict[str, Any]:
    leg = robot.leg(train[0].leg)
    library = leg_library(robot, leg, name, window)
    fitted, held = _joined(train, library), _joined(test, library)
    assert leg.chain is not None
    where = leg.chain.foot(fitted.measured[:, 0])
    tried = leg.chain.foot(held.measured[:, 0])
    edges = np.median(cylinder(where), axis=0)
    region, held_region = _region(where, edges), _region(tried, edges)
    factors = [
        factor_of(library, pick(fitted, region == r), fitted.increment[region == r])
        for r in range(REGIONS)
    ]
    one = _fit(Factor.merged(factors, library.size, 3))
    own = [_fit(factor) for factor in factors]
    others = [
        _fit(Factor.merged((f for i, f in enumerate(factors) if i != r), library.size, 3))
        for r in range(REGIONS)
    ]
    near = [own[i] for i in nearest_regions(where, region)]
    used: dict[str, list[Fit]] = {
        "one model": [one] * REGIONS,
        "one per region": own,
        "region unseen, one model of the others": others,
        "region unseen, nearest region's model": near,
    }
    before: Fit | None = None
    if paper is not None:
        subspaces = free_rows(paper, library).windows
        before = _fit(factor_of(library, subspaces, subspaces.increment))
        used = {"paper's subspaces": [before] * REGIONS, **used}
    residual = {
        what: _residual(library, held, held_region, models) for what, models in used.items()
    }
    status = {what: worst(m.status for m in models) for what, models in used.items()}
    tree: dict[str, Any] = {
        "train_rows": len(fitted.tick),
        "test_rows": len(held.tick),
        "region_rows": [int(np.count_nonzero(region == r)) for r in range(REGIONS)],
        "status": {what: s.value for what, s in status.items()},
        "rms_deg": {
            what: None if status[what] in NO_MODEL else rms_deg(residual[what]) for what in used
        },
        "by_region_deg": {
            what: [norm_deg(residual[what][held_region == r]) for r in range(REGIONS)]
            for what in ("one model", "one per region")
            if status[what] not in NO_MODEL
        },
    }
    if paper is not None and before is not None:
        known = before.status not in NO_MODEL
        left = residual["paper's subspaces"]
        tree["before"] = {
            "status": before.status.value,
            "condition": shown_condition(before.condition),
            **(
                where_it_fails(library, subspaces, held, left, paper_column(tried)) if known else {}
            ),
        }
        tree["map_before"] = residual_map(tried, left) if known else None
        tree["map_after"] = (
            None if one.status in NO_MODEL else residual_map(tried, residual["one model"])
        )
    return tree


def _residual(library: Library, held: Rows, region: Ints, models: Sequence[Fit]) -> Array:
    """(n, J) rad, every window predicted by its region's model."""
    out = np.empty_like(held.increment)
    for r, model in enumerate(models):
        part = pick(held, region == r)
        out[region == r] = part.increment - blockwise(library, part, model.coefficients)
    return out


def nearest_regions(point: Array, region: Ints) -> list[int]:
    """The region whose centre is nearest to each one's.

    Args:
        point: (n, 3) m, places of the foot.
        region: (n,) the region of each.

    Returns:
        (regions,) another one for each.
    """
    centre = np.full((REGIONS, 3), np.nan)
    for r in np.unique(region):
        centre[r] = point[region == r].mean(axis=0)
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    # A region without rows has no centre, and no neighbours.
    distance[~np.isfinite(distance)] = np.inf
    np.fill_diagonal(distance, np.inf)
    return [int(i) for i in distance.argmin(axis=1)]


def _mean(values: Sequence[Sequence[float] | None]) -> list[float] | None:
    """Joint by joint over the leg-runs that have a figure; None where one has no model."""
    known = [v for v in values if v is not None]
    return [float(v) for v in np.mean(known, axis=0)] if known else None


def difference_of(
    pairs: Sequence[tuple[Sequence[float] | None, Sequence[float] | None]],
) -> dict[str, Any]:
    """By how much the first of each pair is above the second, with Student's 95 % interval.

    Args:
        pairs: (J,) errors of both models, of one leg-run each; None where there is no model.

    Returns:
        The mean over leg-runs of the ratio of the mean errors, less one; its interval; in how
        many the first is the smaller.
    """
    ratio = np.array([np.mean(a) / np.mean(b) - 1.0 for a, b in pairs if a and b])
    n = len(ratio)
    mean = float(ratio.mean()) if n else None
    spread = (
        float(student.ppf(0.975, n - 1) * ratio.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    )
    return {
        "leg_runs": n,
        "mean": mean,
        "interval": [None, None] if mean is None else [mean - spread, mean + spread],
        "smaller_in": int(np.count_nonzero(ratio < 0.0)),
    }


def _joined(streams: Sequence[Stream], library: Library) -> Rows:
    parts = [free_rows(s, library).windows for s in streams]
    return Rows(*map(np.concatenate, zip(*parts, strict=True)))


def _region(point: Array, edges: Array) -> Ints:
    above = (cylinder(point) > edges).astype(np.int64)
    return np.asarray(above @ np.array([4, 2, 1]))


def _fit(factor: Factor) -> Fit:
    """The thresholded fit; the plain one where that loses a joint."""
    whole = fit_sparse(factor, FitSettings())
    if whole.status in NO_MODEL:
        return whole
    settings = FitSettings(threshold=_THRESHOLD, unit=residual_unit(whole))
    sparse = fit_sparse(factor, settings)
    return sparse if sparse.status is FitStatus.OK else whole
