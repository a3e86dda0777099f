"""One page over all scenarios: recall, false alarms and recovery of every learner."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from adaptive_contact_studies.scenarios.canvas import COLOURS, DPI, PALETTE, STYLE
from adaptive_contact_studies.scenarios.goals import ALARMS_PER_HOUR, RECOVERY_MEDIAN
from adaptive_contact_studies.scenarios.spec import Variant
from adaptive_contact_studies.show.figures import INK, new_figure, save, styled

__all__ = ["draw_summary"]

Tree = dict[str, Any]

# Recall lies close to one: drawn as the share missed, on a log scale that ends where a figure of
# some thousand touches ends, too.
_LEAST_MISSED: Final = 1e-3
_LEAST_RATE: Final = 0.5
# Where no swing at all stands on a log scale, and where no end of them does.
_NONE: Final = 0.5
_NEVER: Final = 400.0
_ROW_IN: Final = 0.27
# Between the learners of a scenario, so that none hides another.
_SPREAD: Final = 0.16
_LEARNERS: Final = {
    Variant.FROZEN: "frozen: the baseline, never updated",
    Variant.UNGATED: "ungated: recursive least squares on every tick",
    Variant.REFIT: "refit: sparse refits only",
    Variant.RLS: "rls: recursion only",
    Variant.FULL: "full: the product",
}


@styled(STYLE, "a page of plots")
def draw_summary(results: Tree, path: Path) -> None:
    """Draw the summary page.

    Args:
        results: all figures.
        path: of the picture.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ConfigurationError: the picture cannot be written.
    """
    table = results["scenarios"]
    names = list(table)
    page = new_figure(15.0, 1.9 + _ROW_IN * len(names), dpi=DPI)
    page.suptitle(
        "Every scenario, every learner: figures after the change, or of the whole recording where "
        "nothing changes; less is better",
        x=0.01,
        ha="left",
        color=INK,
        fontsize=12,
    )
    axes = page.subplots(1, 3, sharey=True)
    for row, name in enumerate(names):
        for variant, own in table[name]["variants"].items():
            kind = Variant(variant)
            y = row + _SPREAD * (list(Variant).index(kind) - 2)
            large = kind is Variant.FULL
            style = {
                "color": COLOURS[kind],
                "ms": 6 if large else 4,
                "zorder": 3 if large else 2,
            }
            judged = own["judged"]
            if judged["recall"] is not None:
                missed = max(1.0 - judged["recall"], _LEAST_MISSED)
                axes[0].plot(100.0 * missed, y, "o", **style)
            if judged["per_robot_hour"] is not None:
                axes[1].plot(max(judged["per_robot_hour"], _LEAST_RATE), y, "o", **style)
            for recovery in list(own["recovery"].values())[:1]:
                median, p95 = recovery["swings_median"], recovery["swings_p95"]
                ends = [_NEVER if n is None else max(n, _NONE) for n in (median, p95)]
                axes[2].plot(ends, [y, y], "-", color=COLOURS[kind], lw=1.0)
                axes[2].plot(ends[0], y, "o", **style)
    titles = (
        "Touches missed, %",
        "False alarms per robot-hour",
        "Swings to recovery: dot is the median, line ends at p95",
    )
    limits = (
        None,
        (ALARMS_PER_HOUR, f"goal of the steady scenarios: ≤ {ALARMS_PER_HOUR:g}"),
        (RECOVERY_MEDIAN, f"goal of the median: ≤ {RECOVERY_MEDIAN:g}"),
    )
    for ax, title, limit in zip(axes, titles, limits, strict=True):
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_title(title, pad=20)
        ax.grid(axis="y", color="#eeeeee", lw=0.8, zorder=0)
        ax.tick_params(axis="y", length=0)
        if limit is not None:
            value, words = limit
            ax.axvline(value, color=INK, lw=0.8, ls=(0, (4, 3)))
            ax.annotate(
                words,
                (value, 1.0),
                (0, 3),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                ha="center",
                va="bottom",
                color=INK,
            )
    least = 100.0 * _LEAST_MISSED
    axes[0].set_xticks([least, 1, 10, 100], [f"≤ {least:g}", "1", "10", "100"])
    rates = [10**decade for decade in range(1, 5)]
    axes[1].set_xticks([_LEAST_RATE, *rates], [f"≤ {_LEAST_RATE:g}", *map(str, rates)])
    axes[2].set_xticks([_NONE, 1, 10, 100, _NEVER], ["0", "1", "10", "100", "never"])
    axes[0].set_yticks(range(len(names)), [table[name]["about"] for name in names])
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    # What the report calls each of them.
    codes = axes[2].secondary_yaxis("right")
    codes.set_yticks(range(len(names)), names)
    codes.tick_params(axis="y", length=0)
    codes.spines["right"].set_visible(False)
    handles = [
        axes[0].plot([], [], "o", color=COLOURS[variant], label=_LEARNERS[variant])[0]
        for variant in Variant
    ]
    page.legend(handles=handles, loc="outside lower left", ncols=len(handles))
    save(page, path, PALETTE)
