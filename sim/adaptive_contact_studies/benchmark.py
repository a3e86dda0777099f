"""How fast the simulator is."""

from __future__ import annotations

import time
from dataclasses import dataclass

from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import TerrainSettings
from adaptive_contact_sim.walk import WalkSettings

__all__ = ["Speed", "real_time_factor"]


@dataclass(frozen=True)
class Speed:
    """Simulated seconds per second of one core.

    Attributes:
        factor: of the whole simulator: physics, servo law, gait, readings, messages.
        engine: of the engine's step alone in the same run's last state, with nothing of ours.
    """

    factor: float
    engine: float


def real_time_factor(
    settings: SimulationSettings | None = None,
    *,
    seconds: float = 10.0,
    engine_seconds: float = 2.0,
) -> Speed:
    """Measure the simulator on this machine, this process's CPU time being what counts.

    Args:
        settings: what to run; the tripod gait on the rough field by default.
        seconds: simulated time measured.
        engine_seconds: simulated time the bare engine is measured for.

    Returns:
        The speeds.
    """
    import mujoco

    sim = Simulation(
        settings
        or SimulationSettings(motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=1)
    )
    for _ in sim.run(2.0):  # into the walk
        pass
    start = time.process_time()
    for _ in sim.run(seconds):
        pass
    whole = time.process_time() - start
    plant = sim.plant
    start = time.process_time()
    for _ in range(round(engine_seconds / plant.step_s)):
        mujoco.mj_step(plant.model, plant.data)
    bare = time.process_time() - start
    return Speed(factor=seconds / whole, engine=engine_seconds / bare)
