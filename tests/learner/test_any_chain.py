"""A leg of any chain is inferred, judged and learned as a straight one is."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adaptive_contact import ContactLearner
from adaptive_contact.checks.conventions.judge import judge_motion
from adaptive_contact.checks.conventions.motion import LegMotion
from adaptive_contact.fit.train import Stretch, learn
from adaptive_contact.model import Baseline
from adaptive_contact.model.model_file import dump_baseline, parse_baseline
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.wire import ContactEvent, ServoSample

from .conftest import LENGTHS, PERIOD, FakeLeg, play, samples

Streams = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


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


def baseline_of(robot: Robot, streams: Streams) -> Baseline:
    measured, desired, swing, _ = streams
    stretch = Stretch(measured, desired, swing, swing, np.ones(len(swing), dtype=bool))
    return learn(robot, {robot.legs[0].id: [stretch]}, origin="test").baseline


def without_phase(stream: list[ServoSample]) -> list[ServoSample]:
    return [msgspec.structs.replace(one, phase=None) for one in stream]


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
    stream = without_phase(samples(*touched[:3]))
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


def rolling() -> Robot:
    """A Solo12-like leg: the hip rolls, and hangs straight down at 0."""
    leg = Leg(
        id="fl",
        joints=("haa", "hfe", "kfe"),
        axes=("roll", (0, 1, 0), (0, 1, 0)),
        origins_m=((0.0, 0.014, 0.0), (0.0, 0.037, -0.16), (0.0, 0.008, -0.16)),
    )
    return Robot(name="solo", period_s=0.02, quantum_rad=0.005, legs=(leg,))


def walk(swings: int, seed: int, *, touching: bool) -> Streams:
    """Swings of 10 ticks up and 14 down, in joint angles; every third is stopped at a touch."""
    rng = np.random.default_rng(seed)
    q = start = np.array([0.0, 0.6, -1.2])
    rows = []
    for number in range(swings):
        top = np.array([0.0, 0.9, -2.0]) + rng.uniform(-0.15, 0.15, 3)
        end = np.array([0.0, 0.6, -1.2]) + rng.uniform(-0.15, 0.15, 3)
        up = [start + (top - start) * (k + 1) / 10 for k in range(10)]
        down = [top + (end - top) * (k + 1) / 14 for k in range(14)]
        stop = 18 if touching and number % 3 == 0 else 99
        for tick, desired in enumerate([*up, *down, *[end] * 4]):
            measured = np.round((q + rng.normal(size=3) * 0.003) / 0.005) * 0.005
            rows.append((measured, desired, tick < 24, tick > stop))
            if tick < stop:
                q = q + 0.35 * 0.164 * np.clip((desired - q) / 0.164, -1.0, 1.0)
        start = end
    measured, desired, swing, held = (np.array(column) for column in zip(*rows, strict=True))
    return measured, desired, swing, held


def test_touches_of_a_hip_that_rolls_are_found() -> None:
    """Without any phase from the source: swings are those of the chain's foot."""
    robot = rolling()
    baseline = baseline_of(robot, walk(400, 1, touching=False))
    learner = ContactLearner(robot, "fl", baseline)
    measured, desired, swing, held = walk(90, 2, touching=True)
    touches = play(learner, without_phase(samples(measured, desired, swing)))
    ticks = np.array([event.t_ns // PERIOD for event in touches if event.contact])
    begins = np.flatnonzero(np.diff(held.astype(int)) == 1) + 1
    found = [begin for begin in begins if ((ticks >= begin) & (ticks < begin + 6)).any()]
    assert len(begins) == 30
    assert len(found) >= 29
    assert len(ticks) <= len(found) + 1


def test_no_motion_confirms_the_signs_of_a_chain_that_may_be_its_mirror_image() -> None:
    """A leg that hangs down at 0 walks as well with all its pitches turned round."""
    robot = rolling()
    measured, desired, swing, _ = walk(30, 3, touching=False)
    for sign in (1.0, -1.0):
        by = np.array([1.0, sign, sign])
        motion = LegMotion(np.arange(len(measured)) * PERIOD, measured * by, desired * by, swing)
        verdict = judge_motion(robot, {"fl": motion})
        assert verdict.fits == ()
        assert verdict.findings == ()


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
    motion = LegMotion(np.arange(len(desired)) * PERIOD, desired, desired, swing)
    right, wrong = (
        judge_motion(Robot(name="r", period_s=0.02, quantum_rad=0.005, legs=(leg,)), {"fl": motion})
        for leg in legs
    )
    assert right.findings == ()
    [finding] = wrong.findings
    assert finding.grave
    assert "the foot is above its axis, and comes down in its swings" in finding.message
