"""When state is saved, and what is restored."""

from __future__ import annotations

import errno
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from adaptive_contact.robot import parse_robot, shipped_robot
from adaptive_contact.service.state import Record, StateStore, settings_digest
from adaptive_contact.service.state.format import Position
from adaptive_contact.service.state.keeper import StateKeeper
from adaptive_contact.service.state.store import NEWEST

from .conftest import Desk, Folder, Learner, S, save


def test_a_flipped_byte_falls_back_to_the_one_before_in_one_line(folder: Folder) -> None:
    folder.save(1)
    folder.save(2)
    (newest,) = folder.path.rglob(f"*{NEWEST}")
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    folder.close()
    newest.write_bytes(data)
    number, refused, lines = folder.restored()
    assert number == 1
    assert refused == [f"{newest.name}: damaged: its checksum is wrong"]
    assert lines == ["state refused: damaged: its checksum is wrong", "state restored: "]


def test_the_learners_own_refusal_is_told_and_it_starts_clean(folder: Folder) -> None:
    folder.save(1)
    number, refused, lines = folder.restored(Learner(joints=4))
    assert number == 0
    assert refused[0].endswith(": of 3 joints")
    assert lines == ["state refused: of 3 joints"]


def test_other_settings_start_clean_and_keep_the_old(folder: Folder) -> None:
    folder.save(1)
    learner = Learner()
    folder.open(settings="other").restore("rf", learner, "servo", 0)
    assert learner.number == 0
    assert folder.restored()[0] == 1


def test_every_ten_seconds_and_at_once_after_a_promotion(folder: Folder) -> None:
    keeper, desk = folder.begin()
    assert not keeper.due(desk, 100 * S), "without samples there is nothing new"
    desk.deliver()
    assert not keeper.due(desk, 1 * S)
    assert keeper.due(desk, 11 * S)
    keeper.snapshot(desk, 11 * S)
    assert not keeper.due(desk, 30 * S), "nothing heard since"
    desk.deliver()
    assert not keeper.due(desk, 20 * S)
    assert keeper.due(desk, 21 * S)
    desk.model_version = 2
    assert keeper.due(desk, 12 * S)
    keeper.snapshot(desk, 12 * S)
    desk.deliver()
    assert not keeper.due(desk, 13 * S)


def test_settings_are_told_apart() -> None:
    text = """
    [robot]
    name = "mini"
    period_s = 0.02
    quantum_rad = 0.005
    [[leg]]
    id = "rf"
    joints = ["coxa", "femur", "tibia"]
    """
    robot = parse_robot(text, source="test")
    known = settings_digest(robot, "rf")
    changes = [("0.02", "0.01"), ("0.005", "0.006"), ('"tibia"', '"shin"')]
    changed = [parse_robot(text.replace(a, b), source="test") for a, b in changes]
    others = {settings_digest(other, "rf") for other in changed}
    others |= {settings_digest(robot, "xx"), settings_digest(robot, "rf", "a baseline")}
    assert len(others | {known}) == 6
    assert settings_digest(parse_robot(text, source="elsewhere"), "rf") == known


def test_robots_of_one_kind_are_told_apart_by_their_namespaces(tmp_path: Path) -> None:
    from adaptive_contact.cli.serve import keeper_of

    robot = shipped_robot()
    names = (None, "hexapod1", "lab/hexapod2")
    keepers = [keeper_of(tmp_path, robot, None, name) for name in names]
    assert [keeper.facts.error for keeper in keepers] == [None] * 3, "no two share a folder"
    assert len({keeper.facts.folder for keeper in keepers}) == 3
    for keeper in keepers:
        keeper.close()


# -- A disk that is slow, full or closed, and a state that fits no file: told, and nobody wai


def test_a_slow_disk_holds_nobody_up_and_gets_the_newest(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper, desk = folder.begin()
    writing, go_on, written, save_ = threading.Event(), threading.Event(), [], folder.store.save

    def slow(record: Record) -> None:
        writing.set()
        assert go_on.wait(60)
        written.append(record.body["number"])
        save_(record)

    monkeypatch.setattr(folder.store, "save", slow)
    for number in range(1, 6):
        desk.learner.number = number  # type: ignore[attr-defined]
        desk.deliver()
        keeper.snapshot(desk, 0)  # returns at once
        assert writing.wait(60)
    assert not keeper.flush(0.01)
    go_on.set()
    assert keeper.flush(5)
    assert written == [1, 5]


def test_the_end_waits_for_a_slow_disk_and_is_over_before_the_service_is_killed(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file synced on a busy disk was seen to take more than a second."""
    keeper = folder.open()
    waits: list[float] = []
    monkeypatch.setattr(keeper, "flush", lambda timeout_s: not waits.append(timeout_s))
    keeper.close()
    folder.keeper = None
    unit = Path(__file__).parents[2] / "packaging" / "adaptive-contact.service"
    killed = re.search(r"^TimeoutStopSec=(\d+)$", unit.read_text(), re.MULTILINE)
    # All else takes two seconds, and a subscriber that hangs one.
    assert waits[0] > 1.0
    assert waits[0] + 3.0 < float(killed[1])


def test_a_full_disk_is_told_once_and_tried_again(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper, desk = folder.begin()
    full = OSError(errno.ENOSPC, "No space left on device")

    def fails(record: Record) -> None:
        raise full

    with capture_logs() as logs:
        monkeypatch.setattr(folder.store, "save", fails)
        for _ in range(3):
            save(keeper, desk)
        facts = keeper.facts
        monkeypatch.undo()
        keeper.snapshot(desk, 0)
        assert keeper.flush(5)
    assert (facts.saved, facts.failed) == (0, 3)
    assert facts.error == f"rf not saved in {folder.store.folder}: no space left on device"
    assert [line["event"] for line in logs] == ["state not saved", "state is saved again"]
    assert (keeper.facts.saved, keeper.facts.error) == (1, None)


@pytest.mark.parametrize("why", [errno.EROFS, errno.EACCES])
def test_a_folder_that_cannot_be_written_to_is_told_once_and_read(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, why: int
) -> None:
    folder.save(9)
    folder.close()

    opens = os.open

    def refuses(path: Any, flags: int, *rest: Any, **at: Any) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            raise OSError(why, os.strerror(why))
        return opens(path, flags, *rest, **at)

    monkeypatch.setattr("os.open", refuses)
    number, refused, lines = folder.restored()
    assert (number, refused) == (9, [])
    line = (
        f"{folder.store.folder} cannot be written to ({os.strerror(why).lower()}); "
        "give another --state DIR, or --no-state"
    )
    assert lines == [f"state is not saved: {line}", "state restored: "]
    assert folder.keeper.facts.error == line, "what ServiceStatus and watch tell"
    save(folder.keeper, Desk())
    assert (folder.keeper.facts.failed, folder.keeper.facts.error) == (1, line)


def raises() -> dict[str, object]:
    raise ZeroDivisionError("of nothing")


@pytest.mark.parametrize(
    ("snapshot", "number", "why"),
    [
        (raises, 0, "of nothing"),
        (lambda: {"thing": object()}, 0, "encoding objects of type object is unsupported"),
        (dict, 2**70, "can't serialize ints"),
        (dict, -(2**70), "can't serialize ints"),
    ],
    ids=["raises", "cannot be written", "fits no file", "nor that"],
)
def test_a_state_that_cannot_be_kept_is_counted_told_and_ends_no_other(
    folder: Folder, snapshot: Callable[[], Any], number: int, why: str
) -> None:
    keeper = folder.open()
    bad, good = Desk("lf", Learner()), Desk("rf", Learner(3))
    bad.learner.snapshot = snapshot  # type: ignore[attr-defined]
    for desk in (bad, good):
        keeper.restore(desk.leg, desk.learner, "servo", 0)
        desk.deliver()
    bad.position = Position(number, 1)
    with capture_logs() as logs:
        for desk in (bad, good):
            keeper.snapshot(desk, 0)
            assert keeper.flush(5)
    assert (keeper.facts.saved, keeper.facts.failed) == (1, 1)
    assert (logs[0]["event"], logs[0]["leg"]) == ("state not saved", "lf")
    assert why in logs[0]["why"]
    assert folder.restored()[0] == 3


def test_a_folder_that_becomes_free_is_used(folder: Folder) -> None:
    owner = StateStore.open(folder.path, "mini")
    store = StateStore.open(folder.path, "mini")
    with capture_logs() as logs:
        keeper = StateKeeper(store, "mini", lambda _: "s", period_s=0.05)
        desk = Desk(learner=Learner(5))
        keeper.restore("rf", desk.learner, "servo", 0)
        for _ in range(2):
            save(keeper, desk)
            assert "in use by another service" in str(keeper.facts.error)
        owner.close()
        save(keeper, desk)
    assert keeper.facts.error is None
    assert [line["event"] for line in logs] == [
        "state is not saved", "state not saved", "state is saved again"
    ]  # fmt: skip
    keeper.close()
    assert folder.restored()[0] == 5
