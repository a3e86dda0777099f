r"""The AX-12A's control law and its friction, eighteen servos at once.

The servo reads its own potentiometer with 10 bits and compares it with the goal register, both
in steps of :math:`300^\circ/1023`.  With the error :math:`e` in steps, margin :math:`m`,
compliance slope :math:`s`, punch :math:`p` and torque limit :math:`u_{max}`, the duty is

.. math:: u = \operatorname{sgn}(e)\,\min(p + (1 - p)(|e| - m) / s,\; u_{max}),
          \qquad u = 0 \text{ for } |e| \le m

and the motor, driven through an H-bridge with supply :math:`V`, gives at the output shaft

.. math:: \tau = \tau_s \frac{V}{12}\frac{R_0}{R}\,u - \frac{\tau_s}{\omega_0}\frac{R_0}{R}\,\omega

The second part (back-EMF) is linear in the speed: it goes into the engine's joint damping, which
is integrated implicitly.  The first takes one of 2047 values per servo, so it is a table.

Friction of the gear is :math:`F_c + F_s e^{-|\omega|/\omega_s} + c\,|\tau_t|` against the motion,
:math:`\tau_t` being the torque passed on to the link; it is the engine's ``frictionloss``, a
constraint that really sticks, with its bound refreshed each step.

References:
    ROBOTIS AX-12A e-manual (margin, slope, punch, stall torque, no-load speed).
    Friction forms: M. Duclusaud et al., Extended Friction Models for the Physics Simulation of
    Servo Actuators (Rhoban/bam), model M4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact_sim.elements import N_SERVOS

__all__ = [
    "CENTRE_STEPS",
    "FULL_SCALE_STEPS",
    "NOMINAL_SUPPLY_V",
    "QUANTUM_RAD",
    "ServoBank",
    "ServoParameters",
    "manufactured",
]

Array = NDArray[np.float64]

FULL_SCALE_STEPS: Final = 1023
QUANTUM_RAD: Final = math.radians(300.0) / FULL_SCALE_STEPS
# Register value at joint angle zero (e-manual: 512 is the centre, 150 degrees).
CENTRE_STEPS: Final = 512
NOMINAL_SUPPLY_V: Final = 12.0
# Duties for errors -1023 .. 1023.
_TABLE_WIDTH: Final = 2 * FULL_SCALE_STEPS + 1


@dataclass(frozen=True, eq=False)
class ServoParameters:
    """Servo constants at nominal condition, (18,) each.

    Defaults lie inside the ranges of docs/simulator.md; those marked *assumed* there are.

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


def manufactured(
    robot_seed: int, *, spread: float = 0.12, nominal: ServoParameters | None = None
) -> ServoParameters:
    """Draw the eighteen servos of one particular robot.

    Args:
        robot_seed: which robot; apart from a run's seed, so that runs share a robot.
        spread: relative half-width of the uniform spread between servos of one kind.
        nominal: centre of the spread.

    Returns:
        The robot's own servo constants.
    """
    base = nominal or ServoParameters()
    rng = np.random.default_rng([robot_seed, 0x5E470])
    drawn = {
        name: getattr(base, name) * rng.uniform(1.0 - spread, 1.0 + spread, N_SERVOS)
        for name in _SPREAD_FIELDS
    }
    return replace(base, **drawn)


class ServoBank:
    """Eighteen servos: their condition, and buffers for the 1 kHz step.

    The views given are the engine's own arrays; :meth:`drive` writes ``torque``, :meth:`rub`
    writes ``friction``.  Condition (wear, supply) is set through :meth:`set_condition`, which
    rebuilds what depends on it.

    Args:
        parameters: the servos.
        position, velocity, acceleration: (18,) views of joint state, rad and s.
        torque: (18,) view of motor torques, N*m, written.
        friction: (18,) view of friction bounds, N*m, written.
        damping: (18,) view of joint damping, N*m*s/rad, written on a change of condition.
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
    ) -> None:
        size = position.size
        self.parameters = parameters
        self._position = position
        self._velocity = velocity
        self._acceleration = acceleration
        self._torque = torque
        self._friction = friction
        self._damping = damping

        self.friction_factor = np.ones(size)
        self.viscous_factor = np.ones(size)
        self.compliance_factor = np.ones(size)
        self.winding_factor = np.ones(size)
        self.offset_rad = np.zeros(size)
        self.supply_v = np.full(size, NOMINAL_SUPPLY_V)
        # Share of the supply that reaches the servos under load, all alike; see :meth:`sag`.
        self._sag = np.ones(size)

        self._table = np.zeros((size, _TABLE_WIDTH))
        # What each row of the table was made for: drive scale and slope.
        self._table_of = np.full((2, size), np.nan)
        self._flat = self._table.reshape(-1)
        self._row = np.arange(size) * float(_TABLE_WIDTH) + FULL_SCALE_STEPS
        self._goal = np.zeros(size)
        self._base = self._row.copy()
        self._steps_per_rad = np.full(size, 1.0 / QUANTUM_RAD)
        self._offset_steps = np.zeros(size)
        self._offset = False  # whether any servo has one
        self._index = np.zeros(size, dtype=np.intp)
        self._work = np.zeros(size)
        self._load = np.zeros(size)
        self._back_emf = np.zeros(size)
        self._sliding = np.zeros(size)
        self._stribeck = np.zeros(size)
        self._inverse_stribeck_speed = -1.0 / self.parameters.stribeck_speed_rad_s
        self._armature = np.array(self.parameters.armature_kgm2)
        self._load_friction = np.array(self.parameters.load_friction)
        self.refresh()

    @property
    def back_emf(self) -> Array:
        """(18,) N*m*s/rad, the motor's own damping in its present condition."""
        return self._back_emf

    @property
    def viscous(self) -> Array:
        """(18,) N*m*s/rad, the gear's damping in its present condition."""
        return np.asarray(self.parameters.viscous_nms * self.viscous_factor)

    @property
    def sliding(self) -> Array:
        """(18,) N*m, Coulomb friction in its present condition."""
        return self._sliding

    def friction_bound(self, index: NDArray[np.intp], speed: Array, load: Array) -> Array:
        """Friction bound of some servos, N*m, at given speeds (rad/s) and loads (N*m, >= 0)."""
        rest = self._stribeck[index] * np.exp(np.abs(speed) * self._inverse_stribeck_speed[index])
        return np.asarray(self._sliding[index] + rest + self._load_friction[index] * load)

    def write_goal(self, goal_rad: Array) -> Array:
        """Write the goal registers.

        Args:
            goal_rad: (18,) rad, in the servos' own frames.

        Returns:
            (18,) rad, what the registers can hold: a whole number of steps within 300 degrees.
        """
        steps = np.rint(goal_rad / QUANTUM_RAD)
        np.clip(steps, -CENTRE_STEPS, FULL_SCALE_STEPS - CENTRE_STEPS, out=steps)
        self._goal[:] = steps
        np.add(self._row, steps, out=self._base)
        return np.asarray(steps * QUANTUM_RAD)

    # The two below are a fifth of a simulation's time.  Numpy takes 0.2 us for a call with arrays
    # by position, half as long again with names, and twice as long with a Python number.

    def drive(self) -> None:
        """Compute the motors' stall-side torque for this step into ``torque``."""
        work = self._work
        np.multiply(self._position, self._steps_per_rad, work)
        if self._offset:
            np.add(work, self._offset_steps, work)
        np.rint(work, work)
        np.subtract(self._base, work, work)
        self._index[:] = work
        self._flat.take(self._index, out=self._torque, mode="clip")
        np.multiply(self._torque, self._sag, self._torque)

    def rub(self) -> None:
        """Refresh the friction bounds from the step just made."""
        work, load, velocity = self._work, self._load, self._velocity
        # Torque passed on: the motor's, less back-EMF and what turns its own rotor.
        np.multiply(self._back_emf, velocity, load)
        np.subtract(self._torque, load, load)
        np.multiply(self._armature, self._acceleration, work)
        np.subtract(load, work, load)
        np.abs(load, load)
        np.multiply(load, self._load_friction, load)
        np.abs(velocity, work)
        np.multiply(work, self._inverse_stribeck_speed, work)
        np.exp(work, work)
        np.multiply(work, self._stribeck, work)
        np.add(work, load, work)
        np.add(work, self._sliding, self._friction)

    def sag(self, resistance_ohm: float) -> None:
        """Let the supply sag with the current drawn now; called once a control tick.

        Args:
            resistance_ohm: of battery and wiring.
        """
        if resistance_ohm == 0.0:
            return
        p = self.parameters
        # Winding current is proportional to torque; the H-bridge takes it for the duty's share.
        share = (self._torque - self._back_emf * self._velocity) / p.stall_torque_nm
        duty = self._torque / (p.stall_torque_nm * (self.supply_v / NOMINAL_SUPPLY_V))
        drawn = float(np.sum(np.abs(p.stall_current_a * share * duty)))
        target = 1.0 - drawn * resistance_ohm / NOMINAL_SUPPLY_V
        # Input capacitors: a tick or two, which also keeps the loop quiet.
        now = float(self._sag[0])
        self._sag[:] = now + 0.5 * (max(target, 0.5) - now)

    def refresh(self) -> None:
        """Rebuild what depends on the servos' condition, after a change of it."""
        p = self.parameters
        np.divide(self.offset_rad, QUANTUM_RAD, out=self._offset_steps)
        self._offset = bool(self._offset_steps.any())
        np.multiply(p.coulomb_nm, self.friction_factor, out=self._sliding)
        np.multiply(p.stribeck_nm, self.friction_factor, out=self._stribeck)
        np.divide(
            p.stall_torque_nm, p.no_load_speed_rad_s * self.winding_factor, out=self._back_emf
        )
        np.add(self._back_emf, self.viscous, out=self._damping)
        scale = p.stall_torque_nm * (self.supply_v / NOMINAL_SUPPLY_V) / self.winding_factor
        slope = p.slope_steps * self.compliance_factor
        wanted = np.stack([scale, slope])
        rows = np.flatnonzero((wanted != self._table_of).any(axis=0))
        if rows.size:
            self._table_of[:] = wanted
            self._table[rows] = scale[rows, None] * duty(
                np.arange(-FULL_SCALE_STEPS, FULL_SCALE_STEPS + 1, dtype=np.float64),
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
