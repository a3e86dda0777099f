"""The second physics: its servos against closed forms, its twins, its truth."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adaptive_contact import ContactLearner

pytest.importorskip(
    "pybullet", reason="pybullet is not installed: it has wheels for Python 3.11 on x86-64 only"
)

from adaptive_contact.score import contacts_of
from adaptive_contact_bullet.drawn import drawn, gait_of
from adaptive_contact_bullet.gait import GAITS, Inverse, Walker
from adaptive_contact_bullet.plant import Ground, Plant
from adaptive_contact_bullet.record import Plan, record
from adaptive_contact_bullet.robots import SHAPES
from adaptive_contact_bullet.servo import Drives
from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.second import Trial, table, tried
from adaptive_contact_studies.work import Work


def _one(**changes: float) -> Drives:
    ideal = dataclasses.replace(
        SHAPES["hexapod"].servo, coulomb_nm=0.0, stribeck_nm=0.0, load_friction=0.0, noise_rad=0.0,
        latency_ticks=0, **changes,
    )  # fmt: skip
    return Drives(ideal, np.zeros(1), np.random.default_rng(1), 0.001)


def test_a_held_output_gets_the_torque_of_its_error() -> None:
    drives = _one()
    drives.command(np.array([0.05]))
    torque = 0.0
    for _ in range(2000):
        torque = float(drives.torques(np.zeros(1), np.zeros(1))[0])
    assert torque == pytest.approx(drives.constants[0, 0] * drives.servo.gain * 0.05, rel=1e-3)


def test_nothing_passes_through_the_play() -> None:
    drives = _one(play_rad=0.02)
    half = float(drives.constants[9, 0]) / 2.0
    assert drives.torques(np.array([0.9 * half]), np.zeros(1))[0] == 0.0
    assert drives.torques(np.array([1.5 * half]), np.zeros(1))[0] < 0.0


def test_friction_holds_a_motor_that_is_pushed_less_than_it() -> None:
    rubbing = dataclasses.replace(SHAPES["hexapod"].servo, coulomb_nm=0.5, latency_ticks=0)
    drives = Drives(rubbing, np.zeros(1), np.random.default_rng(1), 0.001)
    drives.command(np.array([0.02]))
    for _ in range(300):
        drives.torques(np.zeros(1), np.zeros(1))
    assert drives.motor[0, 0] == 0.0


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_the_engine_and_the_inverse_agree_with_the_description_on_feet(name: str) -> None:
    """The URDF and robot.toml are two descriptions of one robot."""
    shape = SHAPES[name]
    plant = Plant(shape, Ground("none"), np.random.default_rng(1))
    for leg, foot in zip(shape.legs, plant.feet_m, strict=True):
        chain, rest = shape.description.leg(leg.id).chain, np.array(leg.rest_rad)
        on_body = Rotation.from_euler("z", leg.yaw_rad).apply(chain.foot(rest)) + leg.mount_m
        assert foot == pytest.approx(on_body + np.array([0.0, 0.0, 1.0]), abs=1e-4)
        target = chain.foot(rest) + np.array([0.01, -0.01, 0.015])
        inverse = Inverse(chain, rest)
        for _ in range(5):
            angles = inverse.to(target)
        assert chain.foot(angles) == pytest.approx(target, abs=2e-3)
    plant.close()


@pytest.mark.parametrize(("robot", "gait"), [("hexapod", "tripod"), ("quadruped", "trot")])
def test_a_walk_touches_once_a_swing_and_its_twins_see_it(robot: str, gait: str) -> None:
    made = record(Plan(robot, GAITS[gait], Ground("hard"), 5.0, 3, twins=True))
    run = made.run
    assert run.rotation[:, 2, 2].min() > math.cos(0.3)  # it does not fall
    for leg in run.legs.values():
        swings = np.flatnonzero(np.diff(leg.swing.astype(int)) == 1)
        contacts = contacts_of(leg.truth, int(run.t_ns[0]))
        touched = sum(
            bool(((run.t_ns[a] < contacts.onset_ns) & (contacts.onset_ns <= run.t_ns[b])).any())
            for a, b in itertools.pairwise(swings)
        )
        assert touched == len(swings) - 1
    assert len(made.observed) > 3
    assert np.mean([o.ratio > 1.0 for o in made.observed]) > 0.8


def test_a_twin_that_touches_as_well_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a twin shows is the ground, and not the way that it is simulated."""
    monkeypatch.setattr(Plant, "let_through", lambda *_, **__: None)
    made = record(Plan("hexapod", GAITS["tripod"], Ground("hard"), 4.0, 3, twins=True))
    assert len(made.observed) > 3
    assert max(o.ratio for o in made.observed) < 1.0


def test_the_same_seed_walks_the_same_way() -> None:
    plan = Plan("geared", GAITS["tripod-fast"], Ground("rough"), 2.0, 5)
    first, second = record(plan).run, record(plan).run
    for leg in first.legs:
        np.testing.assert_array_equal(first.legs[leg].measured, second.legs[leg].measured)


def test_rough_ground_has_no_end() -> None:
    run = record(Plan("hexapod", GAITS["tripod-fast"], Ground("rough"), 45.0, 11)).run
    tilt = np.arccos(np.clip(run.rotation[:, 2, 2], -1.0, 1.0))
    thirds = [math.degrees(np.sqrt(np.mean(part**2))) for part in np.array_split(tilt, 3)]
    assert np.linalg.norm(run.position_m[-1, :2] - run.position_m[0, :2]) > 4.0
    assert min(thirds) > 1.0  # on hard ground 0.4


def test_no_record_is_made_of_a_robot_that_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    lower = SHAPES["quadruped"]
    monkeypatch.setitem(SHAPES, "quadruped", dataclasses.replace(lower, bump_m=0.1))
    with pytest.raises(RuntimeError, match="fell after"):
        record(Plan("quadruped", GAITS["trot"], Ground("rough"), 30.0, 12))


def test_a_trial_of_the_study_has_a_row(tmp_path: Path) -> None:
    """From nothing, in seconds: too short to be judged by, but whole."""
    trials = [
        Trial("hexapod", "tripod", "hard", 8.0, 1),
        Trial("geared", "tripod", "none", 8.0, 1, fitted_s=3.0),
    ]
    work = Work(tmp_path)
    made = work.each("trials", tried, trials)
    walked = made[0]
    assert sum(walked.touches) >= walked.seen >= walked.seen_found > 0
    assert walked.twins >= walked.seen > 20
    assert made[1] is None  # three seconds are too little for a baseline
    page = table(list(zip(trials, made, strict=True)))
    assert "| hexapod, tripod, hard | nothing |" in page
    assert "| geared, tripod | fit of 0.05 min | no baseline could be fitted" in page


def test_a_planned_descent_is_not_stopped_by_a_touch() -> None:
    shape = SHAPES["hexapod"]
    walker = Walker(shape, GAITS["tripod-planned"], np.random.default_rng(0))
    free = Walker(shape, GAITS["tripod-planned"], np.random.default_rng(0))
    touching, air = np.ones(6, dtype=bool), np.zeros(6, dtype=bool)
    for _ in range(120):
        np.testing.assert_array_equal(walker.tick(touching), free.tick(air))


@pytest.mark.slow
def test_touches_that_a_new_leg_misses_are_not_learned() -> None:
    """Stiff drives on soft ground: the load of the stance shows that the foot touched."""
    made = record(Plan("worm", GAITS["tripod-slow"], Ground("soft"), 80.0, 31))
    run, robot = made.run, made.shape.description
    touching = learned = 0
    for leg in robot.leg_ids:
        learner = ContactLearner(robot, leg)
        for sample in samples_of(run, leg):
            learner.update(sample)
            ticks = np.searchsorted(run.t_ns, learner.drain_confirmed())
            learned += len(ticks)
            touching += int(run.legs[leg].contact[ticks].sum())
    assert learned > 3000
    assert touching < 0.012 * learned  # 0.015 where such descents are learned


def test_drawn_robots_are_whole_and_the_same_each_time() -> None:
    for number in range(60):
        name = f"drawn-{number}"
        shape, gait, _ = drawn(name)
        assert shape.description.leg(shape.legs[0].id).chain is not None
        assert gait_of(name) is gait
        assert gait.cycle_s * (1.0 - gait.duty) / shape.period_s >= 4  # ticks of a swing
        drawn.cache_clear()
        assert drawn(name).shape == shape
