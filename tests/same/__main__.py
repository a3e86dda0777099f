"""Compares two revisions, ``make same``, or makes golden files again, ``make golden``."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from .compare import MOST_SHOWN, compare, known_fields
from .golden import RECORDINGS, remake, with_looks
from .trees import ROOT, of_revision, replayed


def main() -> int:
    """Do what the command line says; 0 where nothing differs."""
    options = _options()
    if options.golden is not None:
        for name in options.golden or RECORDINGS:
            print(f"{name}: {remake(name)}", flush=True)
        return 0
    recordings = {
        name: with_looks(make())
        for name, make in RECORDINGS.items()
        if not options.only or name in options.only
    }
    with tempfile.TemporaryDirectory(prefix="same-") as name:
        folder = Path(name)
        first = of_revision(options.rev, folder / "first")
        second = ROOT
        if options.against is not None:
            second = of_revision(options.against, folder / "second")
        before, after = replayed((first, second), recordings, folder)
    fields = (known_fields(before.values()), known_fields(after.values()))
    different = []
    for name in recordings:
        found = compare(
            before[name], after[name], fields=fields,
            tolerance=options.tolerance, ignore=frozenset(options.ignore),
        )  # fmt: skip
        print(f"{name}: {found}")
        for line in found.lines[:MOST_SHOWN] + sorted(found.notes):
            print(f"    {line}")
        different += [] if found.same else [name]
    print(f"different: {','.join(different) or 'none'}")
    return int(bool(different))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="same", description=__doc__)
    parser.add_argument("--rev", default="HEAD", help="the first revision")
    parser.add_argument("--against", help="the second one; the working tree where left out")
    parser.add_argument("--tolerance", type=float, default=0.0, help="0 for bit by bit")
    names = {"type": _names, "default": [], "metavar": "NAME,NAME"}
    parser.add_argument("--only", **names, help="recordings to compare")
    parser.add_argument("--ignore", **names, help="fields that may differ, such as status.note")
    parser.add_argument("--golden", nargs="*", help="make golden files again; all, or those named")
    options = parser.parse_args([part for part in sys.argv[1:] if part])
    unknown = sorted(set(options.only) - set(RECORDINGS))
    if unknown:
        parser.error(f"no recording {', '.join(unknown)}; there are {', '.join(RECORDINGS)}")
    return options


def _names(text: str) -> list[str]:
    return [name for name in text.replace(" ", ",").split(",") if name]


if __name__ == "__main__":
    sys.exit(main())
