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
class AlarmFigures:
    """False alarms on some ticks.

    Attributes:
        false_alarms: how many.
        judged_ticks: on so many ticks.
        per_hour: per robot-hour of 540,000 of them, None without ticks.
        interval: its 95 % Poisson interval; the upper end is infinite without ticks.
    """

    false_alarms: int
    judged_ticks: int
    per_hour: float | None
    interval: Interval

    @classmethod
    def of(cls, alarms: int, ticks: int) -> AlarmFigures:
        """From the counts."""
        if not ticks:
            return cls(alarms, ticks, None, Interval(0.0, np.inf))
        hours, mean = ticks / ROBOT_HOUR_TICKS, poisson_mean(alarms)
        return cls(alarms, ticks, alarms / hours, Interval(mean.low / hours, mean.high / hours))


@dataclasses.dataclass(frozen=True, slots=True)
class Summary:
    """All figures of one or several legs.

    Attributes:
        rows: every row that holds a touch, and always the headline.
        counted: the rows together whose misses are errors.
        in_time: those of them that are not late.
        late_in_swing, late_after: late touches before and after the turn to stance.
        detections: touches detected, whatever their row.
        precision: detections over detections and false alarms, None without either.
        judged_ticks: swing ticks on which the foot was not still loaded from before.
        per_hour: false alarms per robot-hour of 540,000 judged ticks, None without ticks.
        per_hour_interval: its 95 % Poisson interval; the upper end is infinite without ticks.
        after: the same of the ticks after a turn to stance, up to 16, on which the foot had not
            touched; they are in none of the four.
        neutral: events while the foot was still loaded from before.
        outside: events in stance that are not judged.
        unjudged: touches in stance that are not judged.
        lost_swings: swings with an error, a missed touch of a counted row or a false alarm.
    """

    legs: tuple[str, ...]
    rows: dict[Row, RowFigures]
    counted: RowFigures
    in_time: RowFigures
    late_in_swing: RowFigures
    late_after: RowFigures
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
    after: AlarmFigures
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
    counted, after_turn = (_column(touches, n).astype(bool) for n in ("counted", "after_turn"))
    late = row == ROWS.index(Row.LATE)
    alarms = AlarmFigures.of(
        sum(len(outcome.alarms_ns) for outcome in outcomes),
        sum(int(outcome.swings.judged.sum()) for outcome in outcomes),
    )
    after = AlarmFigures.of(
        sum(len(outcome.after_ns) for outcome in outcomes),
        sum(int(outcome.swings.judged_after.sum()) for outcome in outcomes),
    )
    told = found + alarms.false_alarms + after.false_alarms
    return Summary(
        legs=tuple(dict.fromkeys(outcome.leg for outcome in outcomes)),
        rows=rows,
        counted=_figures(touches, counted),
        in_time=_figures(touches, counted & ~late),
        late_in_swing=_figures(touches, late & ~after_turn),
        late_after=_figures(touches, late & after_turn),
        detections=found,
        false_alarms=alarms.false_alarms,
        precision=found / told if told else None,
        precision_interval=clopper_pearson(found, told),
        swings=sum(len(outcome.swings.start_ns) for outcome in outcomes),
        lost_swings=sum(int(np.sum(outcome.swings.errors > 0)) for outcome in outcomes),
        judged_ticks=alarms.judged_ticks,
        robot_hours=alarms.judged_ticks / ROBOT_HOUR_TICKS,
        per_hour=alarms.per_hour,
        per_hour_interval=alarms.interval,
        after=after,
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
