"""Figures as people read them; a table on the terminal and one in the report say the same."""

from __future__ import annotations

from typing import Any, Final

from rich.table import Table

__all__ = [
    "alarms",
    "leg_runs",
    "percent",
    "phases_around",
    "plain_number",
    "rate",
    "results_table",
    "swings",
]

Tree = dict[str, Any]

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


def percent(value: float | None, digits: int = 1) -> str:
    """Such as ``99.2``; a dash for nothing."""
    return "–" if value is None else f"{100.0 * value:.{digits}f}"


def plain_number(value: float | None) -> str:
    """With as many digits as it is worth; ``never`` for a count that was never reached."""
    if value is None:
        return "never"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"


def rate(summary: Tree) -> str:
    """False alarms per robot-hour, such as ``3.1``."""
    value = summary["per_robot_hour"]
    return "–" if value is None else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def swings(recovery: Tree | None) -> str:
    """Swings to recovery, median and 95th percentile, such as ``2 / 5``."""
    if recovery is None:
        return "–"
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
            percent(before["recall"]),
            f"{percent(after['recall'])} [dim]{percent(grey['recall'])}[/]",
            rate(before),
            f"{rate(after)} [dim]{rate(grey)}[/]",
            swings(recovery),
            "–" if recovery is None else plain_number(recovery["alarms_median"]),
            f"{full['longest_lock_out']} [dim]{frozen['longest_lock_out']}[/]",
            percent(full["touching_share"], 2),
            f"[green]{verdict}[/]" if all(met) else f"[red]{verdict}[/]",
        )
    return table


def _together(pool: Tree) -> str:
    """What several scenarios are held to together, in a line."""
    met = all(goal["met"] for goal in pool["goals"])
    return (
        f"{' + '.join(pool['scenarios'])}: {alarms(pool['false_alarms'])} in "
        f"{pool['robot_hours']:.1f} robot-hours, {rate(pool)} per hour: "
        f"{'met' if met else 'not met'}"
    )
