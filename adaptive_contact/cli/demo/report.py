"""``report.png``: the run in one picture.

Title in words; truth and events leg by leg; how well each model predicts its leg; what was found
and what was false before and after the drift; how long it took.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import NDArray

from adaptive_contact.cli.demo.settings import DemoSettings, drift_words
from adaptive_contact.cli.demo.summary import outcome_words, percent, touches_words
from adaptive_contact.cli.demo.verdict import Verdict, others
from adaptive_contact.score import LegOutcome, Summary
from adaptive_contact_studies.show.figures import BLUE, ORANGE, new_figure, save, styled

_SERVICE: Final = BLUE
_FROZEN: Final = ORANGE
_WRONG: Final = "#D12D1F"
_TRUE: Final = "#C9CCD1"
_OTHERS: Final = "#9AA0A8"
_DRIFTED: Final = "#FFF3DC"
_INK: Final = "#20242A"

_MARKS: Final[dict[str, dict[str, Any]]] = {
    "touch found": {"marker": "|", "s": 150, "color": _SERVICE, "linewidth": 2.2, "zorder": 3},
    "touch missed": {
        "marker": "o",
        "s": 42,
        "facecolors": "white",
        "edgecolors": _WRONG,
        "linewidth": 1.8,
        "zorder": 3,
    },
    "false alarm": {"marker": "x", "s": 38, "color": _WRONG, "linewidth": 1.8, "zorder": 4},
}
_SIZE_IN: Final = (14.0, 9.4)
_TICK_MS: Final = 20.0
_STYLE: Final = {
    "font.size": 10.5,
    "axes.titlesize": 11.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _INK,
    "text.color": _INK,
}


@styled(_STYLE, "the demo's report", "plot")
def draw(path: Path, settings: DemoSettings, verdict: Verdict) -> None:
    """Write the report.

    Raises:
        AdaptiveContactError: the file cannot be written.
    """
    save(drawn(settings, verdict), path)


@styled(_STYLE, "the demo's report", "plot")
def drawn(settings: DemoSettings, verdict: Verdict) -> Figure:
    """The report."""
    figure = new_figure(*_SIZE_IN, layout=None, facecolor="white")
    grid = figure.add_gridspec(
        2,
        4,
        height_ratios=(1.45, 1.0),
        width_ratios=(1.75, 1.0, 1.0, 1.0),
        left=0.097,
        right=0.985,
        top=0.825,
        bottom=0.065,
        hspace=0.34,
        wspace=0.3,
    )
    _title(figure, settings, verdict)
    _timeline(figure.add_subplot(grid[0, :]), settings, verdict)
    _levels(figure.add_subplot(grid[1, 0]), verdict)
    _recall(figure.add_subplot(grid[1, 1]), verdict)
    _alarms(figure.add_subplot(grid[1, 2]), verdict)
    _latency(figure.add_subplot(grid[1, 3]), verdict)
    return figure


def _title(figure: Figure, settings: DemoSettings, verdict: Verdict) -> None:
    first = touches_words(verdict)
    then = "\n".join(outcome_words(settings, verdict))
    figure.text(0.012, 0.978, first, size=17.5, weight="bold", va="top")
    figure.text(0.012, 0.935, then, size=13.5, va="top", linespacing=1.35)


# -- what happened -----------------------------------------------------------------------------


def _timeline(axes: Axes, settings: DemoSettings, verdict: Verdict) -> None:
    """Truth as bars, events as marks; the drifted leg on top, once for each detector."""
    leg = verdict.drift_leg
    rest = [one for one in verdict.truth if one != leg]
    rows = [
        (leg, verdict.service, f"{leg}  service"),
        (leg, verdict.frozen, f"{leg}  frozen model"),
        *((one, verdict.service, one) for one in rest),
    ]
    drift_s = _seconds(verdict, verdict.drift_ns)
    right_s = 1.005 * _seconds(verdict, verdict.end_ns)  # the last marks shall be whole
    for at, (name, judged, _) in enumerate(rows):
        y = -at
        if name == leg:
            axes.fill_between([drift_s, right_s], y - 0.5, y + 0.5, color=_DRIFTED, lw=0, zorder=0)
        spans = _seconds(verdict, verdict.truth[name])
        axes.broken_barh(
            [(begin, end - begin) for begin, end in spans],
            (y - 0.27, 0.54),
            color=_TRUE,
            linewidth=0,
            zorder=1,
        )
        (outcome,) = (one for one in judged.outcomes if one.leg == name)
        _marks(axes, verdict, outcome, y)
    axes.axvline(drift_s, color=_INK, linewidth=1.6, zorder=4)
    axes.annotate(
        f"{drift_s:.0f} s: leg {leg} gets {drift_words(settings)}",
        (drift_s, 1.0),
        (-6, 7),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        ha="right",
        weight="bold",
    )
    axes.set_yticks([-at for at in range(len(rows))], [label for _, _, label in rows])
    axes.set_ylim(-len(rows) + 0.45, 0.6)
    axes.set_xlim(0, right_s)
    axes.set_xlabel("time, s", labelpad=2, loc="left")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.scatter([], [], marker="s", s=60, color=_TRUE, label="on the ground (truth)")
    for kind, style in _MARKS.items():
        axes.scatter([], [], label=kind, **style)
    # Below: above the axes is the drift's label, which ends wherever the drift came.
    axes.legend(
        loc="upper right",
        bbox_to_anchor=(1.0, -0.055),
        ncols=4,
        frameon=False,
        borderaxespad=0.1,
        handletextpad=0.2,
        columnspacing=1.0,
    )


def _marks(axes: Axes, verdict: Verdict, outcome: LegOutcome, y: float) -> None:
    """Found, missed and false, of one leg."""
    touches = outcome.touches
    when = _seconds(verdict, touches.onset_ns)
    for kind, x, up in (
        ("touch found", when[touches.found], 0.0),
        ("touch missed", when[touches.counted & ~touches.found], 0.0),
        # A little higher: a false alarm early in a swing often comes right before its missed touch.
        ("false alarm", _seconds(verdict, outcome.alarms_ns), 0.3),
    ):
        axes.scatter(x, np.full(len(x), y + up), **_MARKS[kind])


# -- why, and how well -------------------------------------------------------------------------


def _levels(axes: Axes, verdict: Verdict) -> None:
    """One-step error over the noise floor, swing by swing."""
    leg = verdict.drift_leg
    shown = list(verdict.service.level.values())
    for name, level in verdict.service.level.items():
        if name != leg:
            axes.plot(_seconds(verdict, level.t_ns), level.over_floor, color=_OTHERS, lw=0.8)
    for judged, colour, width, name in (
        (verdict.frozen, _FROZEN, 3.6, "frozen model"),
        (verdict.service, _SERVICE, 1.8, "service"),
    ):
        level = judged.level[leg]
        shown.append(level)
        axes.plot(
            _seconds(verdict, level.t_ns),
            level.over_floor,
            color=colour,
            linewidth=width,
            label=f"{leg}, {name}",
        )
    axes.plot([], [], color=_OTHERS, lw=0.8, label="other legs")
    axes.axhline(1.0, color=_INK, linewidth=1.0, linestyle=":")
    axes.axvline(_seconds(verdict, verdict.drift_ns), color=_INK, linewidth=1.6)
    axes.set_yscale("log")
    highest = max((level.over_floor.max(initial=1.0) for level in shown), default=1.0)
    axes.set_ylim(0.6, 2.6 * highest)  # room for the legend
    ticks = [tick for tick in (1, 2, 5, 10, 20, 50, 100) if tick < 2.6 * highest]
    axes.set_yticks(ticks, [f"{tick}×" for tick in ticks])
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_title("one-step error of free swings, × noise floor")
    axes.set_xlabel("time, s", labelpad=2)
    axes.legend(
        framealpha=1.0, edgecolor="none", loc="upper left", ncols=3, fontsize=9.5, columnspacing=1.0
    )


def _recall(axes: Axes, verdict: Verdict) -> None:
    """Share of touches found, on the drifted leg and on the others."""

    def share(summary: Summary) -> tuple[float, str]:
        recall = summary.counted.recall
        return 100.0 * (recall or 0.0), percent(recall).removesuffix(" %")

    _bars(axes, verdict, share)
    axes.set_title("touches found, %")
    axes.set_ylim(0, 135)
    axes.set_yticks([0, 50, 100], ["0", "50", "100"])
    axes.legend(frameon=False, loc="upper center", ncols=2, fontsize=9.5, columnspacing=1.0)


def _alarms(axes: Axes, verdict: Verdict) -> None:
    """False alarms, on the drifted leg and on the others."""
    tops = _bars(axes, verdict, lambda summary: (summary.false_alarms, str(summary.false_alarms)))
    axes.set_title("false alarms")
    axes.set_ylim(0, max(1.2 * tops, 4))
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))


def _bars(axes: Axes, verdict: Verdict, value: Callable[[Summary], tuple[float, str]]) -> float:
    """Frozen beside service, before and after; the largest value."""
    leg = verdict.drift_leg
    largest = 0.0
    for side, (judged, colour, name) in enumerate(
        ((verdict.frozen, _FROZEN, "frozen"), (verdict.service, _SERVICE, "service"))
    ):
        summaries = (judged.before.legs[leg], judged.after.legs[leg], others(judged.after, leg))
        for group, summary in enumerate(summaries):
            height, words = value(summary)
            x = group + (side - 0.5) * 0.4
            axes.bar(x, height, 0.37, color=colour, label=name if group == 0 else None)
            axes.annotate(
                words, (x, height), (0, 2), textcoords="offset points", ha="center", fontsize=9.5
            )
            largest = max(largest, height)
    axes.set_xticks(range(3), [f"{leg}\nbefore", f"{leg}\nafter", "other legs\nafter"])
    axes.tick_params(axis="x", length=0)
    return largest


def _latency(axes: Axes, verdict: Verdict) -> None:
    """Touch to event, all legs, before and after the drift."""
    outcomes = verdict.service.outcomes
    latency_ms = np.concatenate([o.touches.latency_ns[o.touches.found] for o in outcomes]) / 1e6
    axes.set_title("from touch to event")
    axes.set_xlabel("ms; all legs, whole run", labelpad=2)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    longest = max(60.0, float(latency_ms.max(initial=0.0)))
    axes.set_xlim(0, longest)
    axes.set_xticks(np.arange(0.0, longest + 1.0, _TICK_MS))
    axes.hist(latency_ms, bins=np.arange(0.0, longest + 2.0, 2.0).tolist(), color=_SERVICE)
    axes.set_ylim(0, 1.3 * axes.get_ylim()[1])  # room for the words
    if len(latency_ms):
        median_ms = float(np.median(latency_ms))
        axes.axvline(median_ms, color=_INK, linewidth=1.6)
        axes.annotate(
            f"median {median_ms:.0f} ms",
            (median_ms, 1.0),
            (6, -2),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            va="top",
        )


def _seconds(verdict: Verdict, t_ns: NDArray[np.int64] | int) -> Any:
    """Time since the first sample, s."""
    return (t_ns - verdict.start_ns) / 1e9
