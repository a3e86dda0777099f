"""States of the version before are read, or left for it: an upgrade and a step back lose nothing.

``before/`` has a state as an older revision saved it, with the robot and baseline it belongs to.
"""

from __future__ import annotations

import contextlib
import json
import lzma
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.core.bank import LearnerBank
from adaptive_contact.core.learn.state import FORMAT as SNAPSHOT_FORMAT
from adaptive_contact.model import load_baseline
from adaptive_contact.model.model_file import dump_baseline
from adaptive_contact.robot import load_robot
from adaptive_contact.service.state import FORMAT, StateStore, settings_digest, unpack
from adaptive_contact.service.state.keeper import StateKeeper
from adaptive_contact.wire import ServoSample, servo_key
from programs import Program
from rig import Listener

from .conftest import Desk

HERE = Path(__file__).parent / "before"
SAVED = json.loads((HERE / "status.json").read_text())


@pytest.fixture
def before(tmp_path: Path) -> Path:
    """A folder with the robot's files and, in ``state``, its state of the version before."""
    (tmp_path / "robot.toml").write_bytes((HERE / "robot.toml").read_bytes())
    (tmp_path / "baseline.json").write_bytes(unpacked("baseline.json"))
    (archive,) = HERE.glob("*.state.xz")
    kept = tmp_path / "state" / "hexapod-ax12a" / archive.stem
    kept.parent.mkdir(parents=True)
    kept.write_bytes(unpacked(archive.stem))
    return tmp_path


def unpacked(name: str) -> bytes:
    return lzma.decompress((HERE / f"{name}.xz").read_bytes())


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.suffix != ""}


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[tuple[Listener, Program]]:
    """`serve` and a listener to it; it is asked to end and then has ended."""
    serve = Program(
        *("-m", "adaptive_contact", "serve", "--listen", "127.0.0.1:0", "--state", "state"),
        *("--config", "robot.toml", "--baseline", "baseline.json"),
        cwd=folder,
    )
    with contextlib.closing(serve):
        endpoint = serve.wait_line(r"listening on (\S+?)[;,]")[1]
        with contextlib.closing(Listener(endpoint)) as listener:
            yield listener, serve
        assert serve.stop() == 0


@pytest.mark.e2e
def test_serve_goes_on_from_what_the_version_before_has_learned(before: Path) -> None:
    """The whole service: what it counts goes on, and so does the number that its source counts."""
    (old,) = (before / "state").rglob("*.state")
    content = old.read_bytes()
    with serving(before) as (listener, serve):
        listener.wait(lambda me: "rf" in me.statuses)
        told = listener.statuses["rf"]
        assert (told.ticks, told.contacts) == (SAVED["ticks"], SAVED["contacts"])
        assert told.model_version == SAVED["model_version"]
        assert told.buffer.swings == SAVED["swings"]
        assert told.drift.level == pytest.approx(SAVED["drift_level"])
        publisher = listener.link.publisher(servo_key("rf"), reliable=True)
        for after in range(8, 13):  # 7 were lost while the service was replaced
            publisher.put(
                ServoSample(
                    t_ns=SAVED["t_ns"] + after * 20_000_000,
                    seq=SAVED["seq"] + after,
                    measured=[0.0, -0.4, 1.0],
                    desired=[0.0, -0.4, 1.0],
                )
            )
        listener.wait(lambda me: me.statuses["rf"].ticks == SAVED["ticks"] + 5)
        assert listener.statuses["rf"].missed == 7
    assert any("state restored" in line for line in serve.lines)
    assert not any("state refused" in line for line in serve.lines)
    # A step back: what was saved at the end is in the format that the version before reads, and
    # the state that it had left is the one before.
    record, first = unpack(old.read_bytes()), unpack(content)
    assert record.seq == SAVED["seq"] + 12
    assert old.read_bytes()[8:10] == content[8:10]
    assert record.body["follower"]["format"] == first.body["follower"]["format"]
    assert old.with_suffix(".before").read_bytes() == content


@pytest.mark.parametrize(
    "formats", [(FORMAT + 1, SNAPSHOT_FORMAT), (FORMAT, SNAPSHOT_FORMAT + 1), (FORMAT + 1, 9)]
)
def test_a_version_with_another_format_leaves_these_alone_and_a_step_back_finds_them(
    before: Path, formats: tuple[int, int]
) -> None:
    robot = load_robot(before / "robot.toml")
    baseline = load_baseline(before / "baseline.json")
    left = files(before / "state")

    def opened(kinds: tuple[int, int]) -> tuple[StateKeeper, Any, Any]:
        text = dump_baseline(baseline)
        store = StateStore.open(before / "state", robot.name)
        keeper = StateKeeper(
            store, robot.name, lambda leg: settings_digest(robot, leg, text, formats=kinds)
        )
        learner = LearnerBank(robot, baseline).learner("rf", 3)
        report = learner.model_report
        return keeper, learner, keeper.restore("rf", learner, report.library, 0)

    keeper, learner, position = opened(formats)
    assert position is None
    assert learner.status.ticks == 0
    assert (keeper.facts.restored, keeper.facts.refused) == ([], [])
    for now in (1, 2, 3):  # so often that no name is left that was written before
        keeper.snapshot(Desk("rf", learner), now)
        assert keeper.flush(5)
    keeper.close()
    assert files(before / "state").items() > left.items()
    # A step back, and another step ahead.
    for kinds, ticks in (((FORMAT, SNAPSHOT_FORMAT), SAVED["ticks"]), (formats, 0)):
        keeper, learner, _ = opened(kinds)
        assert keeper.facts.restored == ["rf"]
        assert learner.status.ticks == ticks
        keeper.close()
