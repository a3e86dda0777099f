"""A leg of any chain, and of any size, is inferred, judged and learned as any other is."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adaptive_contact import ContactEvent, ContactLearner, ServoSample
from adaptive_contact.checks.conventions.judge import check_motion
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.model import Baseline, shipped_baseline
from adaptive_contact.model.model_file import dump_baseline, parse_baseline
from adaptive_contact.robot import Leg, Robot, shipped_robot
from adaptive_contact_sim import SimulationSettings, parse_drift, simulated_robot
from adaptive_contact_sim.arrays import LegArrays, Run, record_arrays

from .conftest import LENGTHS, PERIOD, FakeLeg, play, samples


def aside(robot: Robot, yaw_rad: float = 0.7) -> Robot:
    """The same leg in a frame that is turned about z, so that no word describes its pitches."""
    turn = Rotation.from_euler("z", yaw_rad)
    pitch = tuple(turn.apply([0.0, -1.0, 0.0]).tolist())
    leg = msgspec.structs.replace(
        robot.leg("rf"),
        lengths_m=None,
        axes=("yaw", pitch, pitch),
        origins_m=tuple(tuple(turn.apply([length, 0.0, 0.0]).tolist()) for length in LENGTHS),
    )
    assert not leg.chain.is_straight
    return msgspec.structs.replace(robot, legs=(leg,))


def renamed(baseline: Baseline, leg: Leg) -> Baseline:
    """The baseline of the same leg as its other description names it."""
    text = dump_baseline(baseline)
    for name, other in (("φ_femur", "φ(femur)"), ("φ_tibia", "φ(femur+tibia)")):
        text = text.replace(name, other)
    tree = msgspec.json.decode(text)
    tree["legs"]["rf"]["axes"] = leg.joint_axes
    return parse_baseline(msgspec.json.encode(tree), source="renamed")


def test_a_turned_frame_changes_no_event(robot: Robot, baseline: Baseline) -> None:
    """Phase, foot, gradient and gravity go the general way, and all comes out the same."""
    touched = FakeLeg(seed=5).run(60, touch=lambda n: 18 if n % 3 == 0 else None)
    stream = [msgspec.structs.replace(one, phase=None) for one in samples(*touched[:3])]
    other = aside(robot)
    learners = (
        # Both from a file, which has fewer digits.
        ContactLearner(robot, "rf", parse_baseline(dump_baseline(baseline).encode(), source="x")),
        ContactLearner(other, "rf", renamed(baseline, other.leg("rf"))),
    )
    straight, turned = (play(learner, stream) for learner in learners)
    assert len(straight) > 30
    assert [facts(event) for event in turned] == [facts(event) for event in straight]
    assert [e.score for e in turned] == pytest.approx([e.score for e in straight], rel=1e-6)


def facts(event: ContactEvent) -> tuple[object, ...]:
    return event.contact, event.t_ns, event.onset_ns


def test_a_chain_that_is_upside_down_is_found() -> None:
    """Zeros level and pitches the wrong way round: the foot comes down in its swings."""
    up = (0.0, -1.0, 0.0)
    down = (0.0, 1.0, 0.0)
    legs = [
        Leg(
            id="fl",
            joints=("haa", "hfe", "kfe"),
            axes=("roll", axis, axis),
            origins_m=((0.0, 0.04, 0.0), (0.16, 0.0, 0.0), (0.16, 0.0, 0.0)),
        )
        for axis in (up, down)
    ]
    # Thigh down and shank further down, about -y; a swing raises both.
    low, high = np.array([0.0, -0.9, -0.3]), np.array([0.0, -0.5, -0.3])
    share = np.concatenate([np.linspace(0, 1, 10), np.linspace(1, 0, 14), np.zeros(8)])
    desired = np.tile(low + share[:, None] * (high - low), (12, 1))
    swing = np.tile(np.arange(32) < 24, 12)
    seq = np.arange(len(desired))
    motion = LegMotion(seq * PERIOD, seq, desired, desired, swing)
    right, wrong = (
        check_motion(Robot(name="r", period_s=0.02, quantum_rad=0.005, legs=(leg,)), {"fl": motion})
        for leg in legs
    )
    assert "fl" not in right or right["fl"] is None
    finding = wrong["fl"]
    assert finding.grave
    assert "the foot is above its axis, and comes down in its swings" in finding.message


# -- Limits of lengths hold for legs of any size: decisions depend on proportions alone

NAME, LEG = "quadruped12", "fr"


@pytest.fixture(scope="module")
def run() -> Run:
    """A walk in which joints begin to rub: there is much to be labelled."""
    layout = simulated_robot(NAME).layout
    settings = SimulationSettings.from_robot(NAME, "walk", "walk")
    drift = (parse_drift("friction:value=4@6s", layout),)
    return record_arrays(dataclasses.replace(settings, drift=drift, seed=21), 22.0)


def sized(factor: float) -> Robot:
    """The robot, so many times as large; powers of two scale every float exactly."""
    robot = shipped_robot(NAME)
    legs = []
    for leg in robot.legs:
        origins = tuple(tuple(factor * x for x in origin) for origin in leg.origins_m)
        legs.append(msgspec.structs.replace(leg, origins_m=origins))
    return msgspec.structs.replace(robot, legs=tuple(legs))


def decided(
    robot: Robot, leg: LegArrays, t_ns: list[int], *, says: bool
) -> tuple[list[ContactEvent], list[int]]:
    """Events of a leg, and the ticks that were taken for free."""
    learner = ContactLearner(robot, LEG, shipped_baseline(NAME))
    events = []
    for k, at_ns in enumerate(t_ns):
        event = learner.update(
            ServoSample(
                t_ns=at_ns,
                seq=k,
                measured=leg.measured[k].tolist(),
                desired=leg.desired[k].tolist(),
                phase=("swing" if leg.swing[k] else "stance") if says else None,
            )
        )
        if event is not None:
            # Where the foot is, is as large as the leg.
            events.append(msgspec.structs.replace(event, foot_m=None, foot_sd_m=None))
    return events, learner.drain_confirmed()


@pytest.mark.parametrize("says", [True, False])
def test_decisions_do_not_depend_on_the_size_of_a_leg(run: Run, says: bool) -> None:
    leg, t_ns = run.legs[LEG], run.t_ns.tolist()
    usual = decided(sized(1.0), leg, t_ns, says=says)
    assert sum(event.contact for event in usual[0]) > 5
    assert len(usual[1]) > 100
    for factor in (0.25, 4.0):
        assert decided(sized(factor), leg, t_ns, says=says) == usual
