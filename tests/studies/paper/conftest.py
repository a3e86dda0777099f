"""A minute of one leg, simulated once."""

from __future__ import annotations

import pytest

from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_sim import ObstacleSettings, PoseSettings, SimulationSettings
from adaptive_contact_studies.paper.data import Stream, load
from adaptive_contact_studies.paper.plan import LegRun, Piece
from adaptive_contact_studies.work import Work


def simulated(seconds: float, seed: int, probability: float = 0.0) -> Stream:
    settings = SimulationSettings(
        motion=PoseSettings(obstacles=ObstacleSettings(probability=probability)), seed=seed
    )
    return load(Work(None), Piece(LegRun(0, "rf"), "train", "paper", seconds, settings))


@pytest.fixture(scope="session")
def robot() -> Robot:
    return shipped_robot()


@pytest.fixture(scope="session")
def free_stream() -> Stream:
    return simulated(120.0, seed=901)


@pytest.fixture(scope="session")
def touched_stream() -> Stream:
    return simulated(40.0, seed=902, probability=0.6)
