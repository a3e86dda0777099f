"""Several legs in pose together: each as if alone, on a robot that keeps standing."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.pose_group import TRIPODS, PoseGroupSettings
from adaptive_contact_sim.simulation import Simulation, SimulationSettings


def _settings(legs: tuple[str, ...], probability: float, seed: int = 11) -> SimulationSettings:
    obstacles = ObstacleSettings(probability=probability, where=(0.15, 0.4))
    poses = tuple(PoseSettings(legs=(leg,), obstacles=obstacles) for leg in legs)
    return SimulationSettings(motion=PoseGroupSettings(poses), seed=seed)


@pytest.mark.parametrize("legs", TRIPODS)
def test_the_robot_stands_while_three_legs_meet_obstacles(legs: tuple[str, ...]) -> None:
    sim = Simulation(_settings(legs, 1.0))
    touched = dict.fromkeys(LEGS, 0)
    swinging = dict.fromkeys(LEGS, 0)
    for _ in range(600):
        sim.advance()
        position, rotation = sim.plant.body_pose()
        assert position[2] > 0.14
        assert np.degrees(np.arccos(rotation[2, 2])) < 15.0
        for change in sim.changes:
            own = change.touch is not None and change.contact
            if own and sim.plant.model.geom(change.touch.other).name.startswith("obstacle_"):
                touched[LEGS[change.leg]] += 1
        for leg, phase in zip(LEGS, sim.phase, strict=True):
            swinging[leg] += phase == "swing"
    for leg in LEGS:
        assert (touched[leg] >= 10) == (leg in legs), touched
        assert (swinging[leg] > 400) == (leg in legs), swinging


def test_surfaces_are_those_of_the_leg_that_touches() -> None:
    legs = TRIPODS[1]
    soft = ObstacleSettings(probability=1.0, soft=1.0)
    poses = [PoseSettings(legs=(leg,), obstacles=ObstacleSettings(probability=1.0)) for leg in legs]
    poses[1] = PoseSettings(legs=(legs[1],), obstacles=soft)
    sim = Simulation(SimulationSettings(motion=PoseGroupSettings(tuple(poses)), seed=3))
    seen: dict[str, set[str]] = {leg: set() for leg in legs}
    for _ in range(400):
        for leg, truth in sim.tick().truth:
            geom_leg = leg in legs
            if geom_leg and truth.contact and truth.surface is not None and sim.ticks > 60:
                seen[leg].add(truth.surface)
    assert seen == {legs[0]: {"hard"}, legs[1]: {"soft"}, legs[2]: {"hard"}}


@pytest.mark.parametrize(
    ("poses", "found"),
    [
        ([("lf",), ("lm",)], "'lf', 'lm'"),
        ([("lf",), ("lf",)], "none of them twice"),
        ([("lf", "rm")], "one leg each"),
        ([], "expected some of"),
    ],
)
def test_a_group_the_robot_cannot_stand_without_is_refused(
    poses: list[tuple[str, ...]], found: str
) -> None:
    with pytest.raises(ConfigurationError, match=found):
        PoseGroupSettings(tuple(PoseSettings(legs=legs) for legs in poses))
