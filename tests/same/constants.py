"""Doubles and halves constants of detection and learning: do golden recordings notice?

Constants are drawn at random, from a seed; ``make golden-constants``.  The files stay as they are:
a module is changed as a process imports it.
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
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, SourceFileLoader
from typing import Any, Final, NamedTuple

from .trees import ONE_THREAD, PACKAGE, ROOT

ROOMS: Final = ("detect", "learn", "model")
# Numbers that only name something, or are the bounds of an integer; and a file that has no others.
_CODES: Final = re.compile(
    "RESTARTED|BROKE_OFF|RESOLVED|BEGAN|WEIGHED|TOPPED|DECIDED|TOUCHED|TOUCH_KEPT|RATE_OFF|SOURCE|"
    "RELEASE_PENDING|UNKNOWN|SWING|YAW|PITCH|ANY|PAUSE|NONE|ECHO|PHASE|TICKS|TRAVEL|FALL|PEAK|"
    "NOTHING|COEFFICIENTS|ANYTHING|FORMAT|_EVICTED|M.._RUN|MAX_TIME_NS"
)
_OF_CODES: Final = "regressors.py"
# Those of one leg first: most constants are noticed by any recording.
_LAST: Final = ("bad-samples", "cold-start", "lost-samples", "quadruped12", "walk")


class Constant(NamedTuple):
    """A number, or several, that a module names: file, name, value and its place in the text."""

    file: str
    name: str
    value: Any
    begin: int
    end: int

    def changed(self, factor: float) -> str:
        """The text of its file with another value; whole numbers stay whole."""
        text = (ROOT / self.file).read_text(encoding="utf-8")
        return f"{text[: self.begin]}{_scaled(self.value, factor)!r}{text[self.end :]}"

    @property
    def compiled(self) -> bool:
        """Whether machine code may hold it: its own module is compiled, or one that names it."""
        texts = [path.read_text(encoding="utf-8") for path in (ROOT / PACKAGE).rglob("*.py")]
        named = re.compile(rf"\b{self.name}\b")
        return any("\n@compiled" in text and named.search(text) for text in texts)


def constants() -> list[Constant]:
    """All of them, in the order of their files."""
    found = []
    for path in sorted(
        file
        for room in ROOMS
        for file in (ROOT / PACKAGE / room).glob("*.py")
        if file.name != _OF_CODES
    ):
        text = path.read_text(encoding="utf-8")
        begins = [0]
        for line in text.splitlines(keepends=True):
            begins.append(begins[-1] + len(line))
        for node in ast.parse(text).body:
            if not (isinstance(node, ast.AnnAssign | ast.Assign) and (of := node.value)):
                continue
            name = ast.unparse(node.target if isinstance(node, ast.AnnAssign) else node.targets[0])
            begin, end = (
                begins[of.lineno - 1] + of.col_offset,
                begins[of.end_lineno - 1] + of.end_col_offset,
            )
            try:
                value = eval(text[begin:end], {"__builtins__": {}})
            except (NameError, TypeError):  # made of others, and follows them
                continue
            parts = value if isinstance(value, tuple) else (value,)
            if (
                name.strip("_").isupper()
                and not _CODES.fullmatch(name)
                and parts
                and all(type(part) in (int, float) for part in parts)
            ):
                found.append(Constant(str(path.relative_to(ROOT)), name, value, begin, end))
    return found


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_scaled(part, factor) for part in value)
    return type(value)(value * factor)


def notice(constant: Constant, factor: float) -> str | None:
    """The first tick of a golden recording that differs with another value; None where none is."""
    arguments = (constant.file, constant.name, factor)
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": f"{ROOT}:{ROOT}/tests"}
    if constant.compiled:  # plain Python takes less time than the compiler
        environment["NUMBA_DISABLE_JIT"] = "1"
    done = subprocess.run(
        [sys.executable, "-c", f"from same.constants import replay; replay{arguments}"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:  # what is raised while modules are imported
        return done.stderr.strip().splitlines()[-1]
    return done.stdout.strip() or None


def replay(file: str, name: str, factor: float) -> None:
    """Replay in this process with a constant changed, and print the first tick that differs."""
    (constant,) = [one for one in constants() if (one.file, one.name) == (file, name)]
    sys.meta_path.insert(0, _Finder(constant, factor))
    golden = importlib.import_module("same.golden")
    for recording in sorted(golden.RECORDINGS, key=_LAST.__contains__):
        of = golden.compared(recording)
        if not of.same:
            print(f"{recording}: {of.first}")
            return


class _Finder(SourceFileLoader):
    """Finds and loads the one module that is changed."""

    def __init__(self, constant: Constant, factor: float) -> None:
        super().__init__(
            constant.file.removesuffix(".py").replace("/", "."), str(ROOT / constant.file)
        )
        self._text = constant.changed(factor)

    def find_spec(self, name: str, *_: Any) -> ModuleSpec | None:
        return (
            importlib.util.spec_from_file_location(name, self.path, loader=self)
            if name == self.name
            else None
        )

    def get_code(self, fullname: str) -> Any:
        return compile(self._text, self.path, "exec")


def main(count: int, seed: int, names: Sequence[str]) -> int:
    """Draw constants, or take those named, and print what notices twice and half their values."""
    of = constants()
    drawn = [one for one in of if one.name in names] or random.Random(seed).sample(of, count)
    alive = 0
    for one in drawn:
        for factor in (2.0, 0.5):
            shown = notice(one, factor)
            alive += shown is None
            print(
                f"{one.file} {one.name} = {one.value} x {factor}: {shown or 'NOT NOTICED'}",
                flush=True,
            )
    return int(alive > 0)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]))
