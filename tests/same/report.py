"""What a comparison found, as a table and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Final

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from .compare import KINDS, Comparison

__all__ = ["MOST_FLIPS", "print_report", "write_json"]

# Shown of each recording; the file has all.
MOST_FLIPS: Final = 12
MOST_VALUES: Final = 3
MOST_IN_FILE: Final = 5000


def print_report(
    console: Console,
    before: str,
    after: str,
    found: Mapping[str, Comparison],
    expected: frozenset[str],
) -> None:
    """Print a row per recording, every flipped decision, and the first differing values."""
    table = Table(title=f"{before} against {after}", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("recording", no_wrap=True, min_width=max(map(len, found)))
    for name in ("events", "flips", *KINDS, "largest"):
        table.add_column(name, justify="right")
    table.add_column("", no_wrap=True, min_width=len("DIFFERENT"))
    for name, of in found.items():
        events = str(of.events[0]) if of.events[0] == of.events[1] else "{}, {}".format(*of.events)
        counts = [str(n or "") for n in (len(of.flips), *(of.count(kind) for kind in KINDS))]
        size = f"{of.largest:.0e}" if of.largest else ""
        verdict = "same" if of.same else "expected" if name in expected else "DIFFERENT"
        style = None if of.same else "yellow" if name in expected else "red"
        table.add_row(name, events, *counts, size, verdict, style=style)
    console.print(table)
    for name, of in found.items():
        _print_details(console, name, of)
    for line in sorted({field for of in found.values() for field in of.new_fields}):
        console.print(f"new field: {line}", highlight=False)
    for line in sorted({note for of in found.values() for note in of.notes}):
        console.print(f"note: {line}", highlight=False)
    for name in sorted(expected & {name for name, of in found.items() if of.same}):
        console.print(f"note: '{name}' was expected to differ and does not", highlight=False)
    different = [name for name, of in found.items() if not of.same and name not in expected]
    console.print(f"different: {','.join(different) or 'none'}", highlight=False, soft_wrap=True)


def _print_details(console: Console, name: str, of: Comparison) -> None:
    for flip in of.flips[:MOST_FLIPS]:
        what = "contact" if flip.contact else "release"
        scores = " against ".join(_score(s) for s in (flip.before, flip.after))
        line = f"{name}: leg {flip.leg}, seq {flip.seq}: {what} in one only, {scores}"
        console.print(line, highlight=False, markup=False)
        for which, judged in zip(("first", "second"), flip.judged, strict=True):
            if judged is not None:
                of_windows = (
                    f"{what} {' '.join(f'{value:.6g}' for value in judged[what])}"
                    for what in ("scores", "thresholds")
                )
                line = f"    {which}: {', '.join(of_windows)}"
                console.print(line, highlight=False, markup=False)
    if len(of.flips) > MOST_FLIPS:
        console.print(f"{name}: and {len(of.flips) - MOST_FLIPS} more", highlight=False)
    for d in of.differences[:MOST_VALUES]:
        where = "at the end" if d.round < 0 else f"round {d.round}"
        console.print(
            f"{name}: leg {d.leg}, {where}: {d.kind}.{d.field} {d.before!r:.70}, {d.after!r:.70}",
            highlight=False, markup=False,
        )  # fmt: skip


def _score(score: float | None) -> str:
    return "none" if score is None else f"score {score:.6g}"


def write_json(
    path: Path, before: str, after: str, tolerance: float, found: Mapping[str, Comparison]
) -> None:
    """Write everything that differs."""
    content = {
        "before": before,
        "after": after,
        "tolerance": tolerance,
        "recordings": {
            name: {
                "same": of.same,
                "events": of.events,
                "largest": of.largest,
                "flips": [asdict(flip) for flip in of.flips],
                "differences": [asdict(d) for d in of.differences[:MOST_IN_FILE]],
                "differences_in_all": len(of.differences),
                "new_fields": sorted(of.new_fields),
                "notes": sorted(of.notes),
            }
            for name, of in found.items()
        },
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, default=str), encoding="utf-8")
