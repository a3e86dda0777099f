"""Colours and style of the scenarios' pages.

A page of plots for every scenario: one leg-run in detail, all of them below.

Top to bottom: the statistic over its threshold, the threshold itself and the residual on ticks
where the leg was truly free, swing by swing; what became of every swing; how the model's terms
moved; what the full learner said of itself; and, over all leg-runs, how many swings were lost.

One page over all scenarios: recall, false alarms and recovery of every learner.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.learn.lifecycle import ready_for_changes
from adaptive_contact.score import LegOutcome
from adaptive_contact_studies.scenarios.judge import Judgement
from adaptive_contact_studies.scenarios.learners import reference_baseline
from adaptive_contact_studies.scenarios.recording import Recording, file_of, load
from adaptive_contact_studies.scenarios.replay import STATUSES, LegReplay, load_replay, replay_file
from adaptive_contact_studies.scenarios.results import ALARMS_PER_HOUR, RECOVERY_MEDIAN
from adaptive_contact_studies.scenarios.runner import Folders
from adaptive_contact_studies.scenarios.spec import Expect, Scenario, Variant
from adaptive_contact_studies.show.figures import INK, new_figure, save, styled

COLOURS: Final = {
    Variant.FROZEN: "#8c8c8c",
    Variant.UNGATED: "#d1495b",
    Variant.REFIT: "#b38600",
    Variant.RLS: "#4a9b6e",
    Variant.FULL: "#1f5fa8",
}
# What became of a swing, worst last; the values are those of ``adaptive_contact.score.Outcome``.
OUTCOMES: Final = {
    "clean": "#dfe5ea",
    "hit": "#8fbf9f",
    "miss": "#f0a202",
    "false alarm": "#c1121f",
}
PALETTE: Final = 160
DPI: Final = 84
STYLE: Final[dict[str, Any]] = {
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#999999",
    "axes.labelcolor": INK,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "legend.frameon": False,
    "legend.fontsize": 8,
}

_STATUS_COLOURS: Final = {
    "learning": "#b7c4cf",
    "valid": "#cfe3d4",
    "adapting": "#f6d9a6",
    "ambiguous": "#e7a9b1",
    "silent": "#eeeeee",
}
_TERMS_SHOWN: Final = 5
# Swings around a mark in the last panel, and over how many the share of lost ones is taken.
_AROUND: Final = (-20, 60)
_SMOOTH: Final = 3
_BLOCKS: Final = 60
# Ticks after a contact whose residuals, and windows of residuals, still know of it.
_AFTERMATH: Final = 6
# Swings further apart than this are not joined by a line.
_GAP_S: Final = 3.0


@styled(STYLE, "a page of plots")
def draw_page(judgement: Judgement, folders: Folders, path: Path) -> bool:
    """Draw a scenario's page.

    Returns:
        Whether there was anything to draw.

    Raises:
        MissingExtraError: matplotlib is not installed.
        ConfigurationError: the picture cannot be written.
    """
    scenario = judgement.scenario
    if not judgement.leg_runs:
        return False
    leg, spec, _ = judgement.leg_runs[0]
    recording = load(file_of(spec.recording, folders.recordings))
    replayed = load_replay(spec, replay_file(spec, folders.replays))
    if recording is None or replayed is None:
        return False
    page = new_figure(11.5, 14.5, dpi=DPI)
    page.suptitle(f"{scenario.name}: {scenario.about}", x=0.01, ha="left", color=INK, fontsize=12)
    axes = page.subplots(7, 1, gridspec_kw={"height_ratios": [3, 1.7, 2.4, 1.9, 2.4, 1.7, 3]})
    variants = replayed[leg]
    swings = judgement.variants[Variant.FROZEN][0].outcome
    _scores(axes[0], recording, leg, swings, variants)
    _thresholds(axes[1], recording, leg, swings, variants)
    _residuals(axes[2], recording, leg, swings, variants)
    _outcomes(axes[3], judgement)
    _terms(axes[4], scenario.robot, leg, variants[Variant.FULL])
    _status(axes[5], variants[Variant.FULL])
    for ax in axes[:6]:
        ax.set_xlim(0.0, spec.recording.seconds)
        _moments(ax, scenario)
    axes[0].set_title(
        f"Leg {leg}, seed {spec.recording.settings.seed}: largest statistic over threshold while "
        "truly free; above 1 it would be a false alarm"
    )
    axes[5].set_xlabel("s")
    _all_leg_runs(axes[6], judgement)
    save(page, path, PALETTE)
    return True


# -- one leg-run -----------------------------------------------------------------------------------


def _free_by_swing(
    recording: Recording, leg: str, outcome: LegOutcome, values: Array, *, largest: bool
) -> tuple[Array, Array]:
    """Times of swings (s,), and their largest or root mean square value on truly free ticks."""
    touched = np.convolve(recording.touching(leg), np.ones(_AFTERMATH))[: len(values)] > 0
    free = recording.legs[leg].swing & ~touched & np.isfinite(values)
    swing = np.searchsorted(outcome.swings.start_ns, recording.t_ns[free], side="right") - 1
    picked, swing = values[free][swing >= 0], swing[swing >= 0]
    count = len(outcome.swings.start_ns)
    if largest:
        found = np.full(count, -np.inf)
        np.maximum.at(found, swing, picked)
    else:
        total = np.bincount(swing, np.square(picked), minlength=count)
        found = np.sqrt(total / np.maximum(np.bincount(swing, minlength=count), 1))
    judged = np.isin(np.arange(count), swing)
    return outcome.swings.start_ns[judged] / 1e9, found[judged]


def _scores(
    ax: Any, recording: Recording, leg: str, outcome: LegOutcome, variants: dict[Variant, LegReplay]
) -> None:
    for variant in (Variant.FROZEN, Variant.FULL):
        trace = variants[variant].trace
        if trace is None or not np.isfinite(trace.score).any():
            continue
        t, score = _free_by_swing(recording, leg, outcome, trace.score, largest=True)
        ax.plot(t, np.maximum(score, 0.02), ".", ms=4, color=COLOURS[variant], label=variant.value)
    ax.axhline(1.0, color=INK, lw=0.8)
    _log(ax)
    ax.set_ylabel("score")
    _legend(ax)


def _thresholds(
    ax: Any, recording: Recording, leg: str, outcome: LegOutcome, variants: dict[Variant, LegReplay]
) -> None:
    what = "Threshold with level, tail and uncertainty of the model"
    ax.set_title(f"{what}, × the first; largest per swing")
    for variant, replayed in variants.items():
        trace = replayed.trace
        if trace is None or not np.isfinite(trace.threshold).any():
            continue
        first = trace.threshold[np.isfinite(trace.threshold)][0]
        t, limit = _free_by_swing(recording, leg, outcome, trace.threshold / first, largest=True)
        wide = 1.6 if variant is Variant.FULL else 0.9
        ax.plot(t, limit, color=COLOURS[variant], lw=wide, label=variant.value)
    _log(ax)
    ax.set_ylabel("× the first")
    if ax.lines:
        _legend(ax)


def _residuals(
    ax: Any, recording: Recording, leg: str, outcome: LegOutcome, variants: dict[Variant, LegReplay]
) -> None:
    for variant, replayed in variants.items():
        if replayed.trace is None or not np.isfinite(replayed.trace.residual_rad).any():
            continue
        norm = np.degrees(np.sqrt(np.square(replayed.trace.residual_rad).mean(axis=1)))
        t, rms = _free_by_swing(recording, leg, outcome, norm, largest=False)
        wide = 1.6 if variant is Variant.FULL else 0.9
        holes = np.flatnonzero(np.diff(t) > _GAP_S) + 1
        t, rms = np.insert(t, holes, np.nan), np.insert(rms, holes, np.nan)
        ax.plot(t, rms, color=COLOURS[variant], lw=wide, label=variant.value)
    _log(ax)
    ax.set_ylabel("degrees")
    ax.set_title("Residual on truly free ticks, root mean square per swing")
    _legend(ax)


def _outcomes(ax: Any, judgement: Judgement) -> None:
    names = list(judgement.variants)
    for row, variant in enumerate(names):
        swings = judgement.variants[variant][0].outcome.swings
        for name, colour in OUTCOMES.items():
            which = (swings.outcome == name) & (swings.judged > 0)
            ax.vlines(swings.start_ns[which] / 1e9, row - 0.4, row + 0.4, color=colour, lw=1.4)
    ax.set_yticks(range(len(names)), [variant.value for variant in names])
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_title("What became of every swing")
    x = 0.72
    for name, colour in OUTCOMES.items():
        box = {"facecolor": colour, "edgecolor": "none", "pad": 1.5}
        ink = "white" if name == "false alarm" else INK
        ax.text(x, 1.05, name, color=ink, transform=ax.transAxes, fontsize=8, bbox=box)
        x += 0.025 + 0.008 * len(name)


def _terms(ax: Any, robot: str, leg: str, full: LegReplay) -> None:
    ax.set_ylabel("degrees per tick")
    ax.set_title("Terms moved most, × usual size")
    trace, known = full.trace, ready_for_changes(reference_baseline(robot).legs[leg])
    names = known.model.library.names
    if trace is None or not len(trace.names) or tuple(trace.names) != names:
        return
    started = next((k for k, c in enumerate(trace.coefficients) if np.any(c)), None)
    if started is None:
        return
    moved = np.degrees(trace.coefficients * known.scale[:, None]).astype(np.float64)
    moved[:started] = np.nan
    change = moved - moved[started]
    flat = np.nan_to_num(np.abs(change)).max(axis=0)
    for index in np.argsort(-flat, axis=None)[:_TERMS_SHOWN]:
        term, joint = np.unravel_index(index, flat.shape)
        if flat[term, joint] == 0.0:
            continue
        name = f"{known.model.library.joints[joint]}: {names[term]}"
        ax.plot(full.log.t_ns / 1e9, change[:, term, joint], lw=1.2, label=name)
    if ax.lines:
        _legend(ax)


def _status(ax: Any, full: LegReplay) -> None:
    log = full.log
    t = log.t_ns / 1e9
    if len(t):
        edges = np.concatenate((t, t[-1:] + 0.5))
        for k, status in enumerate(log.status):
            colour = _STATUS_COLOURS[STATUSES[status]]
            ax.axvspan(edges[k], edges[k + 1], color=colour, lw=0)
        ax.plot(t, np.maximum(log.level, 0.1), color=INK, lw=1.0)
        marks = {"promoted": "^", "refused": "x", "rolled_back": "v"}
        for name, marker in marks.items():
            at = t[np.diff(getattr(log, name), prepend=0) > 0]
            ax.plot(at, np.full(len(at), 0.45), marker, ms=5, color=INK, ls="none")
    _log(ax)
    ax.set_ylim(bottom=0.3)
    ax.set_ylabel("drift level")
    ax.set_title(
        "The full learner of itself: drift level; refits promoted (▲), refused (×), rolled back (▼)"
    )
    x = 0.72
    for name in ("learning", "valid", "adapting", "ambiguous"):
        box = {"facecolor": _STATUS_COLOURS[name], "edgecolor": "none", "pad": 1.5}
        ax.text(x, 1.05, name, transform=ax.transAxes, fontsize=8, bbox=box)
        x += 0.072


def _legend(ax: Any) -> None:
    """Above the plot, at the right: nothing of it is hidden."""
    small = 7 if max(len(str(line.get_label())) for line in ax.lines) > 12 else 8
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "borderpad": 0.1}
    ax.legend(ncols=len(ax.lines), fontsize=small, columnspacing=1.4, **place)


def _log(ax: Any) -> None:
    low, high = ax.get_ylim()
    if 0.0 < low < high < 2.5 * low:  # there the scale would show one tick, and looks the same
        return
    ax.set_yscale("log", subs=[3])
    ax.yaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("")


def _moments(ax: Any, scenario: Scenario) -> None:
    for mark in scenario.marks:
        if mark.at_s > 0:
            ax.axvline(mark.at_s, color=INK, lw=0.8, ls=(0, (4, 3)))


# -- all of them -----------------------------------------------------------------------------------


def _all_leg_runs(ax: Any, judgement: Judgement) -> None:
    scenario = judgement.scenario
    count = len(judgement.leg_runs)
    # A step is over at once and is counted in swings; what comes slowly is shown over time.
    sudden = scenario.expect is not Expect.FOLLOW
    marked = sudden and bool(scenario.marks) and scenario.marks[0].at_s > 0
    ax.set_title(f"All {count} leg-runs: swings with a missed touch or a false alarm")
    for variant, judged in judgement.variants.items():
        outcomes = [one.outcome for one in judged]
        wide = 2.0 if variant is Variant.FULL else 1.1
        if marked:
            x, share = _around_mark(outcomes, scenario.marks[0].at_s)
        else:
            x, share = _over_time(outcomes)
        ax.plot(x, 100.0 * share, color=COLOURS[variant], lw=wide, label=variant.value)
    _legend(ax)
    if marked:
        ax.axvline(0.0, color=INK, lw=0.8, ls=(0, (4, 3)))
        ax.set_xlabel(f"swings of the leg since '{scenario.marks[0].name}'")
    else:
        _moments(ax, scenario)
        ax.set_xlabel("s")
    ax.set_ylabel("% of swings lost")
    ax.set_ylim(-2.0, 102.0)


def _around_mark(outcomes: list[LegOutcome], at_s: float) -> tuple[Array, Array]:
    first, last = _AROUND
    lost, there = np.zeros(last - first), np.zeros(last - first)
    for outcome in outcomes:
        swings = outcome.swings
        place = np.arange(len(swings.start_ns)) - np.searchsorted(swings.start_ns, at_s * 1e9)
        use = (place >= first) & (place < last) & (swings.judged > 0)
        np.add.at(lost, place[use] - first, swings.errors[use] > 0)
        np.add.at(there, place[use] - first, 1.0)
    ones = np.ones(_SMOOTH)
    share = np.convolve(lost, ones, "same") / np.maximum(np.convolve(there, ones, "same"), 1.0)
    # No averaging across the mark itself: what is lost after it must not show before it.
    raw = lost / np.maximum(there, 1.0)
    edge = slice(-first - _SMOOTH // 2, -first + _SMOOTH // 2 + 1)
    share[edge] = raw[edge]
    share[there == 0] = np.nan
    return np.arange(first, last, dtype=np.float64), share


def _over_time(outcomes: list[LegOutcome]) -> tuple[Array, Array]:
    start = np.concatenate([o.swings.start_ns[o.swings.judged > 0] for o in outcomes]) / 1e9
    lost = np.concatenate([o.swings.errors[o.swings.judged > 0] > 0 for o in outcomes])
    edges = np.linspace(0.0, float(start.max(initial=1.0)) + 1e-6, _BLOCKS + 1)
    block = np.digitize(start, edges) - 1
    total = np.bincount(block, minlength=_BLOCKS)[:_BLOCKS]
    share = np.bincount(block, lost, minlength=_BLOCKS)[:_BLOCKS] / np.maximum(total, 1)
    return 0.5 * (edges[:-1] + edges[1:]), np.asarray(share)


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
