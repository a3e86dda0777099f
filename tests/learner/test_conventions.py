"""Wrong signs show in the motion, with what to write; right ones are never accused."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactEvent, LearnerBank, ServoSample
from adaptive_contact.checks.conventions.judge import (
    ConventionFinding,
    Findings,
    check_hanging,
    check_motion,
)
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Angles, Mount, Robot, shipped_robot
from adaptive_contact_sim import PoseSettings, SimulationSettings, TerrainSettings, WalkSettings
from adaptive_contact_sim.arrays import Run, record_arrays
from adaptive_contact_sim.elements import LEGS
from quadruped import recorded

Turn = Callable[[np.ndarray], np.ndarray]
DOWN = (1, -1, -1)
turned_down = functools.partial(np.multiply, DOWN)
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
    bare = tuple(msgspec.structs.replace(leg, mount=Mount()) for leg in made.legs)
    return made if mounts else msgspec.structs.replace(made, legs=bare)


def motions_of(run: Run) -> dict[str, LegMotion]:
    t_ns, seq = np.asarray(run.t_ns), np.arange(len(run.t_ns))
    return {
        name: LegMotion(t_ns, seq, leg.measured, leg.desired, leg.swing.copy())
        for name, leg in run.legs.items()
    }


def turned(
    motions: Mapping[str, LegMotion], turns: Mapping[str, Turn], *, phase: bool
) -> dict[str, LegMotion]:
    """Of a source whose angles are these functions of the description's."""
    made = {}
    for name, motion in motions.items():
        turn = turns.get(name, np.array)
        made[name] = motion._replace(
            measured=turn(motion.measured),
            desired=turn(motion.desired),
            swing=motion.swing if phase else None,
        )
    return made


def accused(found: Findings) -> list[ConventionFinding]:
    return [finding for finding in found.values() if finding is not None]


def accused_of(
    run: Run, turns: Mapping[str, Turn], *, phase: bool, mounts: bool
) -> list[ConventionFinding]:
    motions = turned(motions_of(run), turns, phase=phase)
    return accused(check_motion(robot(mounts=mounts), motions))


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
    assert accused_of(run(), {}, phase=phase, mounts=mounts) == []


@pytest.mark.parametrize("mounts", [True, False])
@pytest.mark.parametrize("phase", [True, False])
def test_pitch_that_grows_downwards_is_found_on_every_leg(phase: bool, mounts: bool) -> None:
    run = walk("tripod", "rough", 901)
    found = accused_of(run, dict.fromkeys(LEGS, turned_down), phase=phase, mounts=mounts)
    if phase or mounts:
        assert [one.leg for one in found] == list(LEGS)
    else:  # the ground's push alone is not clear on every leg
        assert len(found) >= 3
    for one in found:
        assert one.joints == ("femur", "tibia")
        assert "[leg.angles] directions = [1, -1, -1]" in one.advice


@pytest.mark.parametrize(
    ("turn", "mounts", "joints", "what", "expected"),
    [
        (turned_down, True, ("femur", "tibia"), "directions", DOWN),
        (turned_down, False, ("femur", "tibia"), "directions", DOWN),
        (lambda q: q * (1, 1, -1), True, ("tibia",), "directions", (1, 1, -1)),
        (lambda q: q[:, ::-1], True, ("coxa", "tibia"), "order", (2, 1, 0)),
        (lambda q: q - [0.2513, 0.0, 0.0], True, ("coxa",), "offsets_rad", (0.2513, 0.0, 0.0)),
        (lambda q: q - [-0.2513, 0.0, 0.0], True, ("coxa",), "offsets_rad", (-0.2513, 0.0, 0.0)),
    ],
)
def test_one_leg_alone_is_found_and_no_other_accused(
    turn: Turn, mounts: bool, joints: tuple[str, ...], what: str, expected: tuple[float, ...]
) -> None:
    run = walk("tripod", "rough", 901)
    (found,) = accused_of(run, {"lm": turn}, phase=True, mounts=mounts)
    assert (found.leg, found.joints) == ("lm", joints)
    assert getattr(found, what) == pytest.approx(expected, abs=0.06)
    assert found.grave is (what != "offsets_rad")


@pytest.mark.parametrize("phase", [True, False])
@pytest.mark.parametrize("order", [(2, 1, 0), (0, 2, 1), (1, 2, 0)])
def test_another_order_of_joints_is_found(order: tuple[int, ...], phase: bool) -> None:
    run = walk("tripod", "rough", 901)
    found = accused_of(
        run, dict.fromkeys(LEGS, lambda q: q[:, list(order)]), phase=phase, mounts=True
    )
    assert [one.leg for one in found] == list(LEGS)
    assert {one.order for one in found} == {tuple(np.argsort(order))}
    names = ("coxa", "femur", "tibia")
    came = ", ".join(names[k] for k in order)
    assert f"they seem to come as {came};" in found[0].message
    assert found[0].advice.endswith("in the order coxa, femur, tibia")
    ids = robot(mounts=True).legs[0].servos.ids
    wired = [ids[k] for k in np.argsort(order)]
    assert found[0].servo_advice(robot(mounts=True).legs[0]) == f"write [leg.servos] ids = {wired}"


@pytest.mark.parametrize(("femur_rad", "judged"), [(0.02, True), (0.0, False), (-0.02, False)])
def test_angles_are_judged_by_feet_that_carry(femur_rad: float, judged: bool) -> None:
    def turn(q: np.ndarray) -> np.ndarray:
        return q[:, [0, 2, 1]]

    run = walk("tripod", "rough", 901)
    motions = {}
    for name, leg in run.legs.items():
        read = leg.desired + np.array([0.0, femur_rad, 0.0])  # pushed up, or hanging below
        t_ns, seq = np.asarray(run.t_ns), np.arange(len(run.t_ns))
        motions[name] = LegMotion(t_ns, seq, turn(read), turn(leg.desired), leg.swing.copy())
    found = accused(check_motion(robot(mounts=True), motions))
    by_feet = [one.leg for one in found if "feet that stand" in one.message]
    assert by_feet == (list(LEGS) if judged else [])


@pytest.mark.parametrize(
    ("signs", "zeros", "phase"),
    [
        ((1, 1, 1), (0.0, 0.3, -0.6), True),
        pytest.param((1, 1, 1), (0.0, 0.3, -0.6), False, marks=pytest.mark.slow),
        pytest.param((1, -1, -1), (0.0, 0.0, -np.pi / 2), True, marks=pytest.mark.slow),
        ((1, -1, -1), (0.0, 0.0, -np.pi / 2), False),
        ((1, 1, 1), (0.0, 0.0, 0.2513), True),  # 14.4 degrees
        pytest.param((1, 1, 1), (0.0, 0.0, 0.2513), False, marks=pytest.mark.slow),
    ],
)
def test_zeros_of_all_legs_are_found_together_with_signs(
    signs: tuple[int, ...], zeros: tuple[float, ...], phase: bool
) -> None:
    told = 0
    # Not every walk shows them, and which do depends on the last digit of a simulated one.
    for seed in (905, 907, 908, 909):
        run = walk("tripod", "rough", seed)
        found = accused_of(
            run, dict.fromkeys(LEGS, lambda q: (q - zeros) * signs), phase=phase, mounts=True
        )
        if not found:
            continue
        told += 1
        assert [one.leg for one in found] == list(LEGS)
        for one in found:
            assert one.directions == signs
            assert np.abs(np.subtract(one.offsets_rad, zeros)).max() < 0.06
            assert one.grave == (signs != (1, 1, 1))
    assert told >= 3


def samples(run: Run, turn: Turn) -> list[dict[str, ServoSample]]:
    read = {name: (turn(leg.measured), turn(leg.desired)) for name, leg in run.legs.items()}
    return [
        {
            name: ServoSample(
                t_ns=int(run.t_ns[k]),
                seq=k,
                measured=read[name][0][k].tolist(),
                desired=read[name][1][k].tolist(),
                phase="swing" if leg.swing[k] else "stance",
                run=1,
            )
            for name, leg in run.legs.items()
        }
        for k in range(len(run.t_ns))
    ]


def play(
    source: list[dict[str, ServoSample]], described: Robot | None = None
) -> tuple[LearnerBank, list[ContactEvent], list[str]]:
    """Learners that have followed a source, their events, and each one's note then."""
    bank = LearnerBank(described or shipped_robot(), shipped_baseline(shipped_robot().name))
    events, notes = [], []
    for tick in source:
        events += bank.detect_contacts(tick)
        notes += [str(bank.learner(event.leg).status.note) for event in events[len(notes) :]]
        bank.learn_from_tick()
    return bank, events, notes


def test_a_zero_that_is_little_off_is_noted_and_the_leg_works_on() -> None:
    bank, events, _ = play(samples(walk("tripod", "rough", 901), lambda q: q - (0.0, 0.0, 0.2513)))
    for leg in LEGS:
        status = bank.learner(leg).status
        assert "zeros are not where robot.toml says: tibia by +0.2" in status.note
        assert "no contacts are reported until then" not in status.note
    assert len(events) > 50


def test_with_what_it_advises_every_event_is_that_of_the_right_source() -> None:
    right = shipped_robot()
    legs = tuple(msgspec.structs.replace(leg, angles=Angles(directions=DOWN)) for leg in right.legs)
    described = msgspec.structs.replace(right, legs=legs)
    run = walk("tripod", "rough", 901)
    told = []
    for robot_, signs in ((right, (1, 1, 1)), (described, DOWN)):
        bank, events, _ = play(samples(run, functools.partial(np.multiply, signs)), robot_)
        told.append(events)
        assert all(bank.learner(leg).status.note is None for leg in LEGS)
    assert len(told[0]) > 100
    assert told[0] == told[1]


@functools.cache
def quadruped(name: str) -> Mapping[str, LegMotion]:
    """The quadruped on its stand: its legs swing, and meet plates."""
    rows: dict[str, list[ServoSample]] = {}
    for leg, sample in recorded(name)[0]:
        rows.setdefault(leg, []).append(sample)
    return {leg: LegMotion.from_samples(own) for leg, own in rows.items()}


def accused_quadruped(name: str, sign: int, *, phase: bool) -> list[ConventionFinding]:
    turns = dict.fromkeys(quadruped(name), functools.partial(np.multiply, sign))
    motions = turned(quadruped(name), turns, phase=phase)
    return accused(check_motion(shipped_robot("quadruped"), motions))


@pytest.mark.parametrize("name", ["free", "collisions"])
def test_a_quadruped_is_told_when_it_is_flipped_and_never_accused_else(name: str) -> None:
    for phase in (True, False):
        assert accused_quadruped(name, 1, phase=phase) == []
    found = accused_quadruped(name, -1, phase=True)
    assert [one.leg for one in found] == ["fl", "fr", "rl", "rr"]
    assert {one.directions for one in found} == {(-1, -1)}


@functools.cache
def hanging_walk(gait: str) -> dict[str, LegMotion]:
    """A quadruped whose hips roll: two feet stand in a trot, three in a walk."""
    settings = SimulationSettings.from_robot("quadruped12", "walk", gait)
    return motions_of(record_arrays(settings, SECONDS / 2))


def accused_hanging(
    gait: str, legs: tuple[str, ...], signs: tuple[int, ...], *, phase: bool
) -> list[ConventionFinding]:
    turns = dict.fromkeys(legs, functools.partial(np.multiply, signs))
    motions = turned(hanging_walk(gait), turns, phase=phase)
    return accused(check_motion(shipped_robot("quadruped12"), motions))


@pytest.mark.parametrize("phase", [True, False])
@pytest.mark.parametrize("gait", ["trot", "walk"])
def test_a_hip_or_a_knee_of_legs_that_hang_is_found_within_20_swings(
    gait: str, phase: bool
) -> None:
    assert accused_hanging(gait, (), (1, 1, 1), phase=phase) == []
    for legs in (("fl", "fr", "rl", "rr"), ("fl", "rl"), ("rl", "rr"), ("fr",)):
        for signs in ((1, -1, 1), (1, 1, -1)):
            found = accused_hanging(gait, legs, signs, phase=phase)
            assert [one.leg for one in found] == list(legs), (legs, signs)
            assert {one.directions for one in found} == {signs}
            assert all(one.grave for one in found)


@pytest.mark.parametrize("gait", ["trot", "walk"])
def test_a_mirror_image_that_walks_as_well_is_told_with_the_right_signs_or_not_at_all(
    gait: str,
) -> None:
    for signs in ((1, -1, -1), (-1, 1, 1), (-1, -1, -1)):
        for found in accused_hanging(gait, ("fl", "fr", "rl", "rr"), signs, phase=True):
            assert found.directions == signs


@functools.cache
def hung(leg: str, seed: int) -> LegMotion:
    """A leg that swings in free air, and is held for half a second after each swing."""
    motion = PoseSettings(legs=(leg,), workspace="whole", hold_ticks=25)
    run = record_arrays(SimulationSettings(motion=motion, seed=seed, robot_seed=seed), SECONDS)
    assert not run.legs[leg].contact[50:].any()
    return motions_of(run)[leg]


@pytest.mark.parametrize(("leg", "seed"), [("rf", 1), ("lm", 2)])
def test_gravity_shows_pitch_that_is_turned_round_and_no_single_joint(leg: str, seed: int) -> None:
    def judged(*signs: int) -> Findings:
        own = {leg: hung(leg, seed)}
        turns = {leg: functools.partial(np.multiply, signs)}
        return check_hanging(shipped_robot(), turned(own, turns, phase=False))

    assert judged(1, 1, 1) == {leg: None}
    found = judged(1, -1, -1)[leg]
    assert (found.leg, found.directions) == (leg, (1, -1, -1))
    assert "gravity pulls it down" in found.message
    for single in ((1, -1, 1), (1, 1, -1)):
        assert judged(*single) == {}
