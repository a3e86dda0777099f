"""Prints and draws the walks that ``sim compare`` has made."""

from __future__ import annotations

import io
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from rich import box
from rich.table import Table
from scipy.stats import t as student

from adaptive_contact.arrays import Array
from adaptive_contact_studies.blind import PHASES, POLICIES, Comparison


def tree(found: Comparison) -> dict[str, Any]:
    """Return each seed's figures, for JSON."""
    policies = {
        policy: {phase: [of._asdict() for of in found.figures(policy, phase)] for phase in PHASES}
        for policy in POLICIES
    }
    return {"seconds": found.seconds, "drift_s": found.drift_s, "policies": policies}


def table(found: Comparison) -> Table:
    """Return the means over the seeds."""
    shown = Table(
        *("a swing ends by", "drift", "tilt, °", "p95", "touch, N", "p95"),
        *("swings", "stopped", "in the air", "m", "J/m"),
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        caption="tilt: RMS (± half the 95 % interval of the seeds), p95; touch: the largest force "
        "in 0.1 s, median, p95",
        caption_justify="left",
    )
    for phase in PHASES:
        for name, policy in POLICIES.items():
            rows = np.array(found.figures(name, phase))
            tilt, *rest = rows.mean(axis=0)
            cells = [f"{value:.{digits}f}" for value, digits in zip(rest, _DIGITS, strict=True)]
            shown.add_row(policy.about, phase, f"{tilt:.2f}{_half(rows[:, 0])}", *cells)
        shown.add_section()
    return shown


_DIGITS: Final = (2, 0, 0, 0, 0, 0, 2, 0)


def _half(values: Array) -> str:
    n = len(values)
    if n < 2:
        return ""
    return f" ± {student.ppf(0.975, n - 1) * values.std(ddof=1) / np.sqrt(n):.2f}"


def picture(found: Comparison) -> bytes:
    """Draw tilt over time, and the force of touches before and after the drift; a PNG."""
    figure = Figure((8.0, 3.4), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.9, 1.0))
    for place, (name, policy) in enumerate(POLICIES.items()):
        traces = found.traces[name]
        period_s = traces[0].period_s
        squares = np.mean([trace.tilt_deg**2 for trace in traces], axis=0)
        begins = round(found.drift_s / period_s)
        # RMS of windows of 4 s, of before or of after the drift, never of both.
        parts = [
            part
            for half in (squares[:begins], squares[begins:])
            for part in np.array_split(half, max(round(len(half) * period_s / 4.0), 1))
        ]
        ends_s = np.cumsum([len(part) for part in parts]) * period_s
        t_s = ends_s - 0.5 * period_s * np.array([len(part) for part in parts])
        rms = [np.sqrt(part.mean()) for part in parts]
        left.plot(t_s, rms, color=policy.colour, label=policy.about)
        for shift, phase in zip((-0.17, 0.17), PHASES, strict=True):
            mean = np.mean(np.array(found.figures(name, phase)), axis=0)
            middle, most = mean[2], mean[3]
            filled = policy.colour if phase == "after" else "white"
            right.plot([place + shift] * 2, [middle, most], color=policy.colour, linewidth=1.5)
            right.plot(place + shift, middle, "o", color=policy.colour, markerfacecolor=filled)
    left.axvline(found.drift_s, color="#222222", linewidth=0.8, linestyle=":")
    left.set(xlabel="s", ylabel="body tilt, ° RMS", ylim=(0.0, None), xlim=(0.0, found.seconds))
    left.set_title("drift", fontsize="medium", x=found.drift_s / found.seconds)
    right.set(ylabel="touch force, N", ylim=(0.0, None), xticks=[])
    right.set_xlabel("median to p95;\nopen before the drift, filled after")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()
