"""Detection over the whole workspace: every detector's figures on the same streams."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.detect.baseline_events import alarm_ticks
from adaptive_contact.robot import ROBOT_HOUR_TICKS, shipped_robot
from adaptive_contact.score import (
    ROWS,
    Events,
    LegOutcome,
    LegStream,
    Row,
    RowFigures,
    Summary,
    clopper_pearson,
    find_swings,
    match,
    poisson_mean,
    summarise,
)
from adaptive_contact_sim.evaluate import leg_stream
from adaptive_contact_sim.experiments.data import load
from adaptive_contact_sim.experiments.detectors import DETECTORS
from adaptive_contact_sim.experiments.evaluation import (
    AIM,
    FACTORS,
    MODELS,
    default_events,
    jobs_of,
    read_job,
)
from adaptive_contact_sim.experiments.models import learned
from adaptive_contact_sim.experiments.plan import Piece, Plan, Role
from adaptive_contact_sim.experiments.store import Store

__all__ = ["DEFAULT", "detection"]

Array = NDArray[np.float64]

DEFAULT: Final = "default"
# Kinds of touches on hard ground at speed, over which ROC curves are swept.
_ROC_KINDS: Final = ("hard", "hard forward")
_SPEED_EDGES_M_S: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 2.5)
_FORCE_EDGES_N: Final = (0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 13.0, 60.0)
_SHOWN_MISSES: Final = 60


class _Touched(NamedTuple):
    """A stream with contacts, and what every detector says of it."""

    piece: Piece
    truth: LegStream
    swing: NDArray[np.int64]
    descending: NDArray[np.bool_]
    scores: dict[str, Array]
    events: Events


def detection(
    root: Path, plan: Plan, progress: Callable[[float], None] = lambda _: None
) -> dict[str, Any]:
    """Gather the evaluated streams into figures.

    Args:
        root: the store's folder; streams not evaluated yet are evaluated now.
        plan: what was simulated.
        progress: told of every detector that is scored.

    Returns:
        A tree of figures.
    """
    store = Store(root)
    known = learned(store, plan)
    quiet = {role: _quiet(root, plan, role) for role in ("free", "stand")}
    touched = _touched(store, root, plan)
    figures: dict[str, Any] = {}
    outcomes: dict[str, list[LegOutcome]] = {}
    for name in (DEFAULT, *DETECTORS):
        outcomes[name] = [_outcome(t, name) for t in touched]
        figures[name] = _figures(name, touched, outcomes[name], quiet)
        progress(1.0)
    figures[DEFAULT]["misses"] = _misses(touched, outcomes)
    return {
        "detectors": {DEFAULT: "default: servo law, likelihood ratio, online"}
        | {name: d.title for name, d in DETECTORS.items()},
        "figures": figures,
        "residual_deg": _residual_figures(quiet),
        "learned": {k: v for k, v in known.figures.items() if k != "legs"},
        "leg_runs": len(plan.leg_runs),
        "legs": known.figures["legs"],
        "edges": {"speed_m_s": _SPEED_EDGES_M_S, "force_n": _FORCE_EDGES_N},
        "aim_per_hour": known.bench.aim_per_hour,
    }


def _quiet(root: Path, plan: Plan, role: Role) -> dict[str, Any]:
    """Sums over the free streams of a role."""
    total: dict[str, Any] = {
        "ticks": 0,
        "alarms": {},
        "squares": {},
        "rows": Counter(),
        "kinds": {},
    }
    for name in DETECTORS:
        total["alarms"][name] = np.zeros(len(FACTORS), dtype=np.int64)
    total["alarms"][DEFAULT] = 0
    for model in MODELS:
        total["squares"][model] = np.zeros(3)
    for job in jobs_of(root, plan, plan.pieces(role)):
        result = read_job(job)
        for index, piece in enumerate(job.pieces):
            prefix = f"{index}/"
            ticks = int(result[prefix + "swing"])
            total["ticks"] += ticks
            alarms = int(np.count_nonzero(result[prefix + "default/contact"]))
            total["alarms"][DEFAULT] += alarms
            kind = total["kinds"].setdefault(piece.kind, {"ticks": 0, "alarms": 0})
            kind["ticks"] += ticks
            kind["alarms"] += alarms
            for name in DETECTORS:
                sweep = result[f"{prefix}alarms/{name}"]
                both = total["alarms"][name]
                # A threshold too low to be counted on one stream is too low on all.
                total["alarms"][name] = np.where((sweep < 0) | (both < 0), -1, both + sweep)
            for model in MODELS:
                total["squares"][model] += result[f"{prefix}squares/{model}"]
                total["rows"][model] += int(result[f"{prefix}rows/{model}"])
    return total


def _touched(store: Store, root: Path, plan: Plan) -> list[_Touched]:
    robot = shipped_robot()
    found = []
    for job in jobs_of(root, plan, plan.pieces("touch")):
        result = read_job(job)
        for index, piece in enumerate(job.pieces):
            stream = load(store, piece)
            found.append(
                _Touched(
                    piece,
                    leg_stream(stream.run, stream.leg, robot),
                    find_swings(stream.run.t_ns, stream.swing).of_tick,
                    result[f"{index}/descending"],
                    {n: result[f"{index}/score/{n}"].astype(np.float64) for n in DETECTORS},
                    default_events(result, index),
                )
            )
    return found


def _outcome(touched: _Touched, name: str, factor: float = 1.0) -> LegOutcome:
    if name == DEFAULT:
        return match(touched.truth, touched.events)
    ticks = alarm_ticks(touched.scores[name], touched.swing, factor, touched.descending)
    t_ns = touched.truth.t_ns[ticks]
    return match(touched.truth, Events(t_ns, np.ones(len(t_ns), dtype=bool), t_ns))


def _figures(
    name: str,
    touched: Sequence[_Touched],
    outcomes: Sequence[LegOutcome],
    quiet: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    summary = summarise(outcomes)
    kinds = list(dict.fromkeys(t.piece.kind for t in touched))
    by_kind = {
        kind: _row(
            summarise([o for o, t in zip(outcomes, touched, strict=True) if t.piece.kind == kind]),
            kind,
        )
        for kind in kinds
    }
    alarms = {}
    for role, total in quiet.items():
        count = total["alarms"][name] if name == DEFAULT else total["alarms"][name][AIM]
        alarms[role] = _rate(int(count), total["ticks"])
    counts = [alarms[role]["count"] for role in quiet]
    alarms["all"] = _rate(
        -1 if min(counts) < 0 else sum(counts), sum(t["ticks"] for t in quiet.values())
    )
    alarms["touch"] = _rate(summary.false_alarms, summary.judged_ticks)
    figures: dict[str, Any] = {
        "summary": _summary(summary),
        "kinds": by_kind,
        "false_alarms": alarms,
        "by_speed": _binned(outcomes, "speed_m_s", _SPEED_EDGES_M_S, (Row.SOFT, Row.GRAZING)),
        "by_force": _binned(outcomes, "force_n", _FORCE_EDGES_N, (Row.GRAZING,)),
        "headline_kinds": _headline_kinds(touched, outcomes),
    }
    if name == DEFAULT:
        figures["free_kinds"] = {
            role: {k: _rate(v["alarms"], v["ticks"]) for k, v in total["kinds"].items()}
            for role, total in quiet.items()
        }
    else:
        figures["roc"] = _roc(name, touched, quiet)
    return figures


def _summary(summary: Summary) -> dict[str, Any]:
    """What tables show of a summary."""
    return {
        "rows": {row.value: _row_figures(figures) for row, figures in summary.rows.items()},
        "counted": _row_figures(summary.counted),
        "precision": summary.precision,
        "precision_interval": list(summary.precision_interval),
        "neutral": summary.neutral,
        "outside": summary.outside,
        "swings": summary.swings,
    }


def _row_figures(figures: RowFigures) -> dict[str, Any]:
    latency = figures.latency
    return {
        "touches": figures.touches,
        "found": figures.found,
        "recall": figures.recall,
        "interval": list(figures.interval),
        "median_ms": latency.median_ms if latency else None,
        "p95_ms": latency.p95_ms if latency else None,
        "p99_ms": latency.p99_ms if latency else None,
        "onset_error_ms": figures.onset_error_ms,
    }


def _row(summary: Summary, kind: str) -> dict[str, Any]:
    """Recall of one kind of streams: all its touches that are counted, or the grazing ones."""
    figures = summary.rows.get(Row.GRAZING) if kind == "graze" else None
    return _row_figures(figures or summary.counted)


def _rate(count: int, ticks: int) -> dict[str, Any]:
    """Alarms per robot-hour; a count of -1 means a threshold too low to be counted."""
    hours = ticks / ROBOT_HOUR_TICKS
    low, high = poisson_mean(count) if count >= 0 else (float("nan"), float("nan"))
    return {
        "count": count,
        "hours": hours,
        "per_hour": count / hours if hours and count >= 0 else None,
        "interval": [low / hours, high / hours] if hours else [None, None],
    }


def _roc(
    name: str, touched: Sequence[_Touched], quiet: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Headline recall against false alarms per robot-hour, over the swept thresholds."""
    ticks = sum(total["ticks"] for total in quiet.values())
    fast = [t for t in touched if t.piece.kind in _ROC_KINDS]
    points = []
    for i, factor in enumerate(FACTORS):
        counts = [int(total["alarms"][name][i]) for total in quiet.values()]
        if min(counts) < 0:
            continue
        summary = summarise([_outcome(t, name, float(factor)) for t in fast])
        row = summary.rows[Row.HEADLINE]
        points.append(
            {
                "factor": float(factor),
                "per_hour": sum(counts) / (ticks / ROBOT_HOUR_TICKS) if ticks else None,
                "recall": row.recall,
                "median_ms": row.latency.median_ms if row.latency else None,
            }
        )
    return points


def _binned(
    outcomes: Sequence[LegOutcome], field: str, edges: Sequence[float], without: tuple[Row, ...]
) -> list[dict[str, Any]]:
    """Recall by a property of the touch; lift and late touches are never counted."""
    left_out = [ROWS.index(row) for row in (*without, Row.LIFT, Row.LATE, Row.UNKNOWN)]
    value = np.concatenate([getattr(o.touches, field) for o in outcomes])
    found = np.concatenate([o.touches.found for o in outcomes])
    row = np.concatenate([o.touches.row for o in outcomes])
    latency = np.concatenate([o.touches.latency_ns for o in outcomes]) / 1e6
    use = ~np.isin(row, left_out)
    bins = []
    for low, high in itertools.pairwise(edges):
        inside = use & (value >= low) & (value < high)
        hits, total = int(np.count_nonzero(found & inside)), int(np.count_nonzero(inside))
        median = float(np.median(latency[found & inside])) if hits else None
        bins.append(
            {
                "low": low,
                "high": high,
                "touches": total,
                "found": hits,
                "recall": hits / total if total else None,
                "interval": list(clopper_pearson(hits, total)),
                "median_ms": median,
            }
        )
    return bins


def _headline_kinds(
    touched: Sequence[_Touched], outcomes: Sequence[LegOutcome]
) -> dict[str, dict[str, Any]]:
    """The headline row by kind of stream."""
    found: dict[str, dict[str, Any]] = {}
    for kind in dict.fromkeys(t.piece.kind for t in touched):
        own = summarise([o for o, t in zip(outcomes, touched, strict=True) if t.piece.kind == kind])
        row = own.rows.get(Row.HEADLINE)
        if row is not None and row.touches:
            found[kind] = _row_figures(row)
    return found


def _misses(
    touched: Sequence[_Touched], outcomes: dict[str, list[LegOutcome]]
) -> list[dict[str, Any]]:
    """Headline touches that the default missed, the first of them, and who found them."""
    headline = ROWS.index(Row.HEADLINE)
    found = []
    for number, (t, outcome) in enumerate(zip(touched, outcomes[DEFAULT], strict=True)):
        table = outcome.touches
        for i in np.flatnonzero((table.row == headline) & ~table.found):
            # Touches are of the truth: the same in every detector's table.
            by = [n for n in DETECTORS if outcomes[n][number].touches.found[i]]
            found.append(
                {
                    "found_by": by,
                    "leg_run": t.piece.leg_run.name,
                    "kind": t.piece.kind,
                    "t_s": float(table.onset_ns[i] / 1e9),
                    "speed_m_s": float(table.speed_m_s[i]),
                    "force_n": float(table.force_n[i]),
                    "after_release_ms": _after_release(t.truth, int(table.onset_ns[i])),
                }
            )
    return found[:_SHOWN_MISSES]


def _after_release(truth: LegStream, onset_ns: int) -> float | None:
    """How long before a touch the leg's last contact ended, ms; None for the first."""
    changes = truth.truth
    ended = changes.t_ns[~changes.contact & (changes.t_ns < onset_ns)]
    return float((onset_ns - ended[-1]) / 1e6) if len(ended) else None


def _residual_figures(quiet: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """One-step residuals of every model, on its judged free ticks, degrees."""
    return {
        role: {
            model: np.degrees(
                np.sqrt(total["squares"][model] / max(total["rows"][model], 1))
            ).tolist()
            for model in MODELS
        }
        for role, total in quiet.items()
    }
