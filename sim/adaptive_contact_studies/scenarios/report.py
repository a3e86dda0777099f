"""Writes ``docs/adaptation.md`` and its picture: every number comes from the results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from adaptive_contact.diagnose.change_classifier import KINDS
from adaptive_contact_studies.scenarios.judge import NOTHING
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.results import ALARMS_PER_HOUR, RECOVERY_MEDIAN
from adaptive_contact_studies.scenarios.runs import FULL_SIZES
from adaptive_contact_studies.scenarios.spec import Variant
from adaptive_contact_studies.show.figures import BLUE, GREEN, GREY, INK, new_figure, save, styled
from adaptive_contact_studies.show.pages import NONE, interval, number, percent, render, write_page

Tree = dict[str, Any]

_LEARNERS: Final = {
    Variant.FROZEN: (GREY, 4, "frozen: the baseline, never updated"),
    Variant.RLS: (GREEN, 4, "rls: recursion only"),
    Variant.FULL: (BLUE, 6, "full: the product"),
}
_STYLE: Final = {"font.size": 8.5, "axes.spines.top": False, "axes.spines.right": False}
# Where no swing at all stands on a log scale, and where no end of them does.
_NO_SWING: Final = 0.5
_NEVER: Final = 400.0


def plain_number(value: float | None) -> str:
    """With as many digits as it is worth; ``never`` for a count that was never reached."""
    if value is None:
        return "never"
    return number(value, 0) if float(value).is_integer() else f"{value:.4g}"


def rate(summary: Tree) -> str:
    """False alarms per robot-hour, such as ``3.1``."""
    return number(summary["per_robot_hour"], _digits(summary["per_robot_hour"]))


def leg_runs(tree: Tree) -> str:
    """Such as ``20``, or ``19 of 20; 1 diverged``: what is behind the figures of a scenario."""
    there, asked = tree["leg_runs"], tree["leg_runs_asked"]
    return str(there) if there == asked else f"{there} of {asked}; {asked - there} diverged"


def table(results: Tree) -> str:
    """Markdown of the full learner's figures, and of the goals that it misses."""
    return render("adaptation-table.md", _FILTERS, results=results, missed=_goals(results)[1])


def write_report(results: Tree, docs: Path) -> Path:
    """Write the page, and its picture beside it.

    Returns:
        The path of the page.

    Raises:
        MissingExtraError: matplotlib is not installed.
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
        learners=[variant.value for variant in Variant],
    )
    write_page(path, text)
    draw_summary(results, docs / "pictures" / "adaptation-summary.png")
    return path


@styled(_STYLE, "the page's picture")
def draw_summary(results: Tree, path: Path) -> None:
    """Draw recall, false alarms and recovery of every learner in every scenario.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ConfigurationError: the picture cannot be written.
    """
    trees = results["scenarios"]
    figure = new_figure(15.0, 1.9 + 0.27 * len(trees), dpi=84)
    axes = figure.subplots(1, 3, sharey=True)
    for row, tree in enumerate(trees.values()):
        for variant, own in tree["variants"].items():
            colour, size, label = _LEARNERS[Variant(variant)]
            # Between the learners of a scenario, so that none hides another.
            y = row + 0.2 * (list(_LEARNERS).index(Variant(variant)) - 1)
            missed, alarms = own["judged"]["recall"], own["judged"]["per_robot_hour"]
            recovery: Tree = next(iter(own["recovery"].values()), {})
            # Recall lies close to one: drawn as the share missed, on a log scale that ends where a
            # figure of some thousand touches ends, too.
            x = (
                None if missed is None else max(100.0 * (1.0 - missed), 0.1),
                None if alarms is None else max(alarms, 0.5),
                None if not recovery else _place(recovery["swings_median"]),
            )
            for ax, at in zip(axes, x, strict=True):
                ax.plot([at], [y], "o", color=colour, ms=size, label=label)
            if recovery:
                ends = [x[2], _place(recovery["swings_p95"])]
                axes[2].plot(ends, [y, y], "-", color=colour, lw=1.0)
    titles = (
        ("Touches missed, %", None),
        ("False alarms per robot-hour (line: goal of the steady scenarios)", ALARMS_PER_HOUR),
        ("Swings to recovery: median to p95 (line: goal of the median)", RECOVERY_MEDIAN),
    )
    for ax, (title, goal) in zip(axes, titles, strict=True):
        ax.set(xscale="log", title=title)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.grid(axis="y", color="#eeeeee")
        if goal is not None:
            ax.axvline(goal, color=INK, lw=0.8, ls="--")
    axes[2].set_xticks([_NO_SWING, 1, 10, 100, _NEVER], ["0", "1", "10", "100", "never"])
    axes[0].set_yticks(range(len(trees)), [f"{t['about']}: {name}" for name, t in trees.items()])
    axes[0].set_ylim(len(trees) - 0.5, -0.5)
    handles = dict(zip(*reversed(axes[0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower left", ncols=3)
    save(figure, path)


def _place(swings: float | None) -> float:
    return _NEVER if swings is None else max(swings, _NO_SWING)


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
        for mark, recovery in tree["variants"][Variant.FULL.value]["recovery"].items()
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
    "leg_runs": leg_runs,
    "link": _link,
    "plain": plain_number,
    "rate": rate,
    "recall": _recall,
    "swings": _swings,
}
