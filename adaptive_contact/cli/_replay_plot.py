"""Draws a replay: per leg stance, contact and truth, test ratio, misses, and the joints.

HTML is one file without anything from elsewhere, to zoom into.  Its size is bounded: where a
recording is long, ticks are drawn together by their largest test ratio, so that no peak is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from adaptive_contact.cli._output import say
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.files import write_file
from adaptive_contact.service.replay import LegTrace, Spans
from adaptive_contact_studies.show.figures import needs_matplotlib, new_figure, png

# Ratios are drawn up to this many times the threshold.
_TOP_RATIO: Final = 3.0
_ORDER: Final = ("miss", "false", "beyond", "hit")
_STYLE: Final = {
    "hit": ("hit", "#2a8a4a", "o"),
    "miss": ("missed", "#c62828", "v"),
    "beyond": ("missed, maybe beyond any detector", "#b58900", "v"),
    "false": ("false", "#8e24aa", "x"),
}
_STRIPS: Final = (("stance", "#c3c9d0"), ("contact", "#1f6fb4"), ("truth", "#0e8a94"))
_P_COLOUR: Final = "#e07b00"
_CURVES: Final = ("measured", "desired", "predicted")


def check_plot(path: Path) -> None:
    """Make sure that a plot can be drawn, before any work is done for it.

    Raises:
        ConfigurationError: another suffix, or an extra that is not installed.
    """
    if path.suffix.lower() not in (".html", ".png"):
        raise ConfigurationError(f"--plot {path}: expected a name that ends with .html or .png")
    if path.suffix.lower() == ".png":
        needs_matplotlib("--plot FILE.png", "plot")


def write_plot(
    path: Path, traces: Sequence[LegTrace], title: str, *, mark_s: float | None = None
) -> None:
    """Draw what was detected, missed and why.

    Args:
        path: of the file, ``.html`` or ``.png``.
        traces: of the legs.
        title: of the picture.
        mark_s: a moment that a PNG marks.

    Raises:
        RecordingError: it cannot be written, or there is no leg.
    """
    if not traces:
        raise RecordingError(f"{path}: not written; no leg of the recording could be replayed")
    data = _html(traces, title) if path.suffix.lower() == ".html" else _png(traces, title, mark_s)
    write_file(path, data, error=RecordingError)
    counts = {
        kind: sum(t.kind == kind for trace in traces for t in trace.touches) for kind in _ORDER
    }
    summary = "no truth in the recording: contacts are drawn, not judged"
    if any(trace.truth is not None for trace in traces):
        names = {kind: _STYLE[kind][0].removeprefix("missed, ") for kind in _ORDER}
        summary = ", ".join(f"{counts[kind]} {names[kind]}" for kind in _ORDER)
    say(f"{path}: {summary}; {len(data) / 1000:.0f} kB", err=True)


# -- HTML ------------------------------------------------------------------------------------------


def _html(traces: Sequence[LegTrace], title: str) -> bytes:
    page = resources.files("adaptive_contact.cli").joinpath("replay_plot.html").read_text("utf-8")
    # Of all legs together: 400 000 ticks are 2 MB of text, 20 minutes of six legs at 50 Hz.
    room = max(2, 400_000 // len(traces))
    spans = max(2, 60_000 // (3 * len(traces)))
    touches = [(leg, touch) for leg, trace in enumerate(traces) for touch in trace.touches]
    touches.sort(key=lambda pair: _ORDER.index(pair[1].kind))
    kept = sorted(touches[:20_000], key=lambda pair: pair[1].at_s)
    data = {
        "title": title,
        "top": _TOP_RATIO,
        "left_out": len(touches) - len(kept),
        "legs": [
            # Angles of all legs together.
            _leg(trace, room, spans) | _joints(trace, 600_000 // len(traces))
            for trace in traces
        ],
        "touches": [
            {"leg": leg, "at": round(t.at_s, 4), "kind": t.kind, "why": t.why} for leg, t in kept
        ],
    }
    # Inside <script>, only "<" could end it.
    text = msgspec.json.encode(data).replace(b"<", b"\\u003c").decode()
    return page.replace("{{data}}", text).encode()


def _leg(trace: LegTrace, room: int, spans: int) -> dict[str, Any]:
    order = np.argsort(trace.t_s, kind="stable")
    t_s, ratio = trace.t_s[order], trace.ratio[order]
    step = max(1, math.ceil(len(t_s) / room))
    begins = np.arange(0, len(t_s), step)
    filled = np.where(np.isfinite(ratio), ratio, -1.0)
    peaks = np.maximum.reduceat(filled, begins) if len(begins) else filled
    p = trace.p[order][begins]
    # Hundredths; -1 for ticks that could not be judged, and for an unknown p.
    hundredths = np.where(peaks < 0, -1, np.round(np.minimum(peaks, 99.0) * 100)).astype(int)
    return {
        "leg": trace.leg,
        "note": trace.note,
        "merged": step,
        "t_ms": np.round(t_s[begins] * 1000).astype(int).tolist(),
        "ratio": hundredths.tolist(),
        "p": np.where(np.isfinite(p), np.round(p * 100), -1).astype(int).tolist(),
        "stance": _merged(trace.stance, spans),
        "contact": _merged(trace.contact, spans),
        "truth": None if trace.truth is None else _merged(trace.truth, spans),
    }


def _joints(trace: LegTrace, room: int) -> dict[str, Any]:
    """Convert the joints' curves to ms and tenths of a mrad; None where not judged."""
    curves = trace.curves
    if curves is None or not len(curves.t_ns):
        return {"joints": [], "curve_ms": []}
    angles = curves.angles
    step = max(1, math.ceil(angles.size / room))
    t_s = trace.t_s[0] + (np.array(curves.t_ns[::step]) - curves.t_ns[0]) / 1e9
    lists = np.where(np.isfinite(angles), np.round(angles * 1e4), -(2**31)).astype(int)[::step]
    named = [
        {"name": name, **{what: lists[:, k, j].tolist() for k, what in enumerate(_CURVES)}}
        for j, name in enumerate(curves.joints)
    ]
    for joint in named:
        joint["predicted"] = [None if value == -(2**31) else value for value in joint["predicted"]]
    return {"joints": named, "curve_ms": np.round(t_s * 1000).astype(int).tolist()}


def _merged(spans: Spans, room: int) -> list[list[int]]:
    """Convert spans to ms; neighbours become one where there are too many."""
    step = max(1, math.ceil(len(spans) / room))
    groups = [spans[i : i + step] for i in range(0, len(spans), step)]
    return [[round(group[0][0] * 1000), round(group[-1][1] * 1000)] for group in groups]


# -- PNG -------------------------------------------------------------------------------------------


def _png(traces: Sequence[LegTrace], title: str, mark_s: float | None) -> bytes:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    end_s = max(float(trace.t_s.max(initial=1.0)) for trace in traces)
    # A step of a second gets a third of an inch, up to what viewers open.
    wide = min(60.0, max(12.0, end_s / 3))
    figure = new_figure(wide, 1.0 + 3.0 * len(traces), layout=None)
    axes = figure.subplots(2 * len(traces), 1, sharex=True, squeeze=False)[:, 0]
    for axis, below, trace in zip(axes[::2], axes[1::2], traces, strict=True):
        _draw_joints(below, trace)
        for place, (name, colour) in enumerate(_STRIPS):
            spans = getattr(trace, name)
            if spans:
                bars = [(begin, end - begin) for begin, end in spans]
                axis.broken_barh(bars, (-0.4 - 0.35 * place, 0.28), color=colour)
        axis.plot(trace.t_s, np.minimum(trace.ratio, _TOP_RATIO), color="#34495e", lw=0.7)
        axis.plot(trace.t_s, trace.p, color=_P_COLOUR, lw=0.7)
        axis.axhline(1.0, color="#34495e", lw=0.8, ls="--")
        for kind, (_, colour, mark) in _STYLE.items():
            at = [touch.at_s for touch in trace.touches if touch.kind == kind]
            axis.plot(at, [_TOP_RATIO + 0.3] * len(at), mark, color=colour, ms=5, clip_on=False)
        axis.set_ylim(-1.25, _TOP_RATIO + 0.6)
        axis.set_yticks([0, 1, 2, 3], ["0", "1", "2", "≥3"])
        axis.set_ylabel(trace.leg, rotation=0, ha="right", va="center", fontweight="bold")
        axis.spines[["top", "right"]].set_visible(False)
        axis.margins(x=0.005)
        if mark_s is not None:
            axis.axvline(mark_s, color="#34495e", lw=1.6)
    axes[-1].set_xlabel("time since the first sample, s")
    keys: list[Any] = [Patch(color=colour, label=name) for name, colour in _STRIPS]
    keys.append(Line2D([], [], color="#34495e", lw=1, label="test ratio (1 = threshold)"))
    keys.append(Line2D([], [], color=_P_COLOUR, lw=1, label="p, that the foot carries"))
    keys.append(Line2D([], [], color="#34495e", lw=1, ls=":", label="command"))
    keys.append(Line2D([], [], color="#34495e", lw=1, ls="--", label="prediction"))
    keys += [
        Line2D([], [], color=colour, marker=mark, ls="", label=name)
        for name, colour, mark in _STYLE.values()
    ]
    figure.suptitle(title, fontweight="bold")
    figure.legend(handles=keys, loc="lower center", ncols=len(keys), fontsize=8, frameon=False)
    width, height = figure.get_size_inches()
    figure.subplots_adjust(
        left=1.0 / width,
        right=1 - 0.2 / width,
        top=1 - (0.5 + 0.2 * title.count("\n")) / height,
        bottom=0.85 / height,
    )
    return png(figure)


def _draw_joints(axis: Any, trace: LegTrace) -> None:
    curves = trace.curves
    axis.spines[["top", "right"]].set_visible(False)
    axis.set_ylabel("rad")
    if curves is None:
        return
    t_s = trace.t_s[0] + (np.array(curves.t_ns) - curves.t_ns[0]) / 1e9
    for j, name in enumerate(curves.joints):
        measured, desired, predicted = curves.angles[:, :, j].T
        (line,) = axis.plot(t_s, measured, lw=0.9, label=name)
        axis.plot(t_s, desired, lw=0.6, ls=":", color=line.get_color())
        axis.plot(t_s, predicted, lw=0.6, ls="--", color="#34495e")
    axis.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 0.95),
        fontsize=7,
        ncols=len(curves.joints),
        frameon=False,
    )
