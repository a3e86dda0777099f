"""A real robot that hangs: its float readings make a baseline, and its angles are not accused."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.cli.fit import gather
from adaptive_contact.conventions.judge import judge_motion
from adaptive_contact.robot import Robot, load_robot
from adaptive_contact.service.recording import read_recording
from adaptive_contact.service.status import LegFacts
from adaptive_contact.wire import ContactEvent, ServoSample, decode

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "dyna1"
pytestmark = pytest.mark.skipif(
    not DATA.exists(),
    reason="no ../shared/data/dyna1: logs of github.com/udesa-ai/dyna1-quadruped, not part of "
    "the project",
)
S = 1_000_000_000


@pytest.fixture(scope="module", params=["described", "assumed"])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """The robot, with the step of its readings and without."""
    text = (DATA / "hung.toml").read_text()
    if request.param == "assumed":
        text = text.replace("quantum_rad = 0.0001\n", "")
    path = tmp_path_factory.mktemp("robot") / "robot.toml"
    path.write_text(text)
    return load_robot(path)


@pytest.mark.parametrize("name", ["hung", "fr_raw"])
def test_float_readings_are_gathered(
    robot: Robot, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert LegFacts.of(robot, "fr").quantum_rad in (None, 1e-4)
    gathered = gather([DATA / f"{name}.mcap"], robot)
    assert "step" not in capsys.readouterr().err
    assert sum(leg.samples for leg in gathered.values()) > 2000


def test_feet_that_hang_accuse_no_angles(robot: Robot) -> None:
    gathered = gather([DATA / "hung.mcap"], robot)
    motions = {leg: one.motion() for leg, one in gathered.items()}
    first, last = (int(motions["fr"].t_ns[k]) for k in (0, -1))
    for begin in range(first, last, 11 * S):
        part = {leg: one.between(begin, begin + 6 * S) for leg, one in motions.items()}
        if all(len(one.t_ns) > 100 for one in part.values()):
            assert judge_motion(robot, part).findings == (), begin


@pytest.fixture(scope="module")
def from_nothing() -> tuple[ContactLearner, list[ContactEvent], list[tuple[int, float]]]:
    """One leg's learner after all of the recording, its events, and its knee's errors by swing."""
    robot = load_robot(DATA / "hung.toml")
    learner, events = ContactLearner(robot, "fl"), list[ContactEvent]()
    errors: list[tuple[int, float]] = []
    swing = 0
    for message in read_recording(DATA / "hung.mcap", robot):
        if message.key != "robot/leg/fl/servo":
            continue
        event = learner.update(decode(message.payload, ServoSample, message.encoding))
        if event is not None:
            events.append(event)
        leg = learner.place.leg
        swing += leg.ticks == 1
        if leg.usable and not leg.after:
            errors.append((swing, float(learner.place.residuals[0][-1])))
    assert swing > 150
    return learner, events, errors


def test_a_robot_that_hangs_is_learned_and_reports_no_contacts(
    from_nothing: tuple[ContactLearner, list[ContactEvent], list[tuple[int, float]]],
) -> None:
    """The drive lags by five ticks, so that half of a descent comes after the turn to stance."""
    _, events, errors = from_nothing
    assert sum(event.contact for event in events) <= 1
    assert not [event for event in events if event.contact and event.status == "valid"]
    knee = np.array([error for swing, error in errors if 20 <= swing < 40])
    assert np.sqrt(np.mean(knee**2)) < 1.3 * 0.8e-3  # a batch fit of all swings: 0.8 mrad


def test_another_gait_in_the_air_is_learned_in_silence(
    from_nothing: tuple[ContactLearner, list[ContactEvent], list[tuple[int, float]]],
) -> None:
    learner, _, errors = from_nothing
    sizes: dict[int, list[float]] = {swing: [] for swing, _ in errors}
    for swing, error in errors:
        sizes[swing].append(abs(error))
    largest = {swing: max(values) for swing, values in sizes.items()}
    another = max(range(60, 90), key=lambda swing: largest.get(swing, 0.0))
    assert largest[another] > 5.0 * largest[another - 2]  # the gait changes here
    later = np.median([largest[swing] for swing in range(another + 20, another + 40)])
    assert later < 0.3 * largest[another]
    assert learner.place.leg.hanging


def test_a_leg_that_hangs_is_found_stopped_half_way_down() -> None:
    """Frozen for 60 ms, in swings whose lifts are predicted; there half of the way is in stance."""
    robot = load_robot(DATA / "hung.toml")
    learner, swing = ContactLearner(robot, "fl"), 0
    stopped: list[int] = []
    found: set[int] = set()
    held: tuple[float, ...] = ()
    left = 0
    for message in read_recording(DATA / "hung.mcap", robot):
        if message.key != "robot/leg/fl/servo":
            continue
        sample = decode(message.payload, ServoSample, message.encoding)
        leg = learner.place.leg
        begins = 40 <= swing < 70 and swing % 4 == 0 and leg.ticks == 17
        if left:
            sample = msgspec.structs.replace(sample, measured=held)
            left -= 1
        elif begins and learner.report.doubt is None:
            held, left = sample.measured, 5
            stopped.append(swing)
        event = learner.update(sample)
        swing += learner.place.leg.ticks == 1
        if event is not None and event.contact:
            found.add(swing)
    assert len(stopped) >= 6
    assert len(found & set(stopped)) >= 0.9 * len(stopped)
