"""Changes lines and constants of detection and learning: do golden recordings notice?

``make same-faults`` plants the faults of :data:`FAULTS`, ``make golden-constants`` doubles and
halves constants that are drawn at random, from a seed.  Files stay as they are: a module is changed
as a process imports it.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import random
import re
import subprocess
import sys
from importlib.machinery import ModuleSpec, SourceFileLoader
from typing import Any, Final, NamedTuple

from adaptive_contact.compiled import CACHE_VARIABLE

from .faults import FAULTS
from .trees import ONE_THREAD, PACKAGE, ROOT

ROOMS: Final = ("core/detect", "core/learn", "model")
# Numbers that only name something, or are the bounds of an integer; and a file that has no others.
_CODES: Final = re.compile(
    "RESTARTED|BROKE_OFF|RESOLVED|BEGAN|WEIGHED|TOPPED|DECIDED|TOUCHED|RATE_OFF|SOURCE|"
    "RELEASE_PENDING|UNKNOWN|SWING|YAW|PITCH|ANY|PAUSE|NONE|ECHO|PHASE|TICKS|TRAVEL|FALL|PEAK|"
    "NOTHING|COEFFICIENTS|ANYTHING|FORMAT|_EVICTED|M.._RUN|MAX_TIME_NS"
)
_OF_CODES: Final = "regressors.py"
# Those of one leg first: most constants are noticed by any recording.
_LAST: Final = ("bad-samples", "cold-start", "lost-samples", "quadruped12", "walk")


class Mutant(NamedTuple):
    """A change of one file of the package: what it is, and the text of the changed file."""

    name: str
    file: str
    text: str

    @property
    def compiled(self) -> bool:
        """Whether machine code may hold it: its module is compiled, or one that takes it over."""
        own = (ROOT / PACKAGE / self.file).read_text(encoding="utf-8")
        taken = re.compile(rf"import[^)]*?\b{re.escape(self.name.split()[0])}\b")
        texts = [path.read_text(encoding="utf-8") for path in (ROOT / PACKAGE).rglob("*.py")]
        return "\n@compiled" in own or any("\n@compiled" in t and taken.search(t) for t in texts)


def faults() -> list[Mutant]:
    """The planted ones.

    Raises:
        SystemExit: a file does not have a fault's line, exactly once.
    """
    found = []
    for fault in FAULTS:
        text = (ROOT / PACKAGE / fault.file).read_text(encoding="utf-8")
        if text.count(fault.old) != 1:
            raise SystemExit(
                f"fault '{fault.name}': found '{fault.old}' {text.count(fault.old)} times in "
                f"{fault.file}, expected once; adapt this fault in tests/same/faults.py"
            )
        found.append(Mutant(fault.name, fault.file, text.replace(fault.old, fault.new)))
    return found


def constants() -> list[tuple[Mutant, Mutant]]:
    """All constants at twice and at half their values; whole numbers stay whole."""
    found = []
    for path in sorted(path for room in ROOMS for path in (ROOT / PACKAGE / room).glob("*.py")):
        text, file = path.read_text(encoding="utf-8"), str(path.relative_to(ROOT / PACKAGE))
        for node in ast.parse(text).body:
            line = ast.get_source_segment(text, node) or ""
            name, _, said = line.partition(" = ")
            name = name.partition(":")[0]
            if not name.strip("_").isupper() or _CODES.fullmatch(name) or path.name == _OF_CODES:
                continue
            try:
                value = eval(said, {"__builtins__": {}})
            except (NameError, SyntaxError, TypeError):  # made of others, and follows them
                continue
            parts = value if isinstance(value, tuple) else (value,)
            if all(type(part) in (int, float) for part in parts):
                scaled = (repr(_scaled(value, factor)) for factor in (2.0, 0.5))
                one, other = (
                    Mutant(f"{name} = {new}", file, text.replace(f"\n{line}", f"\n{name} = {new}"))
                    for new in scaled
                )
                found.append((one, other))
    return found


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_scaled(part, factor) for part in value)
    return type(value)(value * factor)


def notice(mutant: Mutant) -> str | None:
    """The first tick of a golden recording that a change makes another; None where none is."""
    folders = ":".join(f"{ROOT}/{of}" for of in ("", "tests", "sim", "models"))
    # Without the cache: machine code of a change is not kept.
    uncached = {CACHE_VARIABLE: ""} if mutant.compiled else {}
    done = subprocess.run(
        [sys.executable, "-c", f"from same.mutants import Mutant, replay; replay({mutant})"],
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": folders, **uncached},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:  # what is raised while modules are imported
        return done.stderr.strip().splitlines()[-1]
    return done.stdout.strip() or None


def replay(mutant: Mutant) -> None:
    """Replay in this process with a file changed, and print the first tick that differs."""
    sys.meta_path.insert(0, _Finder(mutant))
    golden = importlib.import_module("same.golden")
    for recording in sorted(golden.RECORDINGS, key=_LAST.__contains__):
        of = golden.compared(recording)
        if not of.same:
            print(f"{recording}: {of.first}")
            return


class _Finder(SourceFileLoader):
    """Finds and loads the one module that is changed."""

    def __init__(self, mutant: Mutant) -> None:
        module = mutant.file.removesuffix(".py").replace("/", ".")
        super().__init__(f"{PACKAGE}.{module}", str(ROOT / PACKAGE / mutant.file))
        self._text = mutant.text

    def find_spec(self, name: str, *_: Any) -> ModuleSpec | None:
        if name != self.name:
            return None
        return importlib.util.spec_from_file_location(name, self.path, loader=self)

    def get_code(self, fullname: str) -> Any:
        return compile(self._text, self.path, "exec")


def main(what: str, *, count: str = "30", seed: str = "0", only: str = "") -> int:
    """Print what notices each of the planted faults, or of the constants drawn."""
    if what == "faults":
        drawn = faults()
    else:
        drawn = [
            m for pair in random.Random(int(seed)).sample(constants(), int(count)) for m in pair
        ]
    drawn = [mutant for mutant in drawn if re.match(only, mutant.name)]
    own = (ROOT / PACKAGE / drawn[0].file).read_text(encoding="utf-8")
    unchanged = notice(drawn[0]._replace(text=own))
    if unchanged is not None:
        sys.exit(f"found, with nothing changed: {unchanged}; expected no difference: make test")
    alive = 0
    for mutant in drawn:
        shown = notice(mutant)
        alive += shown is None
        print(f"{mutant.file}, {mutant.name}: {shown or 'NOT NOTICED'}", flush=True)
    print(f"{len(drawn) - alive} of {len(drawn)} noticed")
    return int(alive > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], **dict(given.split("=") for given in sys.argv[2:])))
