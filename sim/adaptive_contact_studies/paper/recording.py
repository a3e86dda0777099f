"""One leg of the standing robot, recorded for the experiments.

The same simulation as :func:`~adaptive_contact_sim.arrays.record_arrays`, of which one leg is kept,
with one difference: where a leg has come to a pocket of its workspace out of which no straight way
to a new point leads, the way is bent to the nearest reachable one instead of being drawn again
without end.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact_sim.arrays import LegArrays, record_run
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.pose import PoseMotion, PoseSettings
from adaptive_contact_sim.simulation import Simulation, SimulationSettings

__all__ = ["PatientGeometry", "record_leg", "simulation_of"]

Array = NDArray[np.float64]

# Ways drawn in vain before one is bent: the acceptance elsewhere is above a tenth.
_TRIES: Final = 500
# Stream of randomness of the motion, apart from the simulation's own.
_MOTION_STREAM: Final = 0x90F3


@dataclass(frozen=True, eq=False)
class PatientGeometry(LegGeometry):
    """Geometry that says yes after many noes: :meth:`joints` pulls points within reach anyway."""

    # How many noes in a row; in a list, for all else about a leg's geometry is frozen.
    _refused: list[int] = field(default_factory=lambda: [0])

    @classmethod
    def patient(cls) -> PatientGeometry:
        """Of the shipped robot."""
        plain = LegGeometry.of()
        return cls(**{f.name: getattr(plain, f.name) for f in fields(plain)})

    def reachable(self, points_m: Array) -> NDArray[np.bool_]:
        """Tell which points are in reach; after :data:`_TRIES` refusals in a row, all are."""
        inside = super().reachable(points_m)
        refused = self._refused
        refused[0] = 0 if inside.all() else refused[0] + 1
        if refused[0] > _TRIES:
            refused[0] = 0
            return np.ones_like(inside)
        return inside


def simulation_of(settings: SimulationSettings) -> Simulation:
    """A simulation whose leg never waits for a way out of a pocket.

    Args:
        settings: with a pose motion.
    """
    motion = settings.motion
    assert isinstance(motion, PoseSettings)
    # Its own motion is made, and thrown away: over the paper's subspaces that always succeeds.
    harmless = replace(motion, workspace="paper", approach="descent")
    sim = Simulation(replace(settings, motion=harmless))
    rng = np.random.default_rng([settings.seed, _MOTION_STREAM])
    sim.motion = PoseMotion(motion, PatientGeometry.patient(), sim.courses[0], rng)
    return sim


def record_leg(settings: SimulationSettings, leg: str, seconds: float) -> LegArrays:
    """Simulate, and keep one leg.

    Args:
        settings: with a pose motion.
        leg: which.
        seconds: simulated time.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    return record_run(simulation_of(settings), seconds, legs=(leg,)).legs[leg]
