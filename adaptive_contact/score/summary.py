"""The figures of a score: recall per row, latency, precision, false alarms per robot-hour."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.score.intervals import Interval, clopper_pearson, poisson_mean
from adaptive_contact.score.outcome import ROWS, LegOutcome, Row, TouchTable

__all__ = ["Latency", "RowFigures", "Summary", "summarise"]

_NS_PER_MS: Final = 1e6


@dataclasses.dataclass(frozen=True, slots=True)
class Latency:
    """Deciding sample minus true onset, over detected touches, ms."""

    median_ms: float
    p95_ms: float
    p99_ms: float


@dataclasses.dataclass(frozen=True, slots=True)
class RowFigures:
    """One row of the table.

    Attributes:
        touches: how many there were.
        found: how many were detected.
        recall: their share, None without touches.
        interval: 95 % Clopper-Pearson interval of the recall.
        latency: None where nothing was detected.
        onset_error_ms: median of estimated minus true onset, None where nothing was detected.
    """

    touches: int
    found: int
    recall: float | None
    interval: Interval
    latency: Latency | None
    onset_error_ms: float | None


@dataclasses.dataclass(frozen=True, slots=True)
class Summary:
    """All figures of one or several legs.

    Attributes:
        rows: every row that holds a touch, and always the headline.
        counted: the rows together whose misses are errors.
        detections: touches detected, whatever their row.
        precision: detections over detections and false alarms, None without either.
        judged_ticks: swing ticks on which the foot was not still loaded from before.
        per_hour: false alarms per robot-hour of 540,000 judged ticks, None without ticks.
        per_hour_interval: its 95 % Poisson interval; the upper end is infinite without ticks.
        neutral: events while the foot was still loaded from before.
        outside: events on samples that are not swing.
        unjudged: touches outside swings.
        lost_swings: swings with an error, a missed touch of a counted row or a false alarm.
    """

    legs: tuple[str, ...]
    rows: dict[Row, RowFigures]
    counted: RowFigures
    detections: int
    false_alarms: int
    precision: float | None
    precision_interval: Interval
    swings: int
    lost_swings: int
    judged_ticks: int
    robot_hours: float
    per_hour: float | None
    per_hour_interval: Interval
    neutral: int
    outside: int
    unjudged: int


def summarise(outcomes: Sequence[LegOutcome]) -> Summary:
    """Add up the outcomes of legs, or of the same leg in several recordings."""
    touches = [outcome.touches for outcome in outcomes]
    row = _column(touches, "row")
    rows = {
        name: _figures(touches, row == code)
        for code, name in enumerate(ROWS)
        if name is Row.HEADLINE or np.any(row == code)
    }
    found = int(np.sum(_column(touches, "found")))
    alarms = sum(len(outcome.alarms_ns) for outcome in outcomes)
    judged = sum(int(outcome.swings.judged.sum()) for outcome in outcomes)
    hours = judged / ROBOT_HOUR_TICKS
    mean = poisson_mean(alarms)
    return Summary(
        legs=tuple(dict.fromkeys(outcome.leg for outcome in outcomes)),
        rows=rows,
        counted=_figures(touches, _column(touches, "counted").astype(bool)),
        detections=found,
        false_alarms=alarms,
        precision=found / (found + alarms) if found + alarms else None,
        precision_interval=clopper_pearson(found, found + alarms),
        swings=sum(len(outcome.swings.start_ns) for outcome in outcomes),
        lost_swings=sum(int(np.sum(outcome.swings.errors > 0)) for outcome in outcomes),
        judged_ticks=judged,
        robot_hours=hours,
        per_hour=alarms / hours if judged else None,
        per_hour_interval=(
            Interval(mean.low / hours, mean.high / hours) if judged else Interval(0.0, np.inf)
        ),
        neutral=sum(int(outcome.swings.neutral.sum()) for outcome in outcomes),
        outside=sum(len(outcome.outside_ns) for outcome in outcomes),
        unjudged=sum(len(outcome.unjudged_ns) for outcome in outcomes),
    )


def _column(touches: Sequence[TouchTable], name: str) -> NDArray[np.int64]:
    columns = [getattr(table, name) for table in touches]
    return np.concatenate(columns) if columns else np.zeros(0, np.int64)


def _figures(touches: Sequence[TouchTable], chosen: NDArray[np.bool_]) -> RowFigures:
    found = _column(touches, "found").astype(bool) & chosen
    total, hits = int(np.sum(chosen)), int(np.sum(found))
    latency_ms = _column(touches, "latency_ns")[found] / _NS_PER_MS
    error_ms = _column(touches, "onset_error_ns")[found] / _NS_PER_MS
    return RowFigures(
        touches=total,
        found=hits,
        recall=hits / total if total else None,
        interval=clopper_pearson(hits, total),
        latency=Latency(*(float(q) for q in np.percentile(latency_ms, (50, 95, 99))))
        if hits
        else None,
        onset_error_ms=float(np.median(error_ms)) if hits else None,
    )
