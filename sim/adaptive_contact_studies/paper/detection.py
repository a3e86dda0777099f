"""Detection over the whole workspace: every detector's figures on the same streams.

A slow approach (2 to 10 cm/s) has a row of its own.  What is touched at speed in such a stream is
mostly touched by a foot that slipped off an edge: it falls after a command that creeps, and meets
the ground about where the command would have stopped it.  Those touches are no headline; they are
shown in a row of their own, and together with the headline in another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.robot import ROBOT_HOUR_TICKS, shipped_robot
from adaptive_contact.score import (
    LegOutcome,
    RowFigures,
    match,
    summarise,
)
from adaptive_contact.score.summary import AlarmFigures
from adaptive_contact_studies.paper.detectors import DETECTORS, MODELS, alarms
from adaptive_contact_studies.paper.evaluation import (
    AIM,
    DEFAULT,
    FACTORS,
    Evaluated,
    Job,
)
from adaptive_contact_studies.paper.plan import Piece, Plan, Role

Tree = dict[str, Any]

TITLES: Final = {DEFAULT: "default: servo law, likelihood ratio, online"} | {
    name: detector.title for name, detector in DETECTORS.items()
}
# Names of the rows that divide the score's own headline row.
SLOW_FAST: Final = "fast touches in slow approaches"
BOTH: Final = "headline and fast touches in slow approaches"


class Touched(NamedTuple):
    """A stream with contacts, evaluated."""

    piece: Piece
    found: Evaluated

    @property
    def slow(self) -> bool:
        """Whether the leg approaches slowly."""
        return self.piece.kind == "hard slow"

    def outcome(self, name: str, factor: float = 1.0) -> LegOutcome:
        """A detector's events against the truth."""
        of = self.found
        events = of.events
        if name != DEFAULT:
            events = alarms(of.truth.t_ns, of.scores[name], of.swing, factor, of.descending)
        return match(of.truth, events)


class Quiet:
    """Sums over the free streams of a role."""

    def __init__(self) -> None:
        self.ticks = 0
        self.alarms = {name: np.zeros(len(FACTORS), dtype=np.int64) for name in DETECTORS}
        self.events = 0  # of the default
        self.squares: dict[tuple[str, str], Array] = {}  # by leg-run and model
        self.rows: Counter[tuple[str, str]] = Counter()

    def add(self, piece: Piece, found: Evaluated) -> None:
        """Add a stream."""
        ticks = int(np.count_nonzero(found.swing >= 0))
        self.ticks += ticks
        self.events += int(np.count_nonzero(found.events.contact))
        for name, counts in found.alarms.items():
            both = self.alarms[name]
            # A threshold too low to be counted on one stream is too low on all.
            self.alarms[name] = np.where((counts < 0) | (both < 0), -1, both + counts)
        for model in MODELS:
            key = (piece.leg_run.name, model)
            self.squares[key] = self.squares.get(key, np.zeros(1)) + found.squares[model]
            self.rows[key] += found.rows[model]

    def count(self, name: str, at: int = AIM) -> int:
        """A detector's alarms at a factor; -1 where they are not counted."""
        return int(self.alarms[name][at]) if name in self.alarms else self.events

    def rms_deg(self, model: str, run: str | None = None) -> list[float]:
        """(3,) one-step residuals on judged free ticks, degrees, of a leg-run or of all."""
        keys = [key for key in self.rows if key[1] == model and run in (None, key[0])]
        squares = sum((self.squares[key] for key in keys), np.zeros(3))
        rows = sum(self.rows[key] for key in keys)
        return [float(v) for v in np.degrees(np.sqrt(squares / max(rows, 1)))]


def detection(plan: Plan, jobs: Sequence[Job], evaluated: Sequence[list[Evaluated]]) -> Tree:
    """Gather the evaluated streams into figures."""
    roles: tuple[Role, ...] = ("free", "stand")
    quiet = {role: Quiet() for role in roles}
    touched = []
    for job, found in zip(jobs, evaluated, strict=True):
        for piece, own in zip(job.pieces, found, strict=True):
            if piece.role == "touch":
                touched.append(Touched(piece, own))
            else:
                quiet[piece.role].add(piece, own)
    robot = shipped_robot()
    stand = {run.name: quiet["stand"].rms_deg("servo", run.name) for run in plan.leg_runs}
    return {
        "detectors": TITLES,
        "figures": {name: _figures(name, touched, quiet) for name in TITLES},
        "residual_deg": {
            role: {model: of.rms_deg(model) for model in MODELS} for role, of in quiet.items()
        },
        "worst_leg_run": max(stand.items(), key=lambda own: max(own[1])),
        "leg_runs": len(plan.leg_runs),
        "aim_per_hour": robot.detector.false_alarms_per_hour,
    }


def _figures(name: str, touched: Sequence[Touched], quiet: dict[Role, Quiet]) -> Tree:
    outcomes = [t.outcome(name) for t in touched]
    summary = summarise(outcomes)
    counts = {role: rate_of(of.count(name), of.ticks) for role, of in quiet.items()}
    together = [rate["count"] for rate in counts.values()]
    kinds = {}
    for kind in dict.fromkeys(t.piece.kind for t in touched):
        own = summarise([o for o, t in zip(outcomes, touched, strict=True) if t.piece.kind == kind])
        grazing = own.rows.get("grazing") if kind == "graze" else None
        kinds[kind] = row_figures(grazing or own.counted) | {
            "alarms": rate_of(own.false_alarms, own.judged_ticks)
        }
    return {
        "rows": rows_of(touched, outcomes),
        "precision": summary.precision,
        "precision_interval": list(summary.precision_interval),
        "kinds": kinds,
        "false_alarms": counts
        | {
            "all": rate_of(
                -1 if min(together) < 0 else sum(together), sum(of.ticks for of in quiet.values())
            ),
            "touch": rate_of(summary.false_alarms, summary.judged_ticks),
        },
        "roc": []
        if name == DEFAULT
        else _curve(name, [t for t in touched if not t.slow], [*quiet.values()]),
    }


def rate_of(count: int, ticks: int) -> Tree:
    """Alarms per robot-hour; a count of -1 means a threshold too low to be counted."""
    alarms = AlarmFigures.of(count, ticks) if count >= 0 and ticks else None
    return {
        "count": count,
        "hours": ticks / ROBOT_HOUR_TICKS,
        "per_hour": alarms and alarms.per_hour,
        "interval": list(alarms.interval) if alarms else [None, None],
    }


def _curve(name: str, fast: Sequence[Touched], quiet: Sequence[Quiet]) -> list[Tree]:
    """Headline recall of a compared detector against false alarms per robot-hour."""
    points = []
    ticks = sum(of.ticks for of in quiet)
    for at, factor in enumerate(FACTORS.tolist()):
        counts = [of.count(name, at) for of in quiet]
        if min(counts) >= 0:
            row = summarise([t.outcome(name, factor) for t in fast]).rows["headline"]
            points.append({"factor": factor, "recall": row.recall, **rate_of(sum(counts), ticks)})
    return points


def rows_of(touched: Sequence[Touched], outcomes: Sequence[LegOutcome]) -> Tree:
    """Figures of every row, the headline first; the score's own headline row is divided."""
    whole = summarise(outcomes).rows
    headline, fast = (
        summarise([o for o, t in zip(outcomes, touched, strict=True) if t.slow is slow]).rows[
            "headline"
        ]
        for slow in (False, True)
    )
    rows = {"headline": headline}
    if fast.touches:
        rows |= {SLOW_FAST: fast, BOTH: whole["headline"]}
    rows |= {row: own for row, own in whole.items() if row != "headline"}
    return {name: row_figures(own) for name, own in rows.items()}


def row_figures(figures: RowFigures) -> Tree:
    """What tables show of a row."""
    latency = figures.latency
    return {
        "touches": figures.touches,
        "found": figures.found,
        "recall": figures.recall,
        "interval": list(figures.interval),
        "median_ms": latency.median_ms if latency else None,
        "p95_ms": latency.p95_ms if latency else None,
        "p99_ms": latency.p99_ms if latency else None,
    }
