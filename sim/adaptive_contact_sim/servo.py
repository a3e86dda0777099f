r"""The servos' control law and their friction, all of a robot at once.

An AX-12A reads its own potentiometer with 10 bits and compares it with the goal register, both
in steps of :math:`300^\circ/1023`.  With the error :math:`e` in steps, margin :math:`m`,
compliance slope :math:`s`, punch :math:`p` and torque limit :math:`u_{max}`, the duty is

.. math:: u = \operatorname{sgn}(e)\,\min(p + (1 - p)(|e| - m) / s,\; u_{max}),
          \qquad u = 0 \text{ for } |e| \le m

Other servos have the same law with other figures: an X-series servo's gain :math:`K_P` of PWM per
step is a slope of :math:`885/K_P` steps without margin and punch; an STS3215's dead zone is the
margin, and its minimum starting force the punch.  A :class:`ServoKind` has a kind's figures.

The motor, driven through an H-bridge with supply :math:`V`, gives at the output shaft

.. math:: \tau = \tau_s \frac{V}{12}\frac{R_0}{R}\,u - \frac{\tau_s}{\omega_0}\frac{R_0}{R}\,\omega

The second part (back-EMF) is linear in the speed: it goes into the engine's joint damping, which
is integrated implicitly.  The first takes one value per error in steps, so it is a table.

Friction of the gear is :math:`F_c + F_s e^{-|\omega|/\omega_s} + c\,|\tau_t|` against the motion,
:math:`\tau_t` being the torque passed on to the link; it is the engine's ``frictionloss``, a
constraint that really sticks, with its bound refreshed each step.

References:
    ROBOTIS AX-12A e-manual (margin, slope, punch, stall torque, no-load speed); XM430-W210 e-manual
    (P gain 800 of 128, PWM limit 885).  Feetech STS3215 (12 V): P 32 is a duty of 5.31 per rad, by
    oscilloscope (Rhoban/bam); dead zone and minimum starting force as delivered.
    Friction forms: M. Duclusaud et al., Extended Friction Models for the Physics Simulation of
    Servo Actuators (Rhoban/bam), model M4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array
from adaptive_contact_sim.elements import N_SERVOS

FULL_SCALE_STEPS: Final = 1023
QUANTUM_RAD: Final = math.radians(300.0) / FULL_SCALE_STEPS
# Of all kinds here.
NOMINAL_SUPPLY_V: Final = 12.0


@dataclass(frozen=True, eq=False)
class ServoParameters:
    """Servo constants at nominal condition, one of each servo, (18,) by default.

    Defaults are an AX-12A's and lie inside the ranges of docs/simulator.md; those marked *assumed*
    there are.

    Attributes:
        stall_torque_nm, no_load_speed_rad_s: at 12 V.
        margin_steps, slope_steps: compliance registers.
        punch, torque_limit: duties, of 1.
        coulomb_nm, stribeck_nm: sliding friction, and what is added to it at rest.
        stribeck_speed_rad_s: speed scale of that addition.
        load_friction: friction per torque passed on.
        viscous_nms: friction per speed.
        armature_kgm2: rotor inertia seen at the output.
        stall_current_a: at 12 V, for the sag of the supply.
    """

    stall_torque_nm: Array = field(default_factory=lambda: np.full(N_SERVOS, 1.5))
    no_load_speed_rad_s: Array = field(default_factory=lambda: np.full(N_SERVOS, 6.18))
    margin_steps: Array = field(default_factory=lambda: np.full(N_SERVOS, 1.0))
    slope_steps: Array = field(default_factory=lambda: np.full(N_SERVOS, 32.0))
    punch: Array = field(default_factory=lambda: np.full(N_SERVOS, 32.0 / 1023.0))
    torque_limit: Array = field(default_factory=lambda: np.full(N_SERVOS, 1.0))
    coulomb_nm: Array = field(default_factory=lambda: np.full(N_SERVOS, 0.05))
    stribeck_nm: Array = field(default_factory=lambda: np.full(N_SERVOS, 0.02))
    stribeck_speed_rad_s: Array = field(default_factory=lambda: np.full(N_SERVOS, 0.1))
    load_friction: Array = field(default_factory=lambda: np.full(N_SERVOS, 0.2))
    viscous_nms: Array = field(default_factory=lambda: np.full(N_SERVOS, 0.006))
    armature_kgm2: Array = field(default_factory=lambda: np.full(N_SERVOS, 0.005))
    stall_current_a: Array = field(default_factory=lambda: np.full(N_SERVOS, 1.5))


class ServoKind(NamedTuple):
    """One model of servo."""

    name: str  # of the maker
    quantum_rad: float  # a step of position and goal
    full_scale_steps: int  # largest value of the goal register
    nominal: ServoParameters  # servo constants, (1,) each

    def make_parameters(self, servos: int) -> ServoParameters:
        """Make the parameters of so many servos, all alike."""
        one = {f.name: getattr(self.nominal, f.name) for f in fields(ServoParameters)}
        return ServoParameters(**{name: np.repeat(value, servos) for name, value in one.items()})


def _nominal(**values: float) -> ServoParameters:
    """Constants of one servo; those left out are an AX-12A's."""
    ax = ServoParameters()
    left = {f.name: getattr(ax, f.name)[:1] for f in fields(ServoParameters)}
    return ServoParameters(**left | {name: np.array([value]) for name, value in values.items()})


AX12A: Final = ServoKind("AX-12A", QUANTUM_RAD, FULL_SCALE_STEPS, _nominal())
_STEP_4096_RAD: Final = 2.0 * math.pi / 4096
# Stall torque, speed and current: ROBOTIS e-manual at 12 V.  Friction and armature: between those
# identified of an XL-330 and an MX-64 (Rhoban/bam), nearer to the MX-64, whose motor is larger.
XM430_W210: Final = ServoKind(
    "XM430-W210",
    _STEP_4096_RAD,
    4095,
    _nominal(
        stall_torque_nm=3.0,
        no_load_speed_rad_s=77.0 * 2.0 * math.pi / 60.0,
        margin_steps=0.0,
        slope_steps=885.0 / (800.0 / 128.0),
        punch=0.0,
        coulomb_nm=0.05,
        stribeck_nm=0.02,
        load_friction=0.1,
        viscous_nms=0.008,
        armature_kgm2=0.006,
        stall_current_a=2.3,
    ),
)
# Stall torque 30 kg*cm and 45 rpm at 12 V: Feetech.  Coulomb and viscous friction and armature of
# the 12 V servo: identified (kscalelabs/sysid), the derivative gain's damping included.
STS3215: Final = ServoKind(
    "STS3215",
    _STEP_4096_RAD,
    4095,
    _nominal(
        stall_torque_nm=2.94,
        no_load_speed_rad_s=45.0 * 2.0 * math.pi / 60.0,
        margin_steps=1.0,
        slope_steps=1.0 / (32 * 0.166 * _STEP_4096_RAD),
        punch=16.0 / 1000.0,
        torque_limit=0.97,
        coulomb_nm=0.1143,
        stribeck_nm=0.03,
        load_friction=0.1,
        viscous_nms=0.0408,
        armature_kgm2=0.0259,
        stall_current_a=2.7,
    ),
)


# What differs from one servo to the next; registers (margin, slope, punch) do not.
_SPREAD_FIELDS: Final = (
    "stall_torque_nm",
    "no_load_speed_rad_s",
    "coulomb_nm",
    "stribeck_nm",
    "load_friction",
    "viscous_nms",
    "armature_kgm2",
)


def manufactured(robot_seed: int, nominal: ServoParameters | None = None) -> ServoParameters:
    """Draw the servos of one particular robot.

    Args:
        robot_seed: which robot; apart from a run's seed, so that runs share a robot.
        nominal: centre of the spread; a hexapod's where left out.
    """
    base = nominal or ServoParameters()
    n = base.stall_torque_nm.size
    rng = np.random.default_rng([robot_seed, 0x5E470])
    drawn = {
        name: getattr(base, name) * rng.uniform(0.88, 1.12, n)  # servos of one kind
        for name in _SPREAD_FIELDS
    }
    return replace(base, **drawn)


class ServoBank:
    """All servos of a robot: their condition, and buffers for the 1 kHz step.

    The views given are the engine's own arrays; :meth:`drive` writes ``torque``, :meth:`rub`
    writes ``friction``.  Condition (wear, supply) is set in its
    arrays; :meth:`refresh` then rebuilds what depends on it.

    Args:
        parameters: the servos.
        kind: what they all are.
        position, velocity, acceleration: (S,) views of joint state, rad and s.
        torque: (S,) view of motor torques, N*m, written.
        friction: (S,) view of friction bounds, N*m, written.
        damping: (S,) view of joint damping, N*m*s/rad, written on a change of condition.
    """

    def __init__(
        self,
        parameters: ServoParameters,
        *,
        position: Array,
        velocity: Array,
        acceleration: Array,
        torque: Array,
        friction: Array,
        damping: Array,
        kind: ServoKind = AX12A,
    ) -> None:
        size = position.size
        self.parameters = parameters
        self.kind = kind
        self.position = position
        self.velocity = velocity
        self._acceleration = acceleration
        self.torque = torque
        self.friction = friction
        self.damping = damping

        self.friction_factor = np.ones(size)
        self.viscous_factor = np.ones(size)
        self.compliance_factor = np.ones(size)
        self.winding_factor = np.ones(size)
        self.offset_rad = np.zeros(size)
        self.supply_v = np.full(size, NOMINAL_SUPPLY_V)
        # Share of the supply that reaches the servos under load, all alike; see :meth:`sag`.
        self._sag = np.ones(size)

        full = kind.full_scale_steps
        width = 2 * full + 1  # duties for errors -full .. full
        self._table = np.zeros((size, width))
        # What each row of the table was made for: drive scale and slope.
        self._table_of = np.full((2, size), np.nan)
        self._flat = self._table.reshape(-1)
        self._row = np.arange(size) * float(width) + full
        self._goal = np.zeros(size)
        self._base = self._row.copy()
        self._steps_per_rad = np.full(size, 1.0 / kind.quantum_rad)
        self._offset_steps = np.zeros(size)
        self._offset = False  # whether any servo has one
        self._index = np.zeros(size, dtype=np.intp)
        self._work = np.zeros(size)
        self._load = np.zeros(size)
        # (S,) in their present condition: the motors' own damping, N*m*s/rad, and their gears'
        # Coulomb friction, N*m
        self.back_emf = np.zeros(size)
        self.sliding = np.zeros(size)
        self._stribeck = np.zeros(size)
        self._inverse_stribeck_speed = -1.0 / self.parameters.stribeck_speed_rad_s
        self._armature = np.array(self.parameters.armature_kgm2)
        self._load_friction = np.array(self.parameters.load_friction)
        self.refresh()

    @property
    def viscous(self) -> Array:
        """(S,) N*m*s/rad, the gear's damping in its present condition."""
        return np.asarray(self.parameters.viscous_nms * self.viscous_factor)

    @property
    def goal_rad(self) -> Array:
        """(S,) rad, what the goal registers hold."""
        return np.asarray(self._goal * self.kind.quantum_rad)

    def friction_bound(self, index: NDArray[np.intp], speed: Array, load: Array) -> Array:
        """Friction bound of some servos, N*m, at given speeds (rad/s) and loads (N*m, >= 0)."""
        rest = self._stribeck[index] * np.exp(np.abs(speed) * self._inverse_stribeck_speed[index])
        return np.asarray(self.sliding[index] + rest + self._load_friction[index] * load)

    def write_goal(self, goal_rad: Array) -> Array:
        """Write the goal registers.

        Args:
            goal_rad: (S,) rad, in the servos' own frames.

        Returns:
            (S,) rad, what the registers can hold: a whole number of steps within their range.
        """
        quantum, full = self.kind.quantum_rad, self.kind.full_scale_steps
        centre = (full + 1) // 2  # the register's value at joint angle zero
        steps = np.rint(goal_rad / quantum)
        np.clip(steps, -centre, full - centre, out=steps)
        self._goal[:] = steps
        np.add(self._row, steps, out=self._base)
        return np.asarray(steps * quantum)

    # The two below are a fifth of a simulation's time.  Numpy takes 0.2 us for a call with arrays
    # by position, half as long again with names, and twice as long with a Python number.

    def drive(self) -> None:
        """Compute the motors' stall-side torque for this step into ``torque``."""
        work = self._work
        np.multiply(self.position, self._steps_per_rad, work)
        if self._offset:
            np.add(work, self._offset_steps, work)
        np.rint(work, work)
        np.subtract(self._base, work, work)
        self._index[:] = work
        self._flat.take(self._index, out=self.torque, mode="clip")
        np.multiply(self.torque, self._sag, self.torque)

    def rub(self) -> None:
        """Refresh the friction bounds from the step just made."""
        work, load, velocity = self._work, self._load, self.velocity
        # Torque passed on: the motor's, less back-EMF and what turns its own rotor.
        np.multiply(self.back_emf, velocity, load)
        np.subtract(self.torque, load, load)
        np.multiply(self._armature, self._acceleration, work)
        np.subtract(load, work, load)
        np.abs(load, load)
        np.multiply(load, self._load_friction, load)
        np.abs(velocity, work)
        np.multiply(work, self._inverse_stribeck_speed, work)
        np.exp(work, work)
        np.multiply(work, self._stribeck, work)
        np.add(work, load, work)
        np.add(work, self.sliding, self.friction)

    def sag(self) -> None:
        """Let the supply sag with the current drawn now; called once a control tick."""
        p = self.parameters
        # Winding current is proportional to torque; the H-bridge takes it for the duty's share.
        share = (self.torque - self.back_emf * self.velocity) / p.stall_torque_nm
        duty = self.torque / (p.stall_torque_nm * (self.supply_v / NOMINAL_SUPPLY_V))
        drawn = float(np.sum(np.abs(p.stall_current_a * share * duty)))
        target = 1.0 - drawn * 0.1 / NOMINAL_SUPPLY_V  # battery and wiring have 0.1 ohm
        # Input capacitors: a tick or two, which also keeps the loop quiet.
        now = float(self._sag[0])
        self._sag[:] = now + 0.5 * (max(target, 0.5) - now)

    def refresh(self) -> None:
        """Rebuild what depends on the servos' condition, after a change of it."""
        p = self.parameters
        np.divide(self.offset_rad, self.kind.quantum_rad, out=self._offset_steps)
        self._offset = bool(self._offset_steps.any())
        np.multiply(p.coulomb_nm, self.friction_factor, out=self.sliding)
        np.multiply(p.stribeck_nm, self.friction_factor, out=self._stribeck)
        np.divide(p.stall_torque_nm, p.no_load_speed_rad_s * self.winding_factor, out=self.back_emf)
        np.add(self.back_emf, self.viscous, out=self.damping)
        scale = p.stall_torque_nm * (self.supply_v / NOMINAL_SUPPLY_V) / self.winding_factor
        slope = p.slope_steps * self.compliance_factor
        wanted = np.stack([scale, slope])
        rows = np.flatnonzero((wanted != self._table_of).any(axis=0))
        if rows.size:
            self._table_of[:] = wanted
            self._table[rows] = scale[rows, None] * duty(
                np.arange(
                    -self.kind.full_scale_steps, self.kind.full_scale_steps + 1, dtype=np.float64
                ),
                margin=p.margin_steps[rows, None],
                slope=slope[rows, None],
                punch=p.punch[rows, None],
                limit=p.torque_limit[rows, None],
            )


def duty(error_steps: Array, *, margin: Array, slope: Array, punch: Array, limit: Array) -> Array:
    """Duty of the servo's own position controller.

    Args:
        error_steps: goal minus position, in steps.
        margin: error without drive, steps.
        slope: error beyond the margin at which the drive is full, steps.
        punch: duty just beyond the margin, of 1.
        limit: largest duty, of 1.

    Returns:
        Duty in -1 .. 1, of the arguments' broadcast shape.
    """
    beyond = np.abs(error_steps) - margin
    size = np.minimum(punch + (1.0 - punch) * beyond / slope, limit)
    return np.asarray(np.where(beyond > 0.0, np.sign(error_steps) * size, 0.0))
