"""MuJoCo simulator of an AX-12A hexapod: servo law, gaits, terrain, contact truth, drift.

Besides ``adaptive_contact_studies`` the only package that imports mujoco (extra ``sim``).  For
science, the shortest way is :func:`record_arrays`; for control loops, :class:`Simulation`; for the
wire and files, :func:`run`.
"""

from __future__ import annotations

from adaptive_contact_sim.arrays import record_arrays
from adaptive_contact_sim.drift import KINDS, Injection
from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.pose_group import PoseGroupSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.scenario import (
    Scenario,
    drift_from,
    load_scenario,
    parse_drift,
    shipped_scenarios,
)
from adaptive_contact_sim.session import describe, run
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import TerrainSettings
from adaptive_contact_sim.walk import WalkSettings

__all__ = [
    "KINDS",
    "EncoderSettings",
    "Injection",
    "ObstacleSettings",
    "PoseGroupSettings",
    "PoseSettings",
    "Scenario",
    "Simulation",
    "SimulationSettings",
    "TerrainSettings",
    "WalkSettings",
    "describe",
    "drift_from",
    "load_scenario",
    "parse_drift",
    "record_arrays",
    "run",
    "shipped_scenarios",
    "simulated_robot",
]
