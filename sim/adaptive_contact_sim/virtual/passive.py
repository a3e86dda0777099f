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
from adaptive_contact_sim.virtual.backend import Backend
from adaptive_contact_sim.virtual.horns import LET_GO_S, STEP_S, Horns


class PassiveBackend(Backend):
    """A hexapod on a stand; a backend of virtual servos.

    Args:
        horns: how the servos are mounted.
        height_m: of the body over the floor.
    """

    # Of the body over the floor, with the legs out of reach of it.
    def __init__(self, horns: Horns, *, height_m: float = 1.0) -> None:
        self.plant = Plant(_on_a_stand(height_m), manufactured(0), period_s=STEP_S)
        self._horns = horns
        self._goal = np.zeros(N_SERVOS)  # stretched out level
        self._on = np.zeros(N_SERVOS, dtype=np.bool_)
        self._start_s: float | None = None
        self.plant.joint_angles[:] = 0.0
        mujoco.mj_forward(self.plant.model, self.plant.data)
        self._written: Array | None = None

    def advance(self, now_s: float) -> float:
        """Bring the robot up to a moment."""
        if self._start_s is None:
            self._start_s = now_s
        behind = int((now_s - self._start_s) / STEP_S) - self.plant.steps
        if behind * STEP_S > LET_GO_S:
            self._start_s += behind * STEP_S
            behind = 0
        for _ in range(min(behind, 5)):  # Steps made at one call: more would keep the bus waiting.
            self._step()
        return float(self._start_s + (self.plant.steps + 1) * STEP_S)

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""
        return self._horns.horn(index, float(self.plant.joint_angles[index]))

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""
        return float(self._horns.direction[index] * self.plant.joint_speeds[index])

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Write a servo's goal."""
        self._goal[index] = self._horns.joint(index, angle_rad)

    def set_torque(self, index: int, on: bool) -> None:
        """Switch a servo's drive on or off."""
        self._on[index] = on

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set a servo's compliance slope."""
        self.plant.servos.parameters.slope_steps[index] = slope_rad / QUANTUM_RAD
        self.plant.servos.refresh()

    def _step(self) -> None:
        """Make one physics step; a servo without torque has its goal where it is."""
        plant = self.plant
        target = np.where(self._on, self._goal, plant.joint_angles)
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
