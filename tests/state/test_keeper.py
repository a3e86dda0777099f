"""When state is saved, and what is restored."""

from __future__ import annotations

import itertools
from pathlib import Path

from structlog.testing import capture_logs

from adaptive_contact.robot import parse_robot, shipped_robot
from adaptive_contact.service.state import settings_digest
from adaptive_contact.service.state.store import NEWEST

from .conftest import Desk, Folder, Learner, S


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


def test_of_many_refusals_the_first_are_told_and_how_many_more(folder: Folder) -> None:
    keeper = folder.open()
    for number in range(6):
        leg = f"l{number}"
        desk = Desk(leg)
        keeper.restore(leg, Learner(), "servo", 0)
        desk.hear()
        keeper.snapshot(desk, 0)
    assert keeper.flush(5.0)
    keeper = folder.open()
    for number in range(6):
        keeper.restore(f"l{number}", Learner(joints=4), "servo", 0)
        assert len(keeper.facts.refused) == min(number + 1, 5)
    told = keeper.facts.refused
    assert [line.endswith(": of 3 joints") for line in told] == [True] * 4 + [False]
    assert told[-1] == "2 more, as the log says"


def test_other_settings_start_clean_and_keep_the_old(folder: Folder) -> None:
    folder.save(1)
    with capture_logs() as logs:
        keeper = folder.open(settings="other")
        learner = Learner()
        keeper.restore("rf", learner, "servo", 0)
    assert learner.number == 0
    (line,) = logs
    assert line["event"] == (
        "state of other settings, another baseline or another version is left alone"
    )
    assert folder.restored()[0] == 1


def test_every_ten_seconds_and_at_once_after_a_promotion(folder: Folder) -> None:
    keeper = folder.open()
    desk = Desk()
    keeper.restore("rf", desk.learner, "servo", 0)
    assert not keeper.due(desk, 100 * S), "without samples there is nothing new"
    desk.hear()
    assert not keeper.due(desk, 1 * S)
    assert keeper.due(desk, 11 * S)
    keeper.snapshot(desk, 11 * S)
    assert not keeper.due(desk, 30 * S), "nothing heard since"
    desk.hear()
    assert not keeper.due(desk, 20 * S)
    assert keeper.due(desk, 21 * S)
    desk.model_version = 2
    assert keeper.due(desk, 12 * S)
    keeper.snapshot(desk, 12 * S)
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


def test_robots_of_one_kind_are_told_apart_by_their_namespaces(tmp_path: Path) -> None:
    from adaptive_contact.cli.serve import keeper_of

    robot = shipped_robot()
    names = (None, "hexapod1", "lab/hexapod2")
    keepers = [keeper_of(tmp_path, robot, None, name) for name in names]
    assert [keeper.facts.error for keeper in keepers] == [None] * 3, "no two share a folder"
    assert len({keeper.facts.folder for keeper in keepers}) == 3
    for keeper in keepers:
        keeper.close()
