r"""Position servos as two masses: a motor, and an output behind a gear with play and a spring.

.. math::
    J\,\dot\omega = \tau_s u V - \tfrac{\tau_s}{\omega_0}\omega - F(\omega, \tau) - \tau, \qquad
    \tau = k\,\mathrm{play}(\theta - q) + c\,(\omega - \dot q), \qquad
    F = F_c + F_s e^{-|\omega| / \omega_s} + \mu\,|\tau|

with the duty :math:`u = \mathrm{clip}(K_p e - K_d \dot q, \pm 1)`, the supply :math:`V` of 1, and
no torque while the gear crosses its play.  The encoder is at the output or, as in many gear motors,
on the motor.  There a push at the foot first crosses the play and winds up the spring: it builds up
over 20 to 100 ms, where the servos of :mod:`adaptive_contact_sim.servo` show it in one step.

References:
    Forms and magnitudes of friction: M. Duclusaud et al., Extended Friction Models for the Physics
    Simulation of Servo Actuators (Rhoban/bam), models M4 and M6.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from typing import Final

import numba
import numpy as np

from adaptive_contact.arrays import Array

# Steps of the motor in one of the engine: the spring on the rotor is the stiffest part.
_PARTS: Final = 4


@dataclasses.dataclass(frozen=True)
class Servo:
    """Constants of one make, at the output shaft."""

    stall_nm: float  # at full supply
    no_load_rad_s: float
    gain: float  # duty of 1 per rad of error
    damping: float  # duty of 1 per rad/s of the output
    rotor_kgm2: float
    coulomb_nm: float
    stribeck_nm: float  # more than that at rest
    load_friction: float  # friction per torque passed on
    spring_nm_rad: float
    play_rad: float  # the whole width
    quantum_rad: float  # of the encoder; 0 for a float
    noise_rad: float  # of a reading
    latency_ticks: int  # from a command to the servo
    on_motor: bool = False  # the encoder; else at the output

    @property
    def slope_rad(self) -> float:
        """Error at which the drive saturates."""
        return 1.0 / self.gain


_STRIBECK_RAD_S: Final = 0.12
_SPRING_DAMPING_S: Final = 0.0015  # of the spring's stiffness


class Drives:
    """The servos of a robot.

    Args:
        servo: their make.
        angles: (n,) rad, of the joints at the start.
        rng: of readings.
        physics_s: step of the engine.
        robot_seed: of the differences between servos of one make.
    """

    def __init__(
        self,
        servo: Servo,
        angles: Array,
        rng: np.random.Generator,
        physics_s: float,
        robot_seed: int = 1,
    ) -> None:
        n = len(angles)
        self.servo = servo
        self._rng = rng
        self._step_s = physics_s / _PARTS
        own = np.random.default_rng([robot_seed, 0x5E2B0])
        spread = own.uniform(0.9, 1.1, (4, n))
        play = own.uniform(0.5, 1.5, n) * servo.play_rad
        # Rows: stall, back-EMF, gain, damping, inertia, Coulomb, Stribeck, load, spring, play.
        self.constants = np.array(
            [
                servo.stall_nm * spread[0],
                servo.stall_nm / servo.no_load_rad_s * spread[0],
                np.full(n, servo.gain),
                np.full(n, servo.damping),
                servo.rotor_kgm2 * spread[1],
                servo.coulomb_nm * spread[2],
                servo.stribeck_nm * spread[2],
                servo.load_friction * spread[3],
                np.full(n, servo.spring_nm_rad),
                play,
            ]
        )
        self.supply = 1.0
        self.motor = np.array([angles, np.zeros(n)])  # rad, rad/s
        self._goals = deque([angles.copy()] * servo.latency_ticks)
        self.goal = angles.copy()  # in force

    def command(self, goal: Array) -> None:
        """Send (n,) rad to all servos."""
        self._goals.append(goal.copy())
        self.goal = self._goals.popleft()

    def torques(self, angles: Array, speeds: Array) -> Array:
        """Move the motors by one step of the engine; (n,) N·m on the joints meanwhile."""
        out = np.empty(len(angles))
        _advance(
            self.motor, self.constants, self.goal, angles, speeds, self.supply,
            self._step_s, self.servo.on_motor, out,
        )  # fmt: skip
        return out

    def read(self, angles: Array) -> Array:
        """Read (n,) rad, with noise, in steps of the encoder."""
        angles = self.motor[0] if self.servo.on_motor else angles
        noisy = angles + self._rng.normal(0.0, self.servo.noise_rad, len(angles))
        quantum = self.servo.quantum_rad
        return np.asarray(np.round(noisy / quantum) * quantum if quantum else noisy)

    @property
    def reading_sd_rad(self) -> float:
        """Standard deviation of a reading."""
        return math.hypot(self.servo.noise_rad, self.servo.quantum_rad / math.sqrt(12.0))

    def state(self) -> tuple[Array, deque[Array], Array]:
        """Return what changes, for :meth:`resume`."""
        return self.motor.copy(), self._goals.copy(), self.goal

    def resume(self, state: tuple[Array, deque[Array], Array]) -> None:
        """Go on from an earlier state."""
        motor, goals, self.goal = state
        self.motor, self._goals = motor.copy(), goals.copy()


@numba.njit
def _advance(motor, constants, goal, angles, speeds, supply, dt, on_motor, out):  # type: ignore[no-untyped-def]
    for i in range(len(angles)):
        stall, emf, gain, damping, inertia, coulomb, stribeck, load, spring, play = constants[:, i]
        theta, omega, mean = motor[0, i], motor[1, i], 0.0
        for part in range(_PARTS):
            angle = angles[i] + speeds[i] * dt * part
            seen, speed = (theta, omega) if on_motor else (angle, speeds[i])
            duty = min(max(gain * (goal[i] - seen) - damping * speed, -1.0), 1.0)
            gap = theta - angle
            wound = 0.0
            if gap > play / 2.0:
                wound = gap - play / 2.0
            elif gap < -play / 2.0:
                wound = gap + play / 2.0
            passed = 0.0
            if wound != 0.0:
                passed = spring * (wound + _SPRING_DAMPING_S * (omega - speeds[i]))
            mean += passed / _PARTS
            moved = omega + dt * (stall * supply * duty - passed) / inertia
            moved /= 1.0 + dt * emf / inertia
            friction = coulomb + stribeck * math.exp(-abs(moved) / _STRIBECK_RAD_S)
            friction = dt * (friction + load * abs(passed)) / inertia
            # Friction at most stops the motor: it does not turn it round.
            omega = math.copysign(max(abs(moved) - friction, 0.0), moved)
            theta += dt * omega
        motor[0, i], motor[1, i] = theta, omega
        out[i] = mean
