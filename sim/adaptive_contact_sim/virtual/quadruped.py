r"""The second robot: two-joint legs of XL330 servos on a stand, in MuJoCo.

The servo is an X-series one in position mode with its delivered gains (P 400, I and D 0): it reads
its own encoder :math:`n` (4096 a turn) and drives with

.. math:: u = \operatorname{sat}\bigl(3.125\,(n_{goal} - n) / 885\bigr), \qquad
          \tau = \tau_s u - \tau_s\,\omega/\omega_0

Nothing here is shared with the hexapod's AX-12A but the physics engine and the contact truth.

References:
    ROBOTIS e-manual XL330-M288: gains, PWM limit, stall torque 0.52 N*m and no-load speed 104 rpm
    at 5 V.  Friction and armature: Rhoban/bam, XL-330 model M1 (docs/simulator.md).
"""

from __future__ import annotations

import math
from typing import Final

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import SimulationDivergedError
from adaptive_contact_sim.elements import Layout
from adaptive_contact_sim.scene import robot_xml
from adaptive_contact_sim.virtual.horns import STEP_S, Horns, OnStand

LEGS: Final = ("fl", "fr", "rl", "rr")
JOINTS: Final = ("hip", "knee")
PARTS: Final = ("hip", "knee", "foot")
LAYOUT: Final = Layout(LEGS, JOINTS, PARTS)
N_SERVOS: Final = LAYOUT.n_servos

STEP_RAD: Final = 2 * math.pi / 4096
_GAIN: Final = 400.0 / 128.0  # of PWM per step
_PWM: Final = 885.0
_STALL_NM: Final = 0.52
_NO_LOAD_RAD_S: Final = 104.0 * 2 * math.pi / 60
_COULOMB_NM, _VISCOUS_NMS = 0.0128, 0.0037
_SPREAD: Final = 0.12  # between servos of one kind, as for the hexapod
_ABSURD_RAD_S: Final = 100.0


class QuadrupedPlant:
    """Engine and servos of the quadruped.

    Args:
        start_rad: (8,) joint angles at first.
        model: with more than the robot in it; the robot alone where absent.

    Attributes:
        goal: (8,) rad, written by :meth:`write_goal`.
        steps: physics steps made.
        gain: (8,) of PWM per step of error.
        drive_nm: (8,) of full PWM.
    """

    def __init__(self, start_rad: Array, model: mujoco.MjModel | None = None) -> None:
        self.model = model or mujoco.MjModel.from_xml_string(robot_xml("quadruped"))
        self.data = mujoco.MjData(self.model)
        names = [f"{leg}_{joint}" for leg, joint in LAYOUT.servos]
        ids = [self.model.joint(name).id for name in names]
        self._qpos = np.array([self.model.jnt_qposadr[i] for i in ids])
        self.dof = np.array([self.model.jnt_dofadr[i] for i in ids])
        self._ctrl = np.array([self.model.actuator(name).id for name in names])
        spread = np.random.default_rng([0, 0x330]).uniform(1 - _SPREAD, 1 + _SPREAD, (4, N_SERVOS))
        self.drive_nm, no_load = _STALL_NM * spread[0], _NO_LOAD_RAD_S * spread[1]
        self.gain = np.full(N_SERVOS, _GAIN)
        self.model.dof_damping[self.dof] = self.drive_nm / no_load + _VISCOUS_NMS * spread[3]
        self.model.dof_frictionloss[self.dof] = _COULOMB_NM * spread[2]
        self.data.qpos[self._qpos] = start_rad
        mujoco.mj_forward(self.model, self.data)
        self.goal = self._register(start_rad)
        self.steps = 0

    @property
    def joint_angles(self) -> Array:
        """(8,) rad."""
        return np.asarray(self.data.qpos[self._qpos])

    @property
    def joint_speeds(self) -> Array:
        """(8,) rad/s."""
        return np.asarray(self.data.qvel[self.dof])

    def write_goal(self, goal_rad: Array) -> Array:
        """Write the goal registers; returns what they hold, (8,) rad."""
        self.goal = self._register(goal_rad)
        return self.goal

    def step(self) -> None:
        """Make one physics step of 1 ms.

        Raises:
            SimulationDivergedError: the state is no longer finite, or absurdly fast.
        """
        error = np.rint(self.goal / STEP_RAD) - np.rint(self.joint_angles / STEP_RAD)
        duty = np.clip(self.gain * error / _PWM, -1.0, 1.0)
        self.data.ctrl[self._ctrl] = self.drive_nm * duty
        mujoco.mj_step(self.model, self.data)
        self.steps += 1
        fastest = float(np.abs(self.joint_speeds).max())
        if not fastest < _ABSURD_RAD_S:
            raise SimulationDivergedError(
                f"at {self.steps * STEP_S:.3f} s a joint turns at {fastest:.3g} rad/s; expected "
                f"below {_ABSURD_RAD_S:.0f}; report the scenario and seed"
            )

    @staticmethod
    def _register(goal_rad: Array) -> Array:
        return np.asarray(np.rint(goal_rad / STEP_RAD) * STEP_RAD)


class QuadrupedBackend(OnStand):
    """The quadruped on its stand, moved by the bus; a backend of virtual servos."""

    def __init__(self, horns: Horns) -> None:
        start = np.tile(np.array([-0.4, -1.2]), len(LEGS))
        self.plant = QuadrupedPlant(start)
        super().__init__(horns, self.plant, start)

    def step(self) -> None:
        """Make one step."""
        self.plant.write_goal(self.target())
        self.plant.step()

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set a servo's gain."""
        self.plant.gain[index] = _PWM * STEP_RAD / slope_rad
