"""Robots other than the hexapod: their legs, servos and motions."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.score import summarise
from adaptive_contact_sim import (
    PoseSettings,
    Simulation,
    SimulationSettings,
    WalkSettings,
    record_arrays,
)
from adaptive_contact_sim.legs import ChainLegs
from adaptive_contact_sim.robots import ROBOTS, simulated_robot
from adaptive_contact_sim.scenario import parse_drift, parse_scenario
from adaptive_contact_studies.evaluate import play, score_run
from tests.sim.touches import recorded


@pytest.mark.parametrize(("share", "least", "most"), [(0.0, 0, 0), (0.6, 8, 20)])
def test_the_leg_on_a_stand_meets_plates_only(share: float, least: int, most: int) -> None:
    base = SimulationSettings.from_robot("leg5", "pose")
    obstacles = dataclasses.replace(base.motion.obstacles, probability=share)
    motion = dataclasses.replace(base.motion, obstacles=obstacles)
    run = record_arrays(dataclasses.replace(base, motion=motion, seed=3), 20.0)
    onsets = run.legs["leg"].onsets
    assert least <= len(onsets) <= most
    assert {onset.part for onset in onsets} <= {"foot"}
    assert (run.position_m == run.position_m[0]).all()  # it hangs


@pytest.mark.parametrize("name", ["hexapod", "quadruped12", "leg5"])
def test_foot_and_model_agree(name: str) -> None:
    """The chain of ``robot.toml`` against the engine's own kinematics."""
    robot = simulated_robot(name)
    mode = "walk" if robot.walk is not None else "pose"
    sim = Simulation(SimulationSettings.from_robot(name, mode))  # type: ignore[arg-type]
    rng = np.random.default_rng(4)
    geometry = robot.geometry()
    near = 1e-9 if isinstance(geometry, ChainLegs) else 1e-5
    shape = (len(robot.description.legs), len(robot.description.legs[0].joints))
    for _ in range(20):
        q = rng.uniform(geometry.lower_rad, geometry.upper_rad, shape)
        sim.plant.place(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), q.ravel())
        base = sim.plant.body_pose()[0]
        feet = geometry.to_body(geometry.feet(q))
        assert np.abs(feet + base - sim.plant.foot_positions()).max() < near
        for i, leg in enumerate(robot.description.legs):
            assert np.abs(leg.chain.foot(q[i]) - geometry.feet(q)[i]).max() < 1e-12
    servo = robot.servo
    assert robot.description.quantum_rad == pytest.approx(servo.quantum_rad, rel=1e-3)
    slope = float(servo.nominal.slope_steps[0]) * servo.quantum_rad
    assert robot.description.servo.slope_rad == pytest.approx(slope, rel=5e-3)
    for leg in robot.description.legs:  # limits stand in both files
        for k, joint in enumerate(leg.joints):
            span = sim.plant.model.joint(f"{leg.id}_{joint}").range
            limits = leg.limits.lower_rad[k], leg.limits.upper_rad[k]
            assert span == pytest.approx(limits, abs=1e-3)


LEG5 = simulated_robot("leg5").layout


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: simulated_robot("quadruped1"), "did you mean 'quadruped12'"),
        (
            lambda: SimulationSettings.from_robot("quadruped12", "pose"),
            "has no pose; expected `sim walk`",
        ),
        (
            lambda: Simulation(SimulationSettings(motion=WalkSettings(), robot="quadruped12")),
            "of 6 legs, the robot has 4; expected trot, walk",
        ),
        (
            lambda: Simulation(SimulationSettings(motion=WalkSettings(body_height_m=0.25))),
            "feet do not reach",
        ),
        (lambda: SimulationSettings(motion=PoseSettings(legs=("rx",))), "expected some of"),
        (
            lambda: SimulationSettings(motion=PoseSettings(legs=("rf",)), robot="leg5"),
            "expected some of",
        ),
        (
            lambda: SimulationSettings(motion=PoseSettings(workspace="hung")),
            "does not move in workspace 'hung'",
        ),
        (
            lambda: PoseSettings(workspace="hung", approach="forward"),
            "expected descent or slow",
        ),
        (
            lambda: parse_drift("friction:joint=femur,value=2", LEG5),
            "no joint 'femur'; the joints are yaw",
        ),
        (
            lambda: parse_scenario('mode = "walk"\nrobot = "cat"', name="x", source="x"),
            "x: no robot 'cat' is simulated",
        ),
    ],
)
def test_what_does_not_fit_a_robot_is_told(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make()


def test_a_scenario_names_its_robot() -> None:
    scenario = parse_scenario(
        'mode = "walk"\nrobot = "quadruped12"\n[walk]\ngait = "walk"', name="x"
    )
    assert scenario.settings.motion == ROBOTS["quadruped12"].walks[0]
    assert scenario.settings.period_s == 0.01
    assert parse_drift("friction:joint=ankle,value=2", LEG5).drift.joint == "ankle"


def test_a_recording_names_its_robot(ours: Any, tmp_path: Path) -> None:
    """Without --config, and with the baseline that ships."""
    base = SimulationSettings.from_robot("leg5", "pose")
    plates = dataclasses.replace(base.motion.obstacles, probability=0.6)
    motion = dataclasses.replace(base.motion, obstacles=plates)
    path, events = tmp_path / "leg.mcap", tmp_path / "leg.jsonl"
    recorded(dataclasses.replace(base, motion=motion, seed=31), 60.0, path)
    out = []
    for arguments in (
        ("replay", str(path), "--events", str(events)),
        ("score", str(path), "--events", str(events), "--json"),
        ("score", str(path), "--frozen", "--json"),
    ):
        done = ours(*arguments)
        assert done.code == 0
        assert "taken for the shipped robot 'leg5' (leg; 20 ms)" in done.err
        out.append(done.out)
    replayed, both = json.loads(out[1]), json.loads(out[2])
    for found in (replayed, both["product"], both["frozen"]):
        assert found["counted"]["touches"] == replayed["counted"]["touches"] > 20
        assert found["counted"]["found"] >= found["counted"]["touches"] - 1
        assert found["false_alarms"] <= 1
    done = ours("score", path, "--frozen", "--events", events)
    assert done.code == 2
    assert "leave out --events" in done.err


@pytest.mark.parametrize(("gait", "seconds"), [("trot", 12.0), ("walk", 20.0)])
def test_the_quadrupeds_baseline_finds_its_touches(gait: str, seconds: float) -> None:
    base = SimulationSettings.from_robot("quadruped12", "walk", gait)  # type: ignore[arg-type]
    rough = dataclasses.replace(base.terrain, kind="rough")
    run = record_arrays(dataclasses.replace(base, terrain=rough, seed=11), seconds)
    robot = shipped_robot("quadruped12")
    played = play(run, robot, shipped_baseline("quadruped12"))
    found = summarise(score_run(run, robot, played.events))
    assert found.counted.touches > 20
    assert found.counted.found >= found.counted.touches - 1
    assert found.false_alarms <= 1
