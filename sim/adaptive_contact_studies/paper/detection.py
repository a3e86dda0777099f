"""Detection over the whole workspace: every detector's figures on the same streams.

A slow approach (2 to 10 cm/s) has a row of its own.  What is touched at speed in such a stream is
mostly touched by a foot that slipped off an edge: it falls after a command that creeps, and meets
the ground about where the command would have stopped it.  Those touches are no headline; they are
shown in a row of their own, and together with the headline in another.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.robot import ROBOT_HOUR_TICKS, shipped_robot
from adaptive_contact.score import (
    LegOutcome,
    RowFigures,
    summarise,
)
from adaptive_contact.score.summary import AlarmFigures
from adaptive_contact_studies.paper.detectors import DETECTORS, MODELS
from adaptive_contact_studies.paper.evaluation import (
    AIM,
    DEFAULT,
    FACTORS,
    PLAYED,
    Evaluated,
    Job,
)
from adaptive_contact_studies.paper.plan import Plan

Tree = dict[str, Any]

TITLES: Final = {
    DEFAULT: "default: servo law, likelihood ratio, online",
    "frozen": "the same, never updated",
} | {name: detector.title for name, detector in DETECTORS.items()}
# Names of the rows that divide the score's own headline row.
SLOW_FAST: Final = "fast touches in slow approaches"
BOTH: Final = "headline and fast touches in slow approaches"


class Quiet(NamedTuple):
    """The streams of free motion, evaluated."""

    streams: Sequence[Evaluated]

    @property
    def ticks(self) -> int:
        """Of swings."""
        return sum(int(np.count_nonzero(stream.swing >= 0)) for stream in self.streams)

    def count(self, name: str, at: int = AIM) -> int:
        """A detector's alarms at a factor; -1 where they are not counted."""
        if name in PLAYED:
            return sum(int(np.count_nonzero(one.events[name].contact)) for one in self.streams)
        # A threshold too low to be counted on one stream is too low on all.
        counts = [int(stream.alarms[name][at]) for stream in self.streams]
        return -1 if min(counts) < 0 else sum(counts)

    def rms_deg(self, model: str, run: str | None = None) -> list[float]:
        """(3,) one-step residuals on judged free ticks, degrees, of a leg-run or of all."""
        own = [stream for stream in self.streams if run in (None, stream.leg_run)]
        squares = np.sum([stream.squares[model] for stream in own], axis=0)
        rows = sum(stream.rows[model] for stream in own)
        return [float(v) for v in np.degrees(np.sqrt(squares / max(rows, 1)))]


def detection(plan: Plan, jobs: Sequence[Job], evaluated: Sequence[list[Evaluated]]) -> Tree:
    """Gather the evaluated streams into figures."""
    touched, free = (
        [
            one
            for job, found in zip(jobs, evaluated, strict=True)
            if job.role == role
            for one in found
        ]
        for role in ("touch", "free")
    )
    quiet = Quiet(free)
    runs = {name: quiet.rms_deg("servo", name) for name in {one.leg_run for one in free}}
    return {
        "detectors": TITLES,
        "figures": {name: _figures(name, touched, quiet) for name in TITLES},
        "residual_deg": {model: quiet.rms_deg(model) for model in MODELS},
        "worst_leg_run": max(runs.items(), key=lambda own: max(own[1])),
        "leg_runs": plan.leg_runs,
        "aim_per_hour": shipped_robot().detector.false_alarms_per_hour,
    }


def _figures(name: str, touched: Sequence[Evaluated], quiet: Quiet) -> Tree:
    outcomes = [one.outcome(name) for one in touched]
    summary = summarise(outcomes)
    kinds = {}
    for kind in dict.fromkeys(one.kind for one in touched):
        own = summarise([o for o, t in zip(outcomes, touched, strict=True) if t.kind == kind])
        grazing = own.rows.get("grazing") if kind == "graze" else None
        kinds[kind] = row_figures(grazing or own.counted) | {
            "alarms": rate_of(own.false_alarms, own.judged_ticks)
        }
    return {
        "rows": rows_of(touched, outcomes),
        "precision": summary.precision,
        "precision_interval": list(summary.precision_interval),
        "kinds": kinds,
        "false_alarms": {
            "free": rate_of(quiet.count(name), quiet.ticks),
            "touch": rate_of(summary.false_alarms, summary.judged_ticks),
        },
        "roc": []
        if name in PLAYED
        else _curve(name, [one for one in touched if not one.slow], quiet),
    }


def rate_of(count: int, ticks: int) -> Tree:
    """Alarms per robot-hour; a count of -1 means a threshold too low to be counted."""
    alarms = AlarmFigures.from_counts(count, ticks) if count >= 0 and ticks else None
    return {
        "count": count,
        "hours": ticks / ROBOT_HOUR_TICKS,
        "per_hour": alarms and alarms.per_hour,
        "interval": list(alarms.interval) if alarms else [None, None],
    }


def _curve(name: str, fast: Sequence[Evaluated], quiet: Quiet) -> list[Tree]:
    """Headline recall of a compared detector against false alarms per robot-hour."""
    points = []
    for at, factor in enumerate(FACTORS.tolist()):
        count = quiet.count(name, at)
        if count >= 0:
            row = summarise([one.outcome(name, factor) for one in fast]).rows["headline"]
            points.append({"factor": factor, "recall": row.recall, **rate_of(count, quiet.ticks)})
    return points


def rows_of(touched: Sequence[Evaluated], outcomes: Sequence[LegOutcome]) -> Tree:
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
