"""Wrong signs show in the motion, with what to write; right ones are never accused."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import msgspec
import numpy as np
import pytest

from adaptive_contact.adapt import LearnerBank, shipped_baseline
from adaptive_contact.robot import Angles, Mount, Robot, shipped_robot
from adaptive_contact.robot.conventions import LegMotion, Verdict, judge_motion
from adaptive_contact.wire import ServoSample

pytest.importorskip("mujoco")

from adaptive_contact_sim.arrays import Run, record_arrays
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.terrain import TerrainSettings
from adaptive_contact_sim.walk import WalkSettings

DOWN = (1, -1, -1)
SECONDS = 28.0  # a tripod's 20 swings


@functools.cache
def walk(gait: str, ground: str, seed: int) -> Run:
    settings = SimulationSettings(
        motion=WalkSettings(gait=gait, stop_on="truth", react_ms=60.0),
        terrain=TerrainSettings(kind=ground),
        seed=seed,
    )
    return record_arrays(settings, SECONDS)


@functools.cache
def pose(approach: str, seed: int) -> Run:
    motion = PoseSettings(legs=LEGS, workspace="whole", approach=approach)
    return record_arrays(SimulationSettings(motion=motion, seed=seed), SECONDS)


def robot(*, mounts: bool) -> Robot:
    made = shipped_robot()
    if mounts:
        return made
    legs = tuple(msgspec.structs.replace(leg, mount=Mount()) for leg in made.legs)
    return msgspec.structs.replace(made, legs=legs)


def verdict(
    run: Run, signs: Mapping[str, tuple[int, ...]], *, phase: bool, mounts: bool
) -> Verdict:
    motions = {}
    for name, leg in run.legs.items():
        turn = np.array(signs.get(name, (1, 1, 1)), dtype=float)
        swing = leg.swing.copy() if phase else None
        t_ns = np.asarray(run.t_ns)
        motions[name] = LegMotion(t_ns, leg.measured * turn, leg.desired * turn, swing)
    return judge_motion(robot(mounts=mounts), motions)


@pytest.mark.parametrize("mounts", [True, False])
@pytest.mark.parametrize("phase", [True, False])
@pytest.mark.parametrize(
    "run",
    [
        lambda: walk("tripod", "rough", 901),
        lambda: walk("ripple", "flat", 902),
        lambda: pose("descent", 903),
        lambda: pose("slow", 904),
    ],
)
def test_what_is_described_right_is_not_accused(run, phase: bool, mounts: bool) -> None:
    assert verdict(run(), {}, phase=phase, mounts=mounts).findings == ()


@pytest.mark.parametrize("mounts", [True, False])
@pytest.mark.parametrize("phase", [True, False])
def test_pitch_that_grows_downwards_is_found_on_every_leg(phase: bool, mounts: bool) -> None:
    run = walk("tripod", "rough", 901)
    found = verdict(run, dict.fromkeys(LEGS, DOWN), phase=phase, mounts=mounts).findings
    if phase or mounts:
        assert [one.leg for one in found] == list(LEGS)
    else:  # the ground's push alone is not clear on every leg
        assert len(found) >= 3
    for one in found:
        assert one.joints == ("femur", "tibia")
        assert "[leg.angles] directions = [1, -1, -1]" in one.advice


@pytest.mark.parametrize("mounts", [True, False])
def test_one_leg_alone_is_found_and_no_other_accused(mounts: bool) -> None:
    (found,) = verdict(
        walk("tripod", "rough", 901), {"lm": DOWN}, phase=True, mounts=mounts
    ).findings
    assert (found.leg, found.directions) == ("lm", DOWN)


def test_a_single_joint_is_found_where_the_mounts_are_known() -> None:
    (found,) = verdict(
        walk("tripod", "rough", 901), {"rf": (1, 1, -1)}, phase=True, mounts=True
    ).findings
    assert (found.leg, found.joints) == ("rf", ("tibia",))


def samples(run: Run, signs: tuple[int, ...]) -> list[dict[str, ServoSample]]:
    turn = np.array(signs, dtype=float)
    return [
        {
            name: ServoSample(
                t_ns=int(run.t_ns[k]),
                seq=k,
                measured=(leg.measured[k] * turn).tolist(),
                desired=(leg.desired[k] * turn).tolist(),
                phase="swing" if leg.swing[k] else "stance",
                run=1,
            )
            for name, leg in run.legs.items()
        }
        for k in range(len(run.t_ns))
    ]


def test_a_learner_reports_what_to_write_and_is_silent_until_then() -> None:
    bank = LearnerBank(shipped_robot(), shipped_baseline(shipped_robot().name))
    run = walk("tripod", "rough", 901)
    events = []
    for tick in samples(run, DOWN):
        events += [(event, bank.learner(event.leg).status) for event in bank.judge(tick)]
        bank.finish()
    for leg in LEGS:
        status = bank.learner(leg).status
        assert status.status == "ambiguous"
        assert "femur and tibia grow the wrong way" in status.note
        assert "write [leg.angles] directions = [1, -1, -1]" in status.note
        assert "where the bridge reads this leg, write [leg.servos] directions = [" in status.note
        assert not status.contact
    assert all(
        not event.contact for event, status in events if "grow the wrong" in str(status.note)
    )


def test_with_what_it_advises_every_event_is_that_of_the_right_source() -> None:
    right = shipped_robot()
    legs = tuple(msgspec.structs.replace(leg, angles=Angles(directions=DOWN)) for leg in right.legs)
    turned = msgspec.structs.replace(right, legs=legs)
    run = walk("tripod", "rough", 901)
    told = []
    for robot_, signs in ((right, (1, 1, 1)), (turned, DOWN)):
        bank = LearnerBank(robot_, shipped_baseline(robot_.name))
        events = []
        for tick in samples(run, signs):
            events += bank.judge(tick)
            bank.finish()
        told.append(events)
        assert all(bank.learner(leg).status.note is None for leg in LEGS)
    assert len(told[0]) > 100
    assert told[0] == told[1]


@pytest.mark.parametrize("phase", [True, False])
def test_stamps_that_jitter_hide_no_wrong_sign(phase: bool) -> None:
    run = walk("tripod", "rough", 901)
    rng = np.random.default_rng(5)
    turn = np.array(DOWN, dtype=float)
    seq = np.arange(len(run.t_ns))
    motions = {}
    for name, leg in run.legs.items():
        t_ns = run.t_ns + rng.normal(0.0, 0.4 * 20_000_000, len(seq)).astype(np.int64)
        swing = leg.swing.copy() if phase else None
        motions[name] = LegMotion(t_ns, leg.measured * turn, leg.desired * turn, swing, seq)
    clean = verdict(run, dict.fromkeys(LEGS, DOWN), phase=phase, mounts=True)
    assert judge_motion(robot(mounts=True), motions) == clean
    assert [one.leg for one in clean.findings] == list(LEGS)
    for name, motion in motions.items():  # without seq less is found, and nothing else
        motions[name] = dataclasses.replace(motion, seq=None)
    found = judge_motion(robot(mounts=True), motions).findings
    assert {one.directions for one in found} <= {DOWN}
