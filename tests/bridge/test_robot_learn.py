"""``robot learn``: too little is told in words and kept; others' swings count as well."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from described import AX
from kinematic import KinematicBackend

from adaptive_contact.bridge import training
from adaptive_contact.bridge.training import free_swings
from adaptive_contact.cli._robot_learning import free_file
from adaptive_contact.errors import AdaptiveContactError, TooLittleDataError
from adaptive_contact.model.model_file import load_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.robot.write import write_robot
from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.wire import ServoSample, decode, leg_of_key, servo_key
from programs import invoke, tried
from waiting import Every, until

PERIOD_S = 0.02


@pytest.fixture
def robot(rig: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A rig whose description, with lengths, lies in robot.toml; the test is in its folder."""
    monkeypatch.chdir(tmp_path)
    r = rig(**AX)
    legs = tuple(msgspec.structs.replace(leg, lengths_m=(0.05, 0.06, 0.1)) for leg in r.robot.legs)
    r.robot = msgspec.structs.replace(r.robot, legs=legs)
    Path("robot.toml").write_text(write_robot(r.robot))
    return r


def swings(robot: Robot, index: int) -> Iterator[list[float]]:
    return free_swings(
        robot.legs[index], [0.0] * 3, np.random.default_rng(index), amplitude_rad=0.6,
        max_step_rad=0.15,
    )  # fmt: skip


def recorded(robot: Robot, ticks: int, path: Path) -> None:
    """Swings of legs that the light backend moves, as an earlier run would have kept them."""
    rng = np.random.default_rng(5)
    backend = KinematicBackend(3 * len(robot.legs))
    goals = [swings(robot, i) for i in range(len(robot.legs))]
    quantum = robot.quantum_rad
    with RecordingWriter(path) as file:
        for k in range(ticks):
            t_ns = round(k * PERIOD_S * 1e9)
            backend.advance(k * PERIOD_S)
            for i, leg in enumerate(robot.legs):
                noisy = [backend.angle(3 * i + j) / quantum + rng.normal(0, 0.5) for j in range(3)]
                goal = np.rint(np.array(next(goals[i])) / quantum) * quantum
                for j in range(3):
                    backend.set_goal(3 * i + j, goal[j])
                measured = [quantum * round(x) for x in noisy]
                sample = ServoSample(
                    t_ns=t_ns, seq=k, measured=measured, desired=goal.tolist(), run=1
                )
                file.write_message(servo_key(leg.id), sample, t_ns)


def samples_of(path: Path, leg: str) -> list[ServoSample]:
    return [
        decode(record.payload, ServoSample, record.encoding)
        for record in read_recording(path)
        if leg_of_key(record.key) == leg
    ]


def seconds_of(path: Path, leg: str) -> float:
    """From a leg's first sample to its last; how many there are between is the machine's."""
    stamps = [sample.t_ns for sample in samples_of(path, leg)]
    return (stamps[-1] - stamps[0]) / 1e9


def test_too_little_is_told_in_seconds_and_kept(robot: Any, tmp_path: Path) -> None:
    # Whether a leg gets through a swing in two seconds is the machine's; in these it did.
    recorded(robot.robot, 250, tmp_path / "early.mcap")
    words = ("--config", "robot.toml", "--drive", "--yes", "--seconds", "2", "--out", "b.json")
    words += ("--more", "early.mcap")
    with pytest.raises(TooLittleDataError) as told:
        invoke("robot", "learn", *words)
    line = str(told.value)
    assert re.match(r"leg l[01](, l[01])?: \d+ free swing ticks ", line)
    assert "s at this pace; what was recorded is in b.mcap" in line
    assert "exceedance" not in line
    assert told.value.have < told.value.needed
    assert "run this again with --more early.mcap --more b.mcap" in line
    assert seconds_of(Path("b.mcap"), "l0") > 1.0
    assert not Path("b.json").exists()
    # Two of them are told of together, and none is replaced.
    with pytest.raises(TooLittleDataError, match=r"--more b.mcap --more b-2.mcap to add"):
        invoke("robot", "learn", *words, "--more", "b.mcap")
    assert seconds_of(Path("b-2.mcap"), "l0") > 1.0


def test_a_busy_computer_reads_on_until_it_has_enough(
    robot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the seconds asked for it reads a third of the ticks, and later all of them."""
    recorded(robot.robot, 2600, tmp_path / "early.mcap")
    rows = {leg.id: samples_of(tmp_path / "early.mcap", leg.id) for leg in robot.robot.legs}
    asked: list[float] = []

    def collect(*_: Any, seconds: float, **__: Any) -> dict[str, list[ServoSample]]:
        begin = round(sum(asked[1:], 6.0 if asked else 0.0) / PERIOD_S)
        asked.append(seconds)
        many = round((seconds if asked[1:] else 6.0) / PERIOD_S)
        return {leg: of_leg[begin : begin + many] for leg, of_leg in rows.items()}

    monkeypatch.setattr(training, "collect", collect)
    words = ("--config", "robot.toml", "--drive", "--yes", "--out", "b.json")
    said = invoke("robot", "learn", *words, "--seconds", "18")
    assert f"going on for {asked[1]} s" in said
    assert sum(asked) <= 3 * 18
    assert sorted(load_baseline("b.json").legs) == ["l0", "l1"]
    assert seconds_of(Path("b.mcap"), "l1") > 6.0 + sum(asked[1:]) - 0.1
    asked.clear()
    with pytest.raises(TooLittleDataError, match=r"run this again with --more b-2\.mcap"):
        invoke("robot", "learn", *words, "--seconds", "1", "--force")
    assert asked == [1], "what takes more than three times as long is asked for"


def test_what_another_controller_swings_is_learned_with_an_earlier_recording(
    robot: Any, tmp_path: Path
) -> None:
    recorded(robot.robot, 5600, tmp_path / "early.mcap")
    goals = [swings(robot.robot, i) for i in range(2)]

    def control() -> None:
        """The robot's own controller, which writes goals whenever it likes."""
        for i, goal in enumerate(goals):
            for j, angle in enumerate(next(goal)):
                servo = robot.servo(3 * i + j + 1)
                steps = servo.model.centre + round(angle / servo.model.step_rad)
                servo.write(servo.model.registers["goal_position"].address,
                            steps.to_bytes(2, "little"))  # fmt: skip

    with contextlib.closing(Every(PERIOD_S, control)):
        until(lambda: robot.servo(1).writes)
        said = invoke(
            "robot", "learn", "--config", "robot.toml", "--seconds", "2", "--more", "early.mcap"
        )
    live = samples_of(Path("baseline.mcap"), "l1")
    # Nobody else moves the leg; how far a swing gets in these seconds is the machine's.
    assert np.ptp([sample.desired[1] for sample in live]) > 0.05
    assert np.ptp([sample.measured[1] for sample in live]) > 0.05
    assert sorted(load_baseline("baseline.json").legs) == ["l0", "l1"]
    assert said.count("x the noise of its readings") == 2


def test_recordings_are_not_replaced(tmp_path: Path) -> None:
    assert free_file(tmp_path / "b.json").name == "b.mcap"
    (tmp_path / "b.mcap").touch()
    assert free_file(tmp_path / "b.json").name == "b-2.mcap"
    assert free_file(tmp_path / "c.mcap").name == "c-2.mcap"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("learn", "--out", "/nonexist/b.json"), "there is no folder /nonexist"),
        (("learn", "--out", "."), "it is a folder"),
        (("learn", "--recording", "/nonexist/b.mcap"), "give another --recording"),
        (("learn", "--more", "nothing.mcap"), "nothing.mcap"),
        (("learn", "--drive", "--yes", "--pose", "0,0,3"), "joint 'j2' of leg 'l0' may go from"),
        (("check", "--picture", "/nonexist/x.svg"), "give another --picture"),
        (("init", "--device", "p0", "--out", "/nonexist/r.toml"), "give another --out"),
    ],
)
def test_what_cannot_be_is_told_before_any_work(
    robot: Any, words: tuple[str, ...], message: str
) -> None:
    config = () if words[0] == "init" else ("--config", "robot.toml")
    before = robot.port.requests
    result = tried("robot", *words, *config)
    assert isinstance(result.exception, AdaptiveContactError), result.output
    assert message in str(result.exception)
    assert robot.port.requests == before
