"""A real robot that hangs: its float readings make a baseline, and its angles are not accused."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner, load_baseline
from adaptive_contact.checks.conventions.judge import check_motion
from adaptive_contact.cli.fit import gather
from adaptive_contact.fit.recordings import LegGatherer
from adaptive_contact.fit.train import learn
from adaptive_contact.robot import Robot, load_robot
from adaptive_contact.service.recording import read_recording
from adaptive_contact.status import LegFacts
from adaptive_contact.wire import ServoSample, decode

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


def streams(robot: Robot, path: Path = DATA / "hung.mcap") -> dict[str, list[ServoSample]]:
    """The samples of each leg."""
    found: dict[str, list[ServoSample]] = {leg: [] for leg in robot.leg_ids}
    for message in read_recording(path, robot):
        if message.key.endswith("/servo"):
            sample = decode(message.payload, ServoSample, message.encoding)
            found[message.key.split("/")[2]].append(sample)
    return found


@pytest.mark.parametrize("name", ["hung", "fr_raw"])
def test_float_readings_are_gathered(
    robot: Robot, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert LegFacts.from_robot(robot, "fr").quantum_rad in (None, 1e-4)
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
            assert not any(check_motion(robot, part).values()), begin


@pytest.mark.parametrize(("leg_id", "stopped"), [("fl", 40), ("fr", 65)])
def test_a_leg_that_hangs_is_learned_and_found_stopped_half_way_down(
    leg_id: str, stopped: int
) -> None:
    """From nothing; the drive lags by five ticks, so that half of a descent is in the stance."""
    learner = ContactLearner(load_robot(DATA / "hung.toml"), leg_id)
    knee: list[float] = []
    found: list[int] = []
    swing = left = 0
    held: list[float] = []
    for sample in streams(learner.robot)[leg_id]:
        leg = learner.place.leg
        if swing == stopped and leg.ticks == 17:
            held, left = list(sample.measured), 6  # 60 ms
        if left:
            sample, left = msgspec.structs.replace(sample, measured=held), left - 1
        event = learner.update(sample)
        swing += leg.ticks == 1
        if swing > stopped:
            break
        if event is not None and event.contact:
            found.append(swing)
        if 20 <= swing < 40 and leg.usable and not leg.after:
            knee.append(float(learner.place.residuals[0][-1]))
    assert found == [stopped]
    # A batch fit of all swings errs by 0.8 mrad.
    assert np.sqrt(np.mean(np.square(knee))) < 1.3 * 0.8e-3


def test_a_baseline_without_noise_after_the_turn_alarms_no_leg_that_hangs() -> None:
    """Of a quadruped whose ``phase`` turns when its feet would touch."""
    folder = DATA.parents[1] / "field" / "dackel"
    if not folder.exists():
        pytest.skip("no ../shared/field/dackel: a recording that is not part of the project")
    robot, baseline = load_robot(folder / "robot.toml"), load_baseline(folder / "baseline.json")
    swings = 0
    for leg_id, stream in streams(robot, folder / "hung.mcap").items():
        learner = ContactLearner(robot, leg_id, baseline)
        for sample in stream:
            event = learner.update(sample)
            swings += learner.place.leg.ticks == 1
            assert event is None or not event.contact, (leg_id, sample.t_ns)
    assert swings > 150


def test_legs_that_hang_report_little_and_stay_known() -> None:
    """From nothing; gaits change, and one drive does: what follows in the air is refuted."""
    robot = load_robot(DATA / "hung.toml")
    learners = {leg: ContactLearner(robot, leg) for leg in robot.leg_ids}
    swings = dict.fromkeys(robot.leg_ids, 0)
    contacts: dict[str, list[int]] = {leg: [] for leg in robot.leg_ids}
    for leg_id, stream in streams(robot).items():
        for sample in stream:
            event = learners[leg_id].update(sample)
            swings[leg_id] += learners[leg_id].place.leg.ticks == 1
            if event is not None and event.contact:
                contacts[leg_id].append(swings[leg_id])
    assert sum(swings.values()) > 600
    assert sum(map(len, contacts.values())) <= 8, contacts
    statuses = {leg: learner.status for leg, learner in learners.items()}
    assert {leg: status.swings for leg, status in statuses.items()} == swings
    assert 0 < sum(status.swings_withheld for status in statuses.values()) < 200
    for found in contacts.values():
        assert all(c - a > 2 for a, c in zip(found, found[2:], strict=False)), contacts


def test_a_fit_to_the_first_run_alarms_after_no_turn_of_the_second() -> None:
    """Another gait, in which what is known of the time after the turn does not hold."""
    robot = load_robot(DATA / "hung.toml")
    stretches, second = {}, []
    for leg in robot.legs:
        stream = streams(robot)[leg.id]
        runs = [sample.run for sample in stream]
        begin = runs.index(runs[-1])
        gatherer = LegGatherer(leg, robot.period_s)
        for sample in stream[:begin]:
            gatherer.add_sample(sample)
        stretches[leg.id] = gatherer.stretches(free=True)
        second = stream[begin:] if leg.id == "fr" else second
    baseline = learn(robot, stretches, origin="the first run").baseline
    learner = ContactLearner(robot, "fr", baseline)
    swings, found = 0, []
    for sample in second:
        event = learner.update(sample)
        swings += learner.place.leg.ticks == 1
        if event is not None and event.contact and learner.place.leg.after:
            found.append(swings)
    assert swings > 75
    assert len(found) <= 3, found  # before its stances have shown that it carries nothing
    assert all(swing <= 6 for swing in found)
