"""A minute of one leg, simulated once."""

from __future__ import annotations

import pytest

from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_sim import PoseSettings, SimulationSettings
from adaptive_contact_studies.paper.data import Stream, streams_of
from adaptive_contact_studies.training import PlannedRun
from adaptive_contact_studies.work import Work


@pytest.fixture(scope="session")
def robot() -> Robot:
    return shipped_robot()


@pytest.fixture(scope="session")
def free_stream() -> Stream:
    settings = SimulationSettings(motion=PoseSettings(), seed=901)
    (stream,) = streams_of(Work(None), [PlannedRun("paper", settings, 120.0)])
    return stream
