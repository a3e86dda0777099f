"""Counts the files that samples pass on their way to a contact's event, uncompiled.

Run it with ``NUMBA_DISABLE_JIT=1``: compiled functions enter no file.  It prints one JSON list of
files for each contact event; ``bank.judge`` is the way from a sample to its event.
"""

from __future__ import annotations

import functools
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import adaptive_contact
from adaptive_contact.bank import LearnerBank
from adaptive_contact.robot import parse_robot
from learner import conftest as made

PACKAGE = Path(adaptive_contact.__file__).parent


@functools.cache
def ours(file: str) -> str | None:
    """A source of the package by its name there, None for any other: asked at every call.

    `compiled.py` is none: it hands arrays over, which is no call in compiled code.
    """
    path = Path(file)
    if PACKAGE not in path.parents or path.name == "compiled.py":
        return None
    return str(path.relative_to(PACKAGE))


def main() -> None:
    """Walk a leg whose every other swing touches, and print what its contact ticks enter."""
    robot = parse_robot(made.TOML, source="test")
    bank = LearnerBank(robot, made.baseline.__wrapped__(robot))
    stream = made.samples(*made.FakeLeg(seed=2).run(9, touch=lambda n: 16 if n % 2 else None)[:3])
    for sample in stream:
        entered: dict[str, int] = {}

        def enter(frame: Any, kind: str, _: Any, entered: dict[str, int] = entered) -> None:
            if kind == "call" and (name := ours(frame.f_code.co_filename)) is not None:
                entered[name] = entered.get(name, 0) + 1

        sys.setprofile(enter)
        try:
            events = bank.judge({"rf": sample})
        finally:
            sys.setprofile(None)
        bank.finish()
        if any(event.contact for event in events):
            print(json.dumps(entered))


if __name__ == "__main__":
    main()
