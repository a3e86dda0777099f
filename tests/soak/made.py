"""What the tests of the soak share: a robot, an event, and a run that nobody has conducted."""

from __future__ import annotations

from pathlib import Path

from adaptive_contact.robot import shipped_robot
from adaptive_contact.wire import ContactEvent

from .conduct import Broken, Heard, Take

S = 1_000_000_000
ROBOT = shipped_robot()


def event(seq: int, *, t_ns: int | None = None, onset_ns: int = 0) -> ContactEvent:
    return ContactEvent(
        leg="rf",
        t_ns=seq * 20_000_000 if t_ns is None else t_ns,
        seq=seq,
        onset_ns=onset_ns,
        contact=True,
        status="valid",
        score=2.0,
        residual=[],
        model_version=1,
    )


def take(heard: Heard, broken: tuple[Broken, ...] = ()) -> Take:
    return Take(Path("none"), heard, broken, (), "")
