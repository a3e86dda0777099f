"""What a keeper sees of a service, with one number to keep, and a folder to keep it in."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from adaptive_contact.service.state import Identity, Record, StateStore
from adaptive_contact.service.state.format import Position
from adaptive_contact.service.state.keeper import StateKeeper

S = 1_000_000_000
WHO = Identity("mini", "rf", "servo", "0123456789abcdef")


def record(version: int = 1, **fields: Any) -> Record:
    """A state of that leg, told apart by its version."""
    return Record(
        **{
            "identity": WHO,
            "saved_ns": version,
            "package": "",
            "model_version": version,
            "run": None,
            "seq": version,
            "body": {"rows": {"shape": [2, 5], "data": bytes(80)}, "ticks": 7, "name": "ü"},
            **fields,
        }
    )


class Learner:
    """Keeps one number."""

    def __init__(self, number: int = 0, joints: int = 3) -> None:
        self.number = number
        self.joints = joints

    def snapshot(self) -> dict[str, object]:
        return {"number": self.number, "joints": self.joints, "rows": b"x" * 1000}

    def restore(self, snapshot: dict[str, Any]) -> str | None:
        if snapshot.get("joints") != self.joints:
            return f"of {snapshot.get('joints')} joints"
        self.number = snapshot["number"]
        return None


class Desk:
    """What the keeper sees of a leg."""

    def __init__(self, leg: str = "rf", learner: object | None = None) -> None:
        self.leg = leg
        self.learner = learner or Learner(7)
        self.model_version = 1
        self.received_samples = 0
        self.position: Position | None = None

    def deliver(self, count: int = 1) -> None:
        self.received_samples += count
        self.position = Position(None, self.received_samples)


def save(keeper: StateKeeper, desk: Desk) -> None:
    """Once more something is heard, and written."""
    desk.deliver()
    keeper.snapshot(desk, 0)
    assert keeper.flush(5.0)


class Folder:
    """Opens keepers on one folder, one at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.keeper: StateKeeper | None = None
        self.store: StateStore

    def open(self, settings: str = "s") -> StateKeeper:
        self.close()
        self.store = StateStore.open(self.path, "mini")
        self.keeper = StateKeeper(self.store, "mini", lambda _: settings)
        return self.keeper

    def begin(self) -> tuple[StateKeeper, Desk]:
        """A keeper, and a leg that it knows."""
        keeper, desk = self.open(), Desk()
        keeper.restore(desk.leg, desk.learner, "servo", 0)
        return keeper, desk

    def close(self) -> None:
        if self.keeper is not None:
            self.keeper.close(5.0)
            self.keeper = None

    def save(self, number: int) -> None:
        keeper, desk = self.begin()
        desk.learner = Learner(number)
        save(keeper, desk)

    def restored(self, learner: Learner | None = None) -> tuple[int, list[str], list[str]]:
        """The number that came back, what was refused, and the log's lines."""
        made = learner or Learner()
        with capture_logs() as logs:
            keeper = self.open()
            keeper.restore("rf", made, "servo", 0)
        lines = [f"{line['event']}: {line.get('why', '')}" for line in logs]
        return made.number, keeper.facts.refused, lines


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Folder]:
    made = Folder(tmp_path)
    yield made
    made.close()
