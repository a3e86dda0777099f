"""Writes ``docs/adaptation.md``: every number comes from the results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from adaptive_contact.core.learn.change_classifier import KINDS
from adaptive_contact_studies.scenarios.judge import NOTHING
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.runs import FULL_SIZES
from adaptive_contact_studies.scenarios.spec import ALL_VARIANTS
from adaptive_contact_studies.show.pages import NONE, interval, number, percent, render, write_page

Tree = dict[str, Any]


def plain_number(value: float | None) -> str:
    """With as many digits as it is worth; ``never`` for a count that was never reached."""
    if value is None:
        return "never"
    return number(value, 0) if float(value).is_integer() else f"{value:.4g}"


def rate(summary: Tree) -> str:
    """False alarms per robot-hour, such as ``3.1``."""
    return number(summary["per_robot_hour"], _digits(summary["per_robot_hour"]))


def table(results: Tree) -> str:
    """Markdown of the full learner's figures, and of the goals that it misses."""
    return render("adaptation-table.md", _FILTERS, results=results, missed=_goals(results)[1])


def write_report(results: Tree, docs: Path) -> Path:
    """Write the page.

    Returns:
        The path of the page.

    Raises:
        ConfigurationError: it cannot be written.
    """
    path, (goals, missed) = docs / "adaptation.md", _goals(results)
    text = render(
        "adaptation.md",
        _FILTERS,
        results=results,
        lacking=_lacking(results),
        goals=goals,
        missed=missed,
        kinds=KINDS,
        kinds_rows=_kinds_rows(results["scenarios"]),
        learners=list(ALL_VARIANTS),
    )
    write_page(path, text)
    return path


def _digits(per_hour: float | None) -> int:
    return 1 if per_hour is None or per_hour < 100 else 0


def _goals(results: Tree) -> tuple[list[tuple[str, Tree]], list[tuple[str, Tree]]]:
    """All goals with what they are of, and those that are missed."""
    table = results["scenarios"]
    goals = [(_link(name), goal) for name in table for goal in table[name]["goals"]]
    for pool in results["pooled"].values():
        goals += [(" + ".join(map(_link, pool["scenarios"])), goal) for goal in pool["goals"]]
    return goals, [(name, goal) for name, goal in goals if not goal["met"]]


def _lacking(results: Tree) -> str:
    """What is other or less than in the whole, if anything is."""
    words = [
        f"{name} {results['sizes'][name]:g} instead of {usual:g}"
        for name, usual in asdict(FULL_SIZES).items()
        if results["sizes"][name] != usual
    ]
    absent = [name for name in scenarios() if name not in results["scenarios"]]
    return "; ".join([*words, *([f"not run: {', '.join(absent)}"] if absent else [])])


def _link(name: str) -> str:
    """To the scenario's heading; an anchor is lower case."""
    return f"[{name}](#{name.lower()})"


def _kinds_rows(table: Tree) -> list[tuple[str, str, list[int]]]:
    """What the full learner took changes for, where it reported any."""
    return [
        (name, mark, [recovery["taken_for"].get(kind, 0) for kind in (*KINDS, NOTHING)])
        for name, tree in table.items()
        for mark, recovery in tree["variants"]["full"]["recovery"].items()
        if not set(recovery["taken_for"]) <= {NOTHING}
    ]


def _recall(summary: Tree) -> str:
    if summary["recall"] is None:
        return NONE
    return f"{percent(summary['recall'])} ({interval(summary['recall_interval'])})"


def _alarms(summary: Tree) -> str:
    low, high = summary["per_robot_hour_interval"]
    digits = _digits(high)
    return NONE if high is None else f"{rate(summary)} ({low:.{digits}f}–{high:.{digits}f})"


def _swings(recovery: Tree) -> str:
    """Swings to recovery, median and 95th percentile, such as ``2 / 5``."""
    return f"{plain_number(recovery['swings_median'])} / {plain_number(recovery['swings_p95'])}"


_FILTERS: Final[dict[str, Callable[..., Any]]] = {
    "alarm_rate": _alarms,
    "link": _link,
    "plain": plain_number,
    "rate": rate,
    "recall": _recall,
    "swings": _swings,
}
