"""Compares two revisions, ``make same``, or makes golden files again, ``make golden``."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import msgspec
from rich.console import Console

from .compare import Flip, compare, known_fields
from .golden import RECORDINGS, remake
from .recordings import RECIPES, kept
from .report import MOST_FLIPS, print_report, write_json
from .trees import ROOT, Tree, missing, of_revision, playing, tidy, working

OUT: Final = ROOT / "out" / "same"
PROCESSES: Final = 2


def main() -> int:
    """Do what the command line says; 0 where nothing differs unexpectedly."""
    options = _options()
    if options.golden is not None:
        for name in options.golden or RECORDINGS:
            print(f"{name}: {remake(name)}", flush=True)
        return 0
    recordings = options.only or list(RECIPES)
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(f"recordings: {len(recordings)}, in out/same/recordings", highlight=False)
    files = kept(OUT / "recordings", recordings)
    folder = Path(tempfile.mkdtemp(prefix="same-"))
    try:
        return _compare(console, files, folder, options)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _compare(
    console: Console, files: dict[str, Path], folder: Path, options: argparse.Namespace
) -> int:
    began = time.monotonic()
    before = of_revision(options.rev, folder)
    after = working(folder) if options.against is None else of_revision(options.against, folder)
    outcomes: tuple[dict[str, Any], dict[str, Any]] = ({}, {})
    folders = [OUT / "outcomes"] * 2
    if options.fresh:  # each its own, as both may have the same modules
        folders = [folder / "first", folder / "second"]
    trees = {
        (tree.digest, place): tree for tree, place in zip((before, after), folders, strict=True)
    }
    if len(trees) == 1:
        console.print("both revisions have the same modules", highlight=False)
    busy = sum(bool(missing(tree, files, place)) for (_, place), tree in trees.items())
    with ExitStack() as stack:
        at_work = {
            at: stack.enter_context(
                playing(tree, files, at[1], processes=PROCESSES // max(1, busy))
            )
            for at, tree in trees.items()
        }
        sides = [
            at_work[of.digest, place] for of, place in zip((before, after), folders, strict=True)
        ]
        for side, one in zip(outcomes, sides, strict=True):
            side.update(one.done())
        tidy(OUT / "outcomes", [path for one in sides for path in one.outcomes.values()])
    fields = (known_fields(outcomes[0].values()), known_fields(outcomes[1].values()))
    found = {
        name: compare(
            outcomes[0][name], outcomes[1][name], fields=fields,
            tolerance=options.tolerance, ignore=frozenset(options.ignore),
        )
        for name in files
    }  # fmt: skip
    for name, of in found.items():
        of.flips[:MOST_FLIPS] = _judged(of.flips[:MOST_FLIPS], files[name], (before, after), folder)
    write_json(OUT / "differences.json", before.name, after.name, options.tolerance, found)
    print_report(console, before.name, after.name, found, frozenset(options.expect))
    console.print(
        f"{time.monotonic() - began:.0f} s; all differences: out/same/differences.json",
        highlight=False,
    )
    return int(any(not of.same for name, of in found.items() if name not in options.expect))


def _judged(
    flips: list[Flip], recording: Path, trees: tuple[Tree, Tree], folder: Path
) -> list[Flip]:
    """The flips with what either revision says of their ticks; the recording is replayed again."""
    if not flips:
        return []
    content = msgspec.msgpack.decode(recording.read_bytes())
    content["probes"] = [[flip.round, flip.leg] for flip in flips]
    asked = folder / recording.name
    asked.write_bytes(msgspec.msgpack.encode(content))
    said = []
    with ExitStack() as stack:
        places = [folder / "judged" / side for side in ("first", "second")]
        sides = [
            stack.enter_context(playing(tree, {recording.name: asked}, place))
            for tree, place in zip(trees, places, strict=True)
        ]
        for side in sides:
            ((_, outcome),) = side.done()
            said.append({(number, leg): judged for number, leg, judged in outcome["probes"]})
    return [
        replace(flip, judged=tuple(side.get((flip.round, flip.leg)) for side in said))
        for flip in flips
    ]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="same", description=__doc__)
    parser.add_argument("--rev", default="HEAD", help="the first revision")
    parser.add_argument("--against", help="the second one; the working tree where left out")
    parser.add_argument("--tolerance", type=float, default=0.0, help="0 for bit by bit")
    names = {"type": _names, "default": [], "metavar": "NAME,NAME"}
    parser.add_argument("--expect", **names, help="recordings that may differ")
    parser.add_argument("--only", **names, help="recordings to compare")
    parser.add_argument("--ignore", **names, help="fields that may differ, such as status.note")
    parser.add_argument("--fresh", action="store_true", help="replay what was replayed before")
    parser.add_argument("--golden", nargs="*", help="make golden files again; all, or those named")
    options = parser.parse_args([part for part in sys.argv[1:] if part])
    unknown = sorted({*options.expect, *options.only} - set(RECIPES))
    if unknown:
        parser.error(f"no recording {', '.join(unknown)}; there are {', '.join(RECIPES)}")
    return options


def _names(text: str) -> list[str]:
    return [name for name in text.replace(" ", ",").split(",") if name]


if __name__ == "__main__":
    sys.exit(main())
