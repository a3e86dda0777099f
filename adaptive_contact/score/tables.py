"""Formats a score as a table for people, and as JSON for programs."""

from __future__ import annotations

import math
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from adaptive_contact.score.score import Score
from adaptive_contact.score.summary import Interval, RowFigures, Summary

_MEANING: Final = {
    "headline": "headline: hard, 0.2 m/s and more",
    "mid": "hard, 0.1 to 0.2 m/s",
    "slow": "slow, 0.02 to 0.1 m/s *",
    "creep": "slower still *",
    "soft": "soft ground *",
    "grazing": "grazing",
    "lift": "in the lift",
    "late": "late: last 2 of a swing, 10 after it",
    "unknown": "speed unknown",
}


def as_json(score: Score) -> dict[str, Any]:
    """Convert a score to a tree of numbers and texts; what is not known is None."""
    return {
        "v": 1,
        **summary_json(score.total),
        "legs": {leg: summary_json(summary) for leg, summary in score.legs.items()},
        "rejects": score.rejects,
        "notes": list(score.notes),
    }


def as_table(score: Score) -> RenderableType:
    """Format rows, totals and legs as tables, with the notes below."""
    parts: list[RenderableType] = [summary_table(score.total)]
    if sum(summary.swings > 0 for summary in score.legs.values()) > 1:
        parts.append(_legs_table(score))
    parts.extend(Text(f"note: {note}", style="yellow") for note in score.notes)
    return Group(*parts)


def summary_table(summary: Summary) -> RenderableType:
    """Format rows and totals as tables."""
    return Group(_rows_table(summary), _totals(summary))


def summary_json(summary: Summary) -> dict[str, Any]:
    """Convert a summary to a tree of numbers and texts."""
    return {
        "headline_row": summary.headline,
        "rows": {row: _row(figures) for row, figures in summary.rows.items()},
        "counted": _row(summary.counted),
        "in_time": _row(summary.in_time),
        "late_in_swing": _row(summary.late_in_swing),
        "late_after_turn": _row(summary.late_after),
        "precision": summary.precision,
        "precision_interval": _interval(summary.precision_interval),
        "detections": summary.detections,
        "false_alarms": summary.false_alarms,
        "judged_ticks": summary.judged_ticks,
        "robot_hours": summary.robot_hours,
        "false_alarms_per_robot_hour": summary.per_hour,
        "false_alarms_per_robot_hour_interval": _interval(summary.per_hour_interval),
        "false_alarms_after_turn": summary.after.false_alarms,
        "judged_ticks_after_turn": summary.after.judged_ticks,
        "false_alarms_after_turn_per_robot_hour": summary.after.per_hour,
        "false_alarms_after_turn_per_robot_hour_interval": _interval(summary.after.interval),
        "swings": summary.swings,
        "swings_with_errors": summary.lost_swings,
        "neutral_events": summary.neutral,
        "events_outside_swings": summary.outside,
        "touches_outside_swings": summary.unjudged,
    }


def _row(figures: RowFigures) -> dict[str, Any]:
    latency = figures.latency
    return {
        "touches": figures.touches,
        "found": figures.found,
        "found_late": figures.found_late,
        "recall": figures.recall,
        "recall_interval": _interval(figures.interval),
        "latency_median_ms": latency.median_ms if latency else None,
        "latency_p95_ms": latency.p95_ms if latency else None,
        "latency_p99_ms": latency.p99_ms if latency else None,
        "onset_error_median_ms": figures.onset_error_ms,
    }


def _interval(interval: Interval) -> list[float | None]:
    return [end if math.isfinite(end) else None for end in interval]


def _rows_table(summary: Summary) -> Table:
    table = Table(title="Touches in swings", title_justify="left")
    table.add_column("row")
    for name in ("touches", "found", "too late", "recall", "95 %", "median", "p95", "p99 ms"):
        table.add_column(name, justify="right")
    first = summary.headline
    table.add_row(_MEANING[first], *_cells(summary.rows[first]), style="bold")
    for row, figures in summary.rows.items():
        if row not in (first, "headline"):
            table.add_row(_MEANING[row], *_cells(figures))
    if len(summary.rows) > 1:
        table.add_section()
        table.add_row("all but creep, grazing, lift", *_cells(summary.counted))
        if summary.in_time != summary.counted:
            table.add_row("  of these in time", *_cells(summary.in_time))
            table.add_row("  late, still in the swing", *_cells(summary.late_in_swing))
            table.add_row("  late, after the turn", *_cells(summary.late_after))
    if {"slow", "creep", "soft"} & summary.rows.keys():
        table.caption = "* found within 500 ms; the others within 120 ms"
        table.caption_justify = "left"
    return table


def _cells(figures: RowFigures) -> tuple[str, ...]:
    latency = figures.latency
    times = (latency.median_ms, latency.p95_ms, latency.p99_ms) if latency else (None,) * 3
    return (
        str(figures.touches),
        str(figures.found),
        str(figures.found_late),
        _percent(figures.recall),
        _range(figures.interval, figures.touches),
        *("-" if value is None else f"{value:.0f}" for value in times),
    )


def _totals(summary: Summary) -> Table:
    table = Table(show_header=False, box=None, padding=(0, 1))
    table.add_column(style="bold")
    table.add_column()
    table.add_row(
        "false alarms", _alarms(summary.false_alarms, summary.per_hour, summary.per_hour_interval)
    )
    after = summary.after
    if after.judged_ticks:
        shown = _alarms(after.false_alarms, after.per_hour, after.interval)
        table.add_row("  after the turn", f"{shown}; {after.judged_ticks} ticks")
    alarms = summary.detections + summary.false_alarms
    interval = _range(summary.precision_interval, alarms)
    share = f"{_percent(summary.precision)} of {alarms} alarms (95 % {interval})" if alarms else "-"
    table.add_row("precision", share)
    table.add_row(
        "judged",
        f"{summary.swings} swings, {summary.judged_ticks} ticks, "
        f"{summary.robot_hours:.3f} robot-hours; {summary.lost_swings} swings with an error",
    )
    table.add_row(
        "not judged",
        f"{summary.neutral} alarms while still loaded, {summary.outside} in stance; "
        f"{summary.unjudged} touches in stance",
    )
    return table


def _alarms(count: int, per_hour: float | None, interval: Interval) -> str:
    if per_hour is None:
        return f"{count}, - per robot-hour"
    return (
        f"{count}, {per_hour:.2f} per robot-hour (95 % {interval.low:.2f} to {interval.high:.2f})"
    )


def _legs_table(score: Score) -> Table:
    table = Table(title="Legs", title_justify="left")
    table.add_column("leg")
    for name in ("swings", "touches", "found", "recall", "median ms", "false alarms", "/ hour"):
        table.add_column(name, justify="right")
    for leg, summary in score.legs.items():
        if summary.swings == 0:
            continue  # the legs that stand in `sim pose`
        figures = summary.counted
        table.add_row(
            leg,
            str(summary.swings),
            str(figures.touches),
            str(figures.found),
            _percent(figures.recall),
            f"{figures.latency.median_ms:.0f}" if figures.latency else "-",
            str(summary.false_alarms),
            "-" if summary.per_hour is None else f"{summary.per_hour:.1f}",
        )
    return table


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _range(interval: Interval, trials: int) -> str:
    if trials == 0:
        return "-"
    return f"{100 * interval.low:.1f} to {100 * interval.high:.1f} %"
