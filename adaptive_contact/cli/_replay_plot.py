"""Draws a replay: per leg stance, contact and truth, test ratio, misses, and the joints.

It is one page without anything from elsewhere, to zoom into.  Its size is bounded: where a
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

from adaptive_contact.cli._output import print_line
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.files import write_file
from adaptive_contact.service.replay import LegTrace, Spans

# Marks, the gravest first, and what is said of how many there are.
_KINDS: Final = {
    "miss": "missed",
    "false": "false",
    "beyond": "maybe beyond any detector",
    "hit": "hit",
}


def check_plot(path: Path) -> None:
    """Make sure that a plot can be drawn, before any work is done for it.

    Raises:
        ConfigurationError: another suffix.
    """
    if path.suffix.lower() != ".html":
        raise ConfigurationError(f"--plot {path}: expected a name that ends with .html")


def write_plot(
    path: Path, traces: Sequence[LegTrace], title: str, *, mark_s: float | None = None
) -> None:
    """Draw what was detected, missed and why.

    Args:
        path: of the file, ``.html``.
        traces: of the legs.
        title: of the page.
        mark_s: a moment that is marked.

    Raises:
        RecordingError: it cannot be written, or there is no leg.
    """
    if not traces:
        raise RecordingError(f"{path}: not written; no leg of the recording could be replayed")
    data = _html(traces, title, mark_s)
    write_file(path, data, error=RecordingError)
    counts = {
        kind: sum(t.kind == kind for trace in traces for t in trace.touches) for kind in _KINDS
    }
    summary = "no truth in the recording: contacts are drawn, not judged"
    if any(trace.truth is not None for trace in traces):
        summary = ", ".join(f"{counts[kind]} {name}" for kind, name in _KINDS.items())
    print_line(f"{path}: {summary}; {len(data) / 1000:.0f} kB", err=True)


def _html(traces: Sequence[LegTrace], title: str, mark_s: float | None) -> bytes:
    page = resources.files("adaptive_contact.cli").joinpath("replay_plot.html").read_text("utf-8")
    # Of all legs together: 400 000 ticks are 2 MB of text, 20 minutes of six legs at 50 Hz.
    room = max(2, 400_000 // len(traces))
    spans = max(2, 60_000 // (3 * len(traces)))
    touches = [(leg, touch) for leg, trace in enumerate(traces) for touch in trace.touches]
    touches.sort(key=lambda pair: list(_KINDS).index(pair[1].kind))
    kept = sorted(touches[:20_000], key=lambda pair: pair[1].at_s)
    data = {
        "title": title,
        "top": 3.0,  # times the threshold
        "mark_ms": None if mark_s is None else round(mark_s * 1000),
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
    angles = trace.angles
    step = max(1, math.ceil(angles.size / room))
    none = -(2**31)
    lists = np.where(np.isfinite(angles), np.round(angles * 1e4), none).astype(int)[::step]
    named = [
        {
            "name": name,
            "measured": lists[:, 0, j].tolist(),
            "desired": lists[:, 1, j].tolist(),
            "predicted": [None if x == none else x for x in lists[:, 2, j].tolist()],
        }
        for j, name in enumerate(trace.joints)
    ]
    return {"joints": named, "curve_ms": np.round(trace.t_s[::step] * 1000).astype(int).tolist()}


def _merged(spans: Spans, room: int) -> list[list[int]]:
    """Convert spans to ms; neighbours become one where there are too many."""
    step = max(1, math.ceil(len(spans) / room))
    groups = [spans[i : i + step] for i in range(0, len(spans), step)]
    return [[round(group[0][0] * 1000), round(group[-1][1] * 1000)] for group in groups]
