"""A minute of one leg, simulated once."""

from __future__ import annotations

import pytest

from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_sim import ObstacleSettings, PoseSettings, SimulationSettings
from adaptive_contact_studies.paper.data import Stream, load
from adaptive_contact_studies.paper.plan import LegRun, Piece
from adaptive_contact_studies.work import Work


@pytest.fixture(scope="session")
def robot() -> Robot:
    return shipped_robot()


@pytest.fixture(scope="session")
def free_stream() -> Stream:
    motion = PoseSettings(obstacles=ObstacleSettings(probability=0.0))
    settings = SimulationSettings(motion=motion, seed=901)
    return load(Work(None), Piece(LegRun(0, "rf"), "train", "paper", 120.0, settings))
