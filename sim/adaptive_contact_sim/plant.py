"""The robot's physics: 20 engine steps per control tick, with the servos' law in each.

The plant knows joints, servos and contacts; it knows nothing of gaits, drifts or messages.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import ConfigurationError, SimulationDivergedError
from adaptive_contact_sim.elements import HEXAPOD, Elements, Layout
from adaptive_contact_sim.gear import GearTrain
from adaptive_contact_sim.servo import AX12A, ServoBank, ServoKind, ServoParameters

# Faster than any part of the robot can be: five times a servo's no-load speed, and free fall
# from several metres.  Beyond it the integration has blown up.
_ABSURD_JOINT_RAD_S: Final = 60.0
_ABSURD_BODY: Final = 20.0


class Touch(NamedTuple):
    """A part of a leg coming into contact."""

    step: int  # physics step at which the contact appeared
    part: int  # index into `PARTS`
    speed_m_s: float  # of the touching point, just before
    grazing: bool  # the motion was nearly tangent to the surface
    other: int  # id of the geom that was touched


class Plant:
    """Engine, servos and touch sensing of one robot.

    Raises:
        ConfigurationError: the period is not a whole number of physics steps.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        parameters: ServoParameters,
        *,
        period_s: float = 0.02,
        layout: Layout = HEXAPOD,
        kind: ServoKind = AX12A,
    ) -> None:
        ratio = period_s / model.opt.timestep
        self.substeps = round(ratio)
        if self.substeps < 1 or abs(ratio - self.substeps) > 1e-9:
            raise ConfigurationError(
                f"control period {period_s} s is {ratio:.4f} physics steps of "
                f"{model.opt.timestep} s; expected a whole number"
            )
        # The engine would write its warnings to a file in the working folder.  What it warns of, a
        # state that is not finite, is raised here instead.
        log = mujoco.MjLogConfig.get()
        log.logto_file = log.logto_console = False
        log.set()
        self.model = model
        self.data = mujoco.MjData(model)
        self.elements = Elements.resolve(model, layout)
        self.period_s = period_s
        self.step_s = float(model.opt.timestep)
        self.steps = 0  # physics steps made so far
        # called after each of them; None without a listener
        self.on_step: Callable[[], None] | None = None

        e = self.elements
        self._scratch = mujoco.MjData(model)  # mj_setConst overwrites the state of its data
        # (S,) rad and rad/s, views of the engine's state
        self.joint_angles: Array = self.data.qpos[e.qpos]
        self.joint_speeds: Array = self.data.qvel[e.dof]
        model.dof_armature[e.dof] = parameters.armature_kgm2
        legs = self._legs = len(layout.legs)
        self._mass_kg = np.zeros(legs)
        self.servos = ServoBank(
            parameters,
            position=self.joint_angles,
            velocity=self.joint_speeds,
            acceleration=self.data.qacc[e.dof],
            torque=self.data.ctrl[e.ctrl],
            friction=model.dof_frictionloss[e.dof],
            damping=model.dof_damping[e.dof],
            kind=kind,
        )
        self.gears = GearTrain(self.servos, model.dof_armature[e.dof], self.step_s)
        self._hang_payload()

        # Forces of the last tick's physics steps, and when parts came into contact.
        self.sensed = np.zeros((self.substeps, model.nsensordata))
        self.forces = np.zeros((self.substeps, legs))
        # A chattering foot touches every other step; a change of contact is judged 40 ms later.
        self.touches: tuple[deque[Touch], ...] = tuple(deque(maxlen=64) for _ in layout.legs)
        self._touching = [False] * legs
        self._contacts = 0
        self._velocity6 = np.zeros(6)
        self._geom_leg: list[int] = e.geom_leg.tolist()

    @property
    def time_s(self) -> float:
        """Simulated time."""
        return self.steps * self.step_s

    def place(self, position_m: Array, quaternion: Array, joints_rad: Array) -> None:
        """Put the robot somewhere, at rest.

        Args:
            position_m: (3,) of the body; one that hangs stays where it is.
            quaternion: (4,) w first.
            joints_rad: (S,).
        """
        mujoco.mj_resetData(self.model, self.data)
        if self.elements.floats:
            self.data.qpos[:3] = position_m
            self.data.qpos[3:7] = quaternion
        self.joint_angles[:] = joints_rad
        mujoco.mj_forward(self.model, self.data)
        self.steps = 0
        self._contacts = 0
        self._touching = [False] * self._legs

    def start_clock(self) -> None:
        """Call this moment step 0, and forget what was touched before."""
        self.steps = 0
        for touches in self.touches:
            touches.clear()

    def advance(self) -> None:
        """Make one control tick's physics steps, the goals being written before.

        Raises:
            SimulationDivergedError: the state is no longer finite, or absurdly fast.
        """
        try:
            # A NaN shows first where a position becomes a number of steps.
            with np.errstate(invalid="raise", over="raise"):
                self._substeps()
        except FloatingPointError as error:
            raise self._diverged("positions are no longer finite") from error
        self._check()
        touch = self.sensed[:, self.elements.touch]
        touch.reshape(self.substeps, self._legs, -1).sum(axis=2, out=self.forces)
        self.servos.sag()

    def _substeps(self) -> None:
        model, data = self.model, self.data
        drive, rub = self.servos.drive, self.servos.rub
        step, sensed, sensors = mujoco.mj_step, self.sensed, data.sensordata
        gears = self.gears if self.gears.active else None
        on_step = self.on_step
        for i in range(self.substeps):
            drive()
            if gears is not None:
                gears.step()
            step(model, data)
            rub()
            if gears is not None:
                gears.rub()
            sensed[i] = sensors
            self.steps += 1
            if on_step is not None:
                on_step()
            if data.ncon != self._contacts:
                self._record_contacts()

    def foot_positions(self) -> Array:
        """(L, 3) m, the true feet in the world."""
        return np.asarray(self.data.site_xpos[self.elements.foot_sites])

    def body_pose(self) -> tuple[Array, Array]:
        """True position (3,) m and rotation (3, 3) of the body in the world."""
        return self.data.xpos[self.elements.body], self.data.xmat[self.elements.body].reshape(3, 3)

    def set_servos(self, name: str, values: Array) -> None:
        """Set one of the servo bank's conditions, (S,), such as ``friction_factor``."""
        current = getattr(self.servos, name)
        if np.array_equal(current, values):
            return
        current[:] = values
        self.servos.refresh()
        self.gears.refresh()

    def set_backlash(self, backlash_rad: Array) -> None:
        """Give the joints backlash, (S,) rad."""
        if self.gears.set_backlash(backlash_rad):
            mujoco.mj_setConst(self.model, self._scratch)

    def set_payload(self, mass_kg: Array) -> None:
        """Set what hangs at the feet, absolute.

        Args:
            mass_kg: (L,) kg at the foot end of each leg.
        """
        if np.array_equal(mass_kg, self._mass_kg):
            return
        self._mass_kg[:] = mass_kg
        self._hang_payload()

    def _hang_payload(self) -> None:
        # Always from nothing, so that repeating a value changes nothing.  The engine wants
        # masses above zero.
        mass = np.maximum(self._mass_kg, 1e-9)
        self.model.body_mass[self.elements.payloads] = mass
        # Radius of gyration of a lump of mud, m: a ball of 2.5 cm radius.
        self.model.body_inertia[self.elements.payloads] = mass[:, None] * 0.0158**2
        mujoco.mj_setConst(self.model, self._scratch)

    def _record_contacts(self) -> None:
        """Record which parts of which legs came into contact in the step just made."""
        data, leg_of = self.data, self._geom_leg
        self._contacts = data.ncon
        now = [False] * self._legs
        if self._contacts:
            contacts = data.contact  # each look at it makes a new list
            for k, (first, second) in enumerate(contacts.geom.tolist()):
                geom, other = (first, second) if leg_of[first] >= 0 else (second, first)
                leg = leg_of[geom]
                if leg < 0:
                    continue
                if not now[leg] and not self._touching[leg]:
                    self.touches[leg].append(self._touch(contacts, k, geom, other))
                now[leg] = True
        self._touching = now

    def _touch(self, contacts: Any, which: int, geom: int, other: int) -> Touch:
        data = self.data
        # The engine's velocities are those before the step, so before the impact.
        mujoco.mj_objectVelocity(
            self.model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, self._velocity6, 0
        )
        # Feet that stand lose and find the ground all the time, and `np.cross` takes its time.
        wx, wy, wz, vx, vy, vz = self._velocity6.tolist()
        x, y, z = (contacts.pos[which] - data.geom_xpos[geom]).tolist()
        turning = (wy * z - wz * y, wz * x - wx * z, wx * y - wy * x)
        velocity = np.array([vx + turning[0], vy + turning[1], vz + turning[2]])
        speed = math.sqrt(velocity @ velocity)
        into = abs(float(velocity @ contacts.frame[which, :3]))
        return Touch(
            step=self.steps,
            part=int(self.elements.geom_part[geom]),
            speed_m_s=speed,
            # A touch is grazing when less than this share of the velocity points into the surface.
            grazing=speed > 0.0 and into < 0.35 * speed,
            other=other,
        )

    def _check(self) -> None:
        fastest = float(np.abs(self.joint_speeds).max())
        body = float(np.abs(self.data.qvel[:6]).max()) if self.elements.floats else 0.0
        # Written so that NaN, which compares false, is caught.
        if not (fastest < _ABSURD_JOINT_RAD_S and body < _ABSURD_BODY):
            raise self._diverged(
                f"joints turn at up to {fastest:.3g} rad/s, the body moves at {body:.3g}; expected "
                f"below {_ABSURD_JOINT_RAD_S:.0f} and {_ABSURD_BODY:.0f}"
            )

    def _diverged(self, what: str) -> SimulationDivergedError:
        return SimulationDivergedError(
            f"at {self.time_s:.3f} s {what}; try a milder drift, or report the command and seed"
        )
