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
from collections import deque
from typing import Final

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import SimulationDivergedError
from adaptive_contact_sim.elements import Layout
from adaptive_contact_sim.plant import Touch
from adaptive_contact_sim.scene import PARKED_M, robot_xml, set_surface
from adaptive_contact_sim.terrain import HARD_SOLREF
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
_PLATE_M: Final = (0.05, 0.03, 0.02)


class QuadrupedPlant:
    """Engine and servos of the quadruped, with a plate under each leg that can be moved.

    Args:
        robot_seed: which robot of its kind.
        start_rad: (8,) joint angles at first.

    Attributes:
        goal: (8,) rad, written by :meth:`write_goal`.
        steps: physics steps made.
        friction_factor, supply_v: condition of the servos; :meth:`refresh` takes a change up.
        gain: (8,) of PWM per step of error.
    """

    def __init__(self, robot_seed: int = 0, start_rad: Array | None = None) -> None:
        self.model = _scene()
        self.data = mujoco.MjData(self.model)
        names = [f"{leg}_{joint}" for leg, joint in LAYOUT.servos]
        ids = [self.model.joint(name).id for name in names]
        self._qpos = np.array([self.model.jnt_qposadr[i] for i in ids])
        self._dof = np.array([self.model.jnt_dofadr[i] for i in ids])
        self._ctrl = np.array([self.model.actuator(name).id for name in names])
        self._touch = np.array(
            [
                [int(self.model.sensor(f"{leg}_{part}_touch").adr[0]) for part in PARTS]
                for leg in LEGS
            ]
        )
        self._feet = np.array([self.model.site(f"{leg}_foot").id for leg in LEGS])
        self._plates = np.array([int(self.model.body(f"plate_{leg}").mocapid[0]) for leg in LEGS])
        rng = np.random.default_rng([robot_seed, 0x330])
        spread = rng.uniform(1 - _SPREAD, 1 + _SPREAD, (4, N_SERVOS))
        self._stall, self._no_load = _STALL_NM * spread[0], _NO_LOAD_RAD_S * spread[1]
        self._coulomb, self._viscous = _COULOMB_NM * spread[2], _VISCOUS_NMS * spread[3]
        self.friction_factor, self.supply_v = 1.0, 5.0
        self.gain = np.full(N_SERVOS, _GAIN)
        self.refresh()
        start = np.zeros(N_SERVOS) if start_rad is None else np.array(start_rad)
        self.data.qpos[self._qpos] = start
        mujoco.mj_forward(self.model, self.data)
        self.goal = self._register(start)
        self.steps = 0
        self.forces = np.zeros(len(LEGS))
        self.touches: tuple[deque[Touch], ...] = tuple(deque(maxlen=16) for _ in LEGS)

    @property
    def joint_angles(self) -> Array:
        """(8,) rad."""
        return np.asarray(self.data.qpos[self._qpos])

    @property
    def joint_speeds(self) -> Array:
        """(8,) rad/s."""
        return np.asarray(self.data.qvel[self._dof])

    @property
    def feet_m(self) -> Array:
        """(4, 3) m, in the world."""
        return np.asarray(self.data.site_xpos[self._feet])

    def refresh(self) -> None:
        """Take up a change of the servos' condition."""
        self.model.dof_damping[self._dof] = self._stall / self._no_load + self._viscous
        self.model.dof_frictionloss[self._dof] = self._coulomb * self.friction_factor

    def write_goal(self, goal_rad: Array) -> Array:
        """Write the goal registers; returns what they hold, (8,) rad."""
        self.goal = self._register(goal_rad)
        return self.goal

    def place_plate(self, leg: int, height_m: float, *, stiffness_n_m: float | None = None) -> None:
        """Put a leg's plate under its foot, its top at a height in the world."""
        foot = self.feet_m[leg]
        self.data.mocap_pos[self._plates[leg]] = (foot[0], foot[1], height_m - _PLATE_M[2])
        geom = self.model.geom(f"plate_{LEGS[leg]}").id
        body = self.model.body(f"{LEGS[leg]}_knee").id
        set_surface(self.model, geom, stiffness_n_m, float(self.model.body_invweight0[body, 0]))

    def clear_plate(self, leg: int) -> None:
        """Take a leg's plate away."""
        self.data.mocap_pos[self._plates[leg]] = PARKED_M

    def step(self) -> None:
        """Make one physics step of 1 ms.

        Raises:
            SimulationDivergedError: the state is no longer finite, or absurdly fast.
        """
        error = np.rint(self.goal / STEP_RAD) - np.rint(self.joint_angles / STEP_RAD)
        duty = np.clip(self.gain * error / _PWM, -1.0, 1.0)
        self.data.ctrl[self._ctrl] = self._stall * (self.supply_v / 5.0) * duty
        mujoco.mj_step(self.model, self.data)
        self.steps += 1
        self.forces = self.data.sensordata[self._touch].sum(axis=1)
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
        self.plant = QuadrupedPlant(start_rad=start)
        super().__init__(horns, self.plant, start)

    def step(self) -> None:
        """Make one step."""
        self.plant.write_goal(self.target())
        self.plant.step()

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set a servo's gain."""
        self.plant.gain[index] = _PWM * STEP_RAD / slope_rad


def _scene() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(robot_xml("quadruped"))
    for leg in LEGS:
        body = spec.worldbody.add_body(name=f"plate_{leg}", mocap=True, pos=list(PARKED_M))
        body.add_geom(
            name=f"plate_{leg}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=list(_PLATE_M),
            contype=0,
            conaffinity=1,
            priority=2,
            friction=[0.9, 0.005, 0.0001],
            solref=list(HARD_SOLREF),
        )
    return spec.compile()
