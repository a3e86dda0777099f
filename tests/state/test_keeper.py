"""When state is saved, what is restored, and that neither waits for the disk."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from adaptive_contact.robot import parse_robot
from adaptive_contact.service.state import (
    Record,
    StateKeeper,
    StateStore,
    list_states,
    settings_digest,
)
from adaptive_contact.service.state.keeper import Position

S = 1_000_000_000


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
        self.heard_samples = 0
        self.position: Position | None = None

    def hear(self, count: int = 1) -> None:
        self.heard_samples += count
        self.position = Position(None, self.heard_samples)


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

    def close(self) -> None:
        if self.keeper is not None:
            self.keeper.close(5.0)

    def save(self, number: int) -> None:
        keeper = self.open()
        desk = Desk(learner=Learner(number))
        keeper.restore("rf", Learner(), "servo", 0)
        desk.hear()
        keeper.take(desk, 0)
        assert keeper.flush(5.0)

    def restored(self, learner: Learner | None = None) -> tuple[int, list[str], list[str]]:
        """The number that came back, what was refused, and the log's lines."""
        made = learner or Learner()
        with capture_logs() as logs:
            keeper = self.open()
            keeper.restore("rf", made, "servo", 0)
        lines = [f"{line['event']}: {line.get('why', '')}" for line in logs]
        return made.number, keeper.facts.refused, lines

    @property
    def files(self) -> list[Path]:
        return [stored.path for stored in list_states(self.path)]


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """Be nobody, where the tests are run by root, who may do everything."""
    if os.geteuid() != 0:
        yield
        return
    try:
        os.seteuid(65534)
    except OSError:
        pytest.skip("this root can become nobody else")
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Folder]:
    made = Folder(tmp_path)
    yield made
    made.close()


def test_what_was_saved_comes_back(folder: Folder) -> None:
    folder.save(41)
    number, refused, lines = folder.restored()
    assert (number, refused) == (41, [])
    assert lines == ["state restored: "]


def test_nothing_there_is_nothing_to_say(folder: Folder) -> None:
    assert folder.restored() == (0, [], [])


def test_a_flipped_byte_falls_back_to_the_one_before_in_one_line(folder: Folder) -> None:
    folder.save(1)
    folder.save(2)
    newest = folder.store.path(next(iter(folder.keeper._identities.values())))  # type: ignore[union-attr]
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


def test_a_copy_from_another_robot_is_refused_in_one_line(folder: Folder, tmp_path: Path) -> None:
    folder.save(1)
    (file,) = folder.files
    there = tmp_path / "there" / "maxi" / file.name
    there.parent.mkdir(parents=True)
    there.write_bytes(file.read_bytes())
    keeper = StateKeeper(StateStore.open(tmp_path / "there", "maxi"), "maxi", lambda _: "s")
    learner = Learner()
    assert keeper.restore("rf", learner, "servo", 0) is None
    assert learner.number == 0
    assert keeper.facts.refused == [f"{file.name}: of another robot: 'mini', this is 'maxi'"]
    keeper.close()


def test_other_settings_start_clean_and_keep_the_old(folder: Folder) -> None:
    folder.save(1)
    with capture_logs() as logs:
        keeper = folder.open(settings="other")
        learner = Learner()
        keeper.restore("rf", learner, "servo", 0)
    assert learner.number == 0
    (line,) = logs
    assert line["event"] == "state of other settings or another baseline is left alone"
    assert folder.restored()[0] == 1


def test_every_ten_seconds_and_at_once_after_a_promotion(folder: Folder) -> None:
    keeper = folder.open()
    desk = Desk()
    keeper.restore("rf", desk.learner, "servo", 0)
    assert not keeper.due(desk, 100 * S), "without samples there is nothing new"
    desk.hear()
    assert not keeper.due(desk, 1 * S)
    assert keeper.due(desk, 11 * S)
    keeper.take(desk, 11 * S)
    assert not keeper.due(desk, 30 * S), "nothing heard since"
    desk.hear()
    assert not keeper.due(desk, 20 * S)
    assert keeper.due(desk, 21 * S)
    desk.model_version = 2
    assert keeper.due(desk, 12 * S)
    keeper.take(desk, 12 * S)
    desk.hear()
    assert not keeper.due(desk, 13 * S)


def test_legs_are_not_due_together(folder: Folder) -> None:
    keeper = folder.open()
    desks = [Desk(leg) for leg in ("lf", "lm", "lr", "rf", "rm", "rr")]
    for desk in desks:
        keeper.restore(desk.leg, desk.learner, "servo", 0)
        desk.hear()
    due = [[desk.leg for desk in desks if keeper.due(desk, s * S)] for s in range(1, 11)]
    assert len(due[-1]) == 6
    assert max(len(b) - len(a) for a, b in itertools.pairwise(due)) == 1


def test_a_slow_disk_holds_nobody_up_and_gets_the_newest(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = folder.open()
    desk = Desk(learner=Learner())
    keeper.restore("rf", desk.learner, "servo", 0)
    writing, go_on = threading.Event(), threading.Event()
    save = folder.store.save
    written: list[int] = []

    def slow(record: Record) -> None:
        writing.set()
        assert go_on.wait(5)
        written.append(record.body["number"])
        save(record)

    monkeypatch.setattr(folder.store, "save", slow)
    for number in range(1, 6):
        desk.learner.number = number  # type: ignore[attr-defined]
        desk.hear()
        keeper.take(desk, 0)  # returns at once
        assert writing.wait(5)
    assert not keeper.flush(0.01)
    go_on.set()
    assert keeper.flush(5)
    assert written == [1, 5]


def test_a_disk_that_is_too_slow_at_the_end_is_told(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = folder.open()
    writing, go_on = threading.Event(), threading.Event()

    def slow(record: Record) -> None:
        writing.set()
        assert go_on.wait(20)

    monkeypatch.setattr(folder.store, "save", slow)
    for leg in ("lf", "rm", "lr"):  # the first is being written, the others wait
        desk = Desk(leg)
        keeper.restore(leg, desk.learner, "servo", 0)
        desk.hear()
        keeper.take(desk, 0)
        assert writing.wait(5)
    with capture_logs() as logs:
        keeper.close(0.01)
    folder.keeper = None
    go_on.set()
    (line,) = logs
    assert line["event"] == "state not saved in time, the one before it stays"
    assert line["legs"] == "lr rm"


def test_a_full_disk_is_told_once_and_tried_again(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = folder.open()
    desk = Desk()
    keeper.restore("rf", desk.learner, "servo", 0)
    full = OSError(errno.ENOSPC, "No space left on device")

    def fails(record: Record) -> None:
        raise full

    with capture_logs() as logs:
        monkeypatch.setattr(folder.store, "save", fails)
        for _ in range(3):
            desk.hear()
            keeper.take(desk, 0)
            assert keeper.flush(5)
        facts = keeper.facts
        monkeypatch.undo()
        keeper.take(desk, 0)
        assert keeper.flush(5)
    assert (facts.saved, facts.failed) == (0, 3)
    assert facts.error == f"rf not saved in {folder.store.folder}: no space left on device"
    assert [line["event"] for line in logs] == ["state not saved", "state is saved again"]
    assert (keeper.facts.saved, keeper.facts.error) == (1, None)


def test_a_snapshot_that_cannot_be_written_does_not_end_the_thread(folder: Folder) -> None:
    keeper = folder.open()
    bad, good = Desk("lf", Learner()), Desk("rf", Learner(3))
    bad.learner.snapshot = lambda: {"thing": object()}  # type: ignore[attr-defined]
    for desk in (bad, good):
        keeper.restore(desk.leg, desk.learner, "servo", 0)
        desk.hear()
        keeper.take(desk, 0)
        assert keeper.flush(5)
    assert (keeper.facts.saved, keeper.facts.failed) == (1, 1)
    assert folder.restored()[0] == 3


@pytest.mark.parametrize("why", [errno.EROFS, errno.EACCES])
def test_a_folder_that_cannot_be_written_to_is_told_once_and_read(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, why: int
) -> None:
    folder.save(9)
    folder.close()
    folder.keeper = None

    def refuses(*_: Any, **__: Any) -> int:
        raise OSError(why, os.strerror(why))

    monkeypatch.setattr("os.open", refuses)
    number, refused, lines = folder.restored()
    assert (number, refused) == (9, [])
    line = (
        f"{folder.store.folder} cannot be written to ({os.strerror(why).lower()}); "
        "give another --state DIR, or --no-state"
    )
    assert lines == [f"state is not saved: {line}", "state restored: "]
    assert folder.keeper is not None
    assert folder.keeper.facts.error == line, "what ServiceStatus and watch tell"
    desk = Desk()
    desk.hear()
    assert not folder.keeper.due(desk, 100 * S)


def test_a_folder_that_may_not_be_looked_into_is_one_line(folder: Folder) -> None:
    """Not two more for each leg, of files that may not even be there."""
    folder.save(9)
    folder.close()
    folder.keeper = None
    folder.path.chmod(0)
    try:
        with unprivileged():
            number, refused, lines = folder.restored()
    finally:
        folder.path.chmod(0o700)
    assert (number, refused) == (0, [])
    assert lines == [
        f"state is not saved: {folder.store.folder} cannot be written to (permission denied); "
        "give another --state DIR, or --no-state"
    ]


@pytest.mark.parametrize("number", [2**70, -(2**70)])
def test_a_number_that_fits_no_file_is_counted_and_does_not_end_the_thread(
    folder: Folder, number: int
) -> None:
    keeper = folder.open()
    bad, good = Desk("lf", Learner()), Desk("rf", Learner(3))
    for desk in (bad, good):
        keeper.restore(desk.leg, desk.learner, "servo", 0)
        desk.hear()
    bad.position = Position(number, 1)
    for desk in (bad, good):
        keeper.take(desk, 0)
        assert keeper.flush(5)
    assert (keeper.facts.saved, keeper.facts.failed) == (1, 1)
    assert folder.restored()[0] == 3


def test_a_snapshot_that_raises_is_counted_and_told(folder: Folder) -> None:
    keeper = folder.open()
    bad, good = Desk("lf", Learner()), Desk("rf", Learner(3))

    def raises() -> dict[str, object]:
        raise ZeroDivisionError("of nothing")

    bad.learner.snapshot = raises  # type: ignore[attr-defined]
    with capture_logs() as logs:
        for desk in (bad, good):
            keeper.restore(desk.leg, desk.learner, "servo", 0)
            desk.hear()
            keeper.take(desk, 0)
            assert keeper.flush(5)
    assert (keeper.facts.saved, keeper.facts.failed) == (1, 1)
    assert {"event": "state not saved", "leg": "lf", "why": "of nothing"}.items() <= logs[0].items()


def test_a_folder_that_becomes_free_is_used(folder: Folder) -> None:
    owner = StateStore.open(folder.path, "mini")
    store = StateStore.open(folder.path, "mini")
    with capture_logs() as logs:
        keeper = StateKeeper(store, "mini", lambda _: "s", period_s=0.05)
        desk = Desk(learner=Learner(5))
        keeper.restore("rf", desk.learner, "servo", 0)
        desk.hear()
        assert not keeper.due(desk, 100 * S)
        assert "in use by another service" in str(keeper.facts.error)
        owner.close()
        until = time.monotonic() + 20
        while not keeper.due(desk, 100 * S):
            assert time.monotonic() < until
            time.sleep(0.01)
        keeper.take(desk, 100 * S)
        assert keeper.flush(5)
    assert keeper.facts.error is None
    assert [line["event"] for line in logs] == ["state is not saved", "state is saved again"]
    keeper.close()
    assert folder.restored()[0] == 5


def test_a_promotion_before_the_first_save_is_saved_at_once(folder: Folder) -> None:
    keeper = folder.open()
    for leg in ("lf", "lm", "lr", "rm", "rr", "rf"):  # the last one's turn comes late
        keeper.restore(leg, Learner(), "servo", 0)
    desk = Desk()
    desk.hear()
    assert not keeper.due(desk, 0), "what it began with is no promotion"
    desk.model_version = 2
    assert keeper.due(desk, 1)


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
