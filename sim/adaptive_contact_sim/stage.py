"""A moment of a simulation, kept cheaply and shown later.

Painting takes longer than simulating, so a run in real time only keeps moments; they are set
up again on a stage of their own, and painted, when the run is over.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact_sim.elements import Elements
from adaptive_contact_sim.simulation import Simulation

__all__ = ["Moment", "Stage"]

Array = NDArray[np.float64]


class Moment(NamedTuple):
    """What a picture shows.

    Attributes:
        configuration: of the engine's joints, ``qpos``.
        mocap_m, mocap_quaternion: places of the movable obstacles.
        touching: (L,) whether each leg touches.
        caption: lines for the corner.
    """

    configuration: Array
    mocap_m: Array
    mocap_quaternion: Array
    touching: NDArray[np.bool_]
    caption: tuple[str, ...]

    @classmethod
    def of(cls, sim: Simulation) -> Moment:
        """Keep the present."""
        data = sim.plant.data
        lines = [f"{sim.time_s:.1f} s"]
        for kind, legs in sim.drift.holds().items():
            values = {round(v, 3) for joints in legs.values() for v in joints.values()}
            value = f"{values.pop():g}" if len(values) == 1 else "various"
            lines.append(f"{kind} {value}: {' '.join(legs)}")
        return cls(
            configuration=data.qpos.copy(),
            mocap_m=data.mocap_pos.copy(),
            mocap_quaternion=data.mocap_quat.copy(),
            touching=sim.plant.forces[-1] > 0.0,
            caption=tuple(lines),
        )


class Stage:
    """The scene of a simulation, on which moments are set up.

    Args:
        sim: whose scene.
    """

    def __init__(self, sim: Simulation) -> None:
        self.model = sim.scene(looks=True)  # the simulation's own may be without
        self.elements = Elements.resolve(self.model, sim.layout)
        self.terrain = sim.terrain
        self.data = mujoco.MjData(self.model)
        self.touching: NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)
        self.set(Moment.of(sim))

    def set(self, moment: Moment) -> None:
        """Set up a moment."""
        self.data.qpos[:] = moment.configuration
        self.data.mocap_pos[:] = moment.mocap_m
        self.data.mocap_quat[:] = moment.mocap_quaternion
        self.touching = moment.touching
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    @property
    def position_m(self) -> Array:
        """(3,) of the body."""
        return np.asarray(self.data.xpos[self.elements.body])

    @property
    def rotation(self) -> Array:
        """(3, 3) of the body."""
        return np.asarray(self.data.xmat[self.elements.body].reshape(3, 3))

    @property
    def feet_m(self) -> Array:
        """(L, 3) of the feet."""
        return np.asarray(self.data.site_xpos[self.elements.foot_sites])
