"""Figures of the detection study: curves, tails, limits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from adaptive_contact_studies.show.figures import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    YELLOW,
    legend_below,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLES: Final = {
    "default": ("black", "-", 2.2),
    "ungated": (YELLOW, "-", 1.8),
    "servo ratio": (BLUE, "-", 1.8),
    "servo rule": (SKY, "--", 1.4),
    "paper ratio": (ORANGE, "-", 1.4),
    "paper rule": (RED, "-", 1.8),
    "analytical ratio": (GREEN, "-", 1.4),
    "analytical rule": (GREEN, "--", 1.4),
    "tracking": (PURPLE, "-", 1.4),
    "naive": (GREY, "-", 1.4),
}
_LIMITED: Final = ("default", "servo ratio", "paper rule", "analytical ratio", "tracking")
_TAILED: Final = ("servo ratio", "analytical ratio", "paper ratio", "paper rule")
# Where the curve of the share of free ticks ends, and touches are drawn above it.
_PEAKS_AT: Final = 2.0
# What the default is held to, docs/paper.md.
_GOAL_PER_HOUR: Final = 5.0
_GOAL_RECALL: Final = 99.0


def roc_figure(data: Any) -> Figure:
    """Headline recall against false alarms, thresholds swept; whole, and from 90 % on."""
    figure = new_figure(10.4, 6.6)
    whole, upper = figure.subplots(1, 2)
    hours = data["figures"]["default"]["false_alarms"]["all"]["hours"]
    for axes in (whole, upper):
        for name, title in data["detectors"].items():
            _curve(axes, name, title, data["figures"][name])
        axes.axvline(_GOAL_PER_HOUR, color="black", lw=0.8, ls=":")
        axes.axhline(_GOAL_RECALL, color="black", lw=0.8, ls=":")
        # Between no alarm and one there is no rate.
        axes.axvspan(0.25 / hours, 0.7 / hours, color=GREY, alpha=0.15, lw=0)
        axes.set(
            xscale="log",
            xlim=(0.25 / hours, None),
            xlabel=f"false alarms per robot-hour (in {hours:.1f} h); threshold falls →",
        )
    whole.set(ylim=(-2, 102), ylabel="recall, headline touches (%)")
    upper.set(ylim=(90, 100.2), title="the same from 90 % on")
    _words(upper, 0.36 / hours, 91.0, "no false alarm seen", rotation=90)
    _words(upper, _GOAL_PER_HOUR, 90.2, f" goal: {_GOAL_PER_HOUR:g} per hour", ha="left")
    _words(upper, 1.0, _GOAL_RECALL, f"goal: {_GOAL_RECALL:g} %", x_axes=True, ha="right")
    legend_below(figure, whole, 2)
    return figure


def _words(
    axes: Axes, x: float, y: float, words: str, *, x_axes: bool = False, **style: Any
) -> None:
    """Say what a line is, beside it; ``x_axes`` gives x as a share of the axes' width."""
    transform = axes.get_yaxis_transform() if x_axes else axes.transData
    style = {"ha": "center", "va": "bottom", "fontsize": 9, "color": "#444444", **style}
    axes.text(x, y, words, transform=transform, **style)


def _curve(axes: Axes, name: str, title: str, figures: Any) -> None:
    """A detector's curve, and the point at which it runs."""
    colour, style, width = _STYLES[name]
    at = _place(figures["false_alarms"]["all"], figures["summary"]["rows"]["headline"])
    points = [
        (*_place(p, p), p.get("aim")) for p in figures.get("roc", ()) if p["per_hour"] is not None
    ]
    if any(aim is not None for *_, aim in points) and at is not None:
        # Played at some target rates besides the product's own, which is the star.
        points = sorted([*points, (*at, None)], key=lambda p: p[:2])
    mark = "s" if name == "default" else ""
    axes.plot(
        [x for x, *_ in points], [y for _, y, _ in points],
        ls=style, color=colour, lw=width, marker=mark, ms=4, label=title if points else None,
    )  # fmt: skip
    if at is not None:
        shape, size = {"default": ("*", 15), "ungated": ("X", 9)}.get(name, ("o", 6))
        axes.plot(
            [at[0]], [at[1]], shape, color=colour, ms=size, mec="white", zorder=5,
            label=None if points else title,
        )  # fmt: skip


def _place(rate: Any, row: Any) -> Any:
    """False alarms per hour and recall in per cent; None where the rate is not counted.

    What was never seen is drawn where half an alarm would be.
    """
    if rate["per_hour"] is None:
        return None
    return max(rate["per_hour"], 0.5 / max(rate["hours"], 1e-9)), 100 * (row["recall"] or 0)


def tails_figure(data: Any) -> Figure:
    """How high free ticks score, and touches: why a target rate's threshold may find nothing."""
    figure = new_figure(8.4, 6.0)
    axes = figure.subplots()
    shown = [name for name in _TAILED if name in data["tails"]]
    for line, name in enumerate(shown):
        tail = data["tails"][name]
        colour, style, width = _STYLES[name]
        share = np.array(tail["above"], dtype=float)
        seen = share > 0
        axes.plot(
            np.array(tail["factors"])[seen], share[seen],
            color=colour, ls=style, lw=width, label=data["detectors"][name],
        )  # fmt: skip
        if tail["peaks"] is not None:
            low, middle, high = tail["peaks"]
            height = _PEAKS_AT * 2.2**line
            axes.plot([low, high], [height, height], color=colour, lw=width, ls=style)
            axes.plot([middle], [height], "D", color=colour, ms=7)
    highest = max([1.0, *(max(data["tails"][name]["peaks"] or [1.0]) for name in shown)])
    axes.axhline(1.0, color="black", lw=0.8)
    axes.axvline(1.0, color="black", lw=1.2)
    axes.annotate(
        "the aim's threshold", (1.0, 3e-7), xytext=(-5, 0), textcoords="offset points",
        rotation=90, va="bottom", ha="right",
    )  # fmt: skip
    axes.set(
        xscale="log",
        yscale="log",
        ylim=(2e-7, _PEAKS_AT * 2.2 ** len(shown)),
        xlim=(1e-3, 1.5 * highest),
        xlabel="score (statistic over the threshold of one false alarm per robot-hour)",
        ylabel="share of free ticks above; over 1: highest at touches",
    )
    axes.set_yticks([1e-6, 1e-4, 1e-2, 1.0])
    legend_below(figure, axes, 2)
    return figure


def limits_figure(data: Any) -> Figure:
    """Recall against approach speed and contact force, with 95 % intervals."""
    figure = new_figure(10.4, 6.0)
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, field, label in (
        (left, "by_speed", "speed at touch (m/s), hard ground"),
        (right, "by_force", "force, mean over 20 ms (N)"),
    ):
        for offset, name in enumerate(_LIMITED):
            bins = [b for b in data["figures"][name][field] if b["touches"]]
            # The last bin of the forces has no upper end.
            centre = np.array(
                [np.sqrt(max(b["low"], 0.01) * (b["high"] or 2.5 * b["low"])) for b in bins]
            )
            recall = 100 * np.array([b["recall"] for b in bins])
            spread = 100 * np.array([b["interval"] for b in bins]).reshape(-1, 2)
            colour, style, _ = _STYLES[name]
            axes.errorbar(
                centre * (1 + 0.03 * (offset - 2)),
                recall,
                yerr=np.abs(spread.T - recall),
                color=colour, ls=style, marker="o", ms=3.5, lw=1.3, elinewidth=0.8,
                label=data["detectors"][name],
            )  # fmt: skip
        axes.set(xscale="log", xlabel=label, ylim=(-2, 102))
    limits = data["limits"]
    steps = list(limits["step_m"].values())
    for ticks, alpha in ((1, 0.28), (3, 0.14)):
        left.axvspan(
            min(steps) / (ticks * limits["period_s"]), max(steps) / (ticks * limits["period_s"]),
            color=GREY, alpha=alpha, lw=0,
            label=f"a servo step in {ticks} tick{'s' if ticks > 1 else ''} (tibia to coxa)",
        )  # fmt: skip
    left.axvline(0.1, color=GREY, lw=1.2, ls="--", label="500 ms allowed below, 120 ms above")
    forces = list(limits["step_n"].values())
    right.axvspan(
        min(forces), max(forces), color=GREY, alpha=0.28, lw=0,
    )  # fmt: skip
    right.set_xlim(0.8 * min(forces), None)
    left.set_ylabel("recall (%)")
    legend_below(figure, left, 2)
    return figure
