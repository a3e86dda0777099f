"""Servos of a robot on a stand: MuJoCo links and servo laws, goals only from the bus.

The body is fixed; all legs hang free, or reach the floor where the stand is low enough.  Physics
runs in steps of 1 ms as time goes by, so a goal written at any moment acts from that moment on.
"""

from __future__ import annotations

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact_sim.elements import N_SERVOS
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.scene import on_a_stand
from adaptive_contact_sim.servo import QUANTUM_RAD, manufactured
from adaptive_contact_sim.terrain import HARD_SOLREF
from adaptive_contact_sim.virtual.horns import STEP_S, Horns, OnStand


class PassiveBackend(OnStand):
    """A hexapod on a stand; a backend of virtual servos.

    Args:
        horns: how the servos are mounted.
        height_m: of the body over the floor.
    """

    # Of the body over the floor, with the legs out of reach of it.
    def __init__(self, horns: Horns, *, height_m: float = 1.0) -> None:
        self.plant = Plant(_on_a_stand(height_m), manufactured(0), period_s=STEP_S)
        super().__init__(horns, self.plant, np.zeros(N_SERVOS))  # stretched out level
        self.plant.joint_angles[:] = 0.0
        mujoco.mj_forward(self.plant.model, self.plant.data)
        self._written: Array | None = None

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set a servo's compliance slope."""
        self.plant.servos.parameters.slope_steps[index] = slope_rad / QUANTUM_RAD
        self.plant.servos.refresh()

    def step(self) -> None:
        """Make one step."""
        plant, target = self.plant, self.target()
        if self._written is None or not np.array_equal(target, self._written):
            plant.servos.write_goal(target)
            self._written = target
        plant.advance()


def _on_a_stand(height_m: float) -> mujoco.MjModel:
    """The robot with its body fixed over a hard floor."""
    spec = on_a_stand(height_m)
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2.0, 2.0, 0.1],
        contype=0,
        conaffinity=1,
        friction=[0.9, 0.005, 0.0001],
        solref=list(HARD_SOLREF),
    )
    return spec.compile()
