"""Figures as people read them; a table on the terminal and one in the report say the same.

``docs/adaptation.md``, written from the results: every number in it comes from the JSON.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from rich.table import Table

from adaptive_contact.diagnose.change_classifier import KINDS
from adaptive_contact_studies.scenarios.judge import NOTHING
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.runner import Folders
from adaptive_contact_studies.scenarios.runs import FULL_SIZES, walks_without_change
from adaptive_contact_studies.scenarios.spec import Variant
from adaptive_contact_studies.show.numbers import general, interval, number, percent, share
from adaptive_contact_studies.show.pages import render, write_page

Tree = dict[str, Any]

# Stands where there is no number.
_NONE: Final = "–"
_HEADS: Final = (
    *("leg-runs", "recall before", "after", "false alarms before", "after"),
    *("recovery", "on the way", "lock-out", "contact learned %", "goals"),
)


def alarms(count: int) -> str:
    """So many false alarms."""
    return f"{count} false alarm{'' if count == 1 else 's'}"


def leg_runs(tree: Tree) -> str:
    """Such as ``20``, or ``19 of 20; 1 diverged``: what is behind the figures of a scenario."""
    there, asked = tree["leg_runs"], tree["leg_runs_asked"]
    return str(there) if there == asked else f"{there} of {asked}; {asked - there} diverged"


def plain_number(value: float | None) -> str:
    """With as many digits as it is worth; ``never`` for a count that was never reached."""
    if value is None:
        return "never"
    return number(value, 0) if float(value).is_integer() else general(value, 4)


def rate(summary: Tree) -> str:
    """False alarms per robot-hour, such as ``3.1``."""
    value = summary["per_robot_hour"]
    return number(value, _rate_digits(value), _NONE)


def _rate_digits(per_hour: float | None) -> int:
    return 1 if per_hour is None or per_hour < 100 else 0


def swings(recovery: Tree | None) -> str:
    """Swings to recovery, median and 95th percentile, such as ``2 / 5``."""
    if recovery is None:
        return _NONE
    median, p95 = recovery["swings_median"], recovery["swings_p95"]
    return f"{plain_number(median)} / {plain_number(p95)}"


def phases_around(tree: Tree, variant: str) -> tuple[Tree, Tree]:
    """Figures of the first phase, and of those a scenario is judged by."""
    own = tree["variants"][variant]
    first = next(iter(tree["phases"]))
    return own["phases"][first], own["judged"]


def results_table(results: Tree) -> Table:
    """All scenarios, the full learner against the frozen one."""
    table = Table(
        title="The full learner, and the frozen one in grey; recall in %, false alarms per "
        "robot-hour",
        title_justify="left",
        caption="\n".join(_together(pool) for pool in results["pooled"].values()) or None,
        caption_justify="left",
        pad_edge=False,
    )
    table.add_column("scenario", no_wrap=True)
    for head in _HEADS:
        table.add_column(head, justify="right")
    for name, tree in results["scenarios"].items():
        full, frozen = tree["variants"]["full"], tree["variants"]["frozen"]
        before, after = phases_around(tree, "full")
        _, grey = phases_around(tree, "frozen")
        recovery = next(iter(full["recovery"].values()), None)
        met = [goal["met"] for goal in tree["goals"]]
        verdict = f"{sum(met)}/{len(met)}"
        table.add_row(
            name,
            leg_runs(tree),
            share(before["recall"], none=_NONE),
            f"{share(after['recall'], none=_NONE)} [dim]{share(grey['recall'], none=_NONE)}[/]",
            rate(before),
            f"{rate(after)} [dim]{rate(grey)}[/]",
            swings(recovery),
            _NONE if recovery is None else plain_number(recovery["alarms_median"]),
            f"{full['longest_lock_out']} [dim]{frozen['longest_lock_out']}[/]",
            share(full["touching_share"], 2, _NONE),
            f"[green]{verdict}[/]" if all(met) else f"[red]{verdict}[/]",
        )
    return table


def _together(pool: Tree) -> str:
    """What several scenarios are held to together, in a line."""
    met = all(goal["met"] for goal in pool["goals"])
    return (
        f"{' + '.join(pool['scenarios'])}: {alarms(pool['false_alarms'])} in "
        f"{number(pool['robot_hours'], 1)} robot-hours, {rate(pool)} per hour: "
        f"{'met' if met else 'not met'}"
    )


_ADVICE: Final = "give another folder with --docs"

SUMMARY: Final = "summary"


def write_report(results: Tree, folders: Folders, docs: Path) -> Path:
    """Write the page, and put its pictures beside it.

    Returns:
        The path of the page.

    Raises:
        ConfigurationError: it cannot be written.
    """
    path, shown = docs / "adaptation.md", set()
    for name in (SUMMARY, *results["scenarios"]):
        page = folders.pages / f"{name}.png"
        if page.is_file():
            beside = docs / "pictures" / f"adaptation-{name}.png"
            write_page(beside, page.read_bytes(), _ADVICE)
            shown.add(name)
    write_page(path, report_text(results, shown), _ADVICE)
    return path


def report_text(results: Tree, pictures: set[str]) -> str:
    """The page's text."""
    table = results["scenarios"]
    goals = [(_link(name), goal) for name in table for goal in table[name]["goals"]]
    for pool in results["pooled"].values():
        names = " + ".join(_link(name) for name in pool["scenarios"])
        goals += [(names, goal) for goal in pool["goals"]]
    filters: dict[str, Callable[..., Any]] = {
        "alarm_rate": _alarms,
        "alarms": alarms,
        "around": phases_around,
        "leg_runs": leg_runs,
        "link": _link,
        "percent": partial(percent, none=_NONE),
        "plain": plain_number,
        "rate": rate,
        "recall": _recall,
        "share": partial(share, none=_NONE),
        "swings": swings,
    }
    text = render(
        "adaptation.md",
        filters,
        results=results,
        pictures=pictures,
        lacking=_lacking(results),
        goals=goals,
        missed=[(name, goal) for name, goal in goals if not goal["met"]],
        kinds=KINDS,
        kinds_rows=_kinds_rows(table),
        learners=[variant.value for variant in Variant],
    )
    return text.rstrip() + "\n"


def _lacking(results: Tree) -> list[str]:
    """What the full form would have besides, if these are figures of a part of it."""
    wanted = FULL_SIZES.leg_runs
    absent = [name for name in scenarios(FULL_SIZES) if name not in results["scenarios"]]
    words = []
    if results["size"] == "full" and results["leg_runs"] < wanted:
        words.append(f"{results['leg_runs']} leg-runs of each scenario instead of {wanted}")
    steady = results["scenarios"].get("steady-walk")
    walks = walks_without_change(FULL_SIZES)
    if results["size"] == "full" and steady is not None and steady["recordings"] < walks:
        words.append(f"{steady['recordings']} walks without a change instead of {walks}")
    if absent:
        words.append(f"not run: {', '.join(absent)}")
    return words


def _link(name: str) -> str:
    """To the scenario's heading; an anchor is lower case."""
    return f"[{name}](#{name.lower()})"


def _kinds_rows(table: Tree) -> list[tuple[str, str, list[int]]]:
    """What the full learner took changes for, where it reported any."""
    return [
        (name, mark, [recovery["taken_for"].get(kind, 0) for kind in (*KINDS, NOTHING)])
        for name, tree in table.items()
        for mark, recovery in tree["variants"][Variant.FULL.value]["recovery"].items()
        if not set(recovery["taken_for"]) <= {NOTHING}
    ]


def _recall(summary: Tree) -> str:
    if summary["recall"] is None:
        return _NONE
    return f"{percent(summary['recall'])} ({interval(summary['recall_interval'])})"


def _alarms(summary: Tree) -> str:
    low, high = summary["per_robot_hour_interval"]
    if high is None:
        return _NONE
    digits = _rate_digits(high)
    return f"{rate(summary)} ({number(low, digits)}–{number(high, digits)})"
