r"""The analytical detector's model: the simulator's own equations, nominal parameters, no fitting.

One leg on a level base that does not move.  With yaw :math:`\psi`, femur and tibia pitch, link
angles :math:`\phi_1 = q_2`, :math:`\phi_2 = q_2 + q_3` and each link's centre of mass at (r, z) in
the leg's plane,

.. math::
    (M(q) + hD)\,\Delta\omega = h\,(\tau(q, \theta^{des}) - D\omega - c(q, \omega) - g(q))
    - \lambda,
    \qquad |\lambda_i| \le h F_i(\omega, \tau)

per physics step h: the servo's law with its rounding, punch and saturation, back-EMF and viscous
damping D (implicit), Coriolis and gravity terms, and friction F that really sticks (a projected
Gauss-Seidel on the three joints).  Twenty steps make one control tick.

An observer keeps the state: after every reading y[k] the predicted angle and speed move by
:math:`\gamma_q` and :math:`\gamma_\omega` times the innovation.  :math:`\gamma_q = 1` with the
speed taken from two readings is the prediction from measured positions alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact_sim.elements import JOINTS
from adaptive_contact_sim.scene import robot_xml
from adaptive_contact_sim.servo import FULL_SCALE_STEPS, QUANTUM_RAD, ServoParameters, duty

# Physics steps per control tick, and rounds of the friction solver: the pitch joints are coupled.
_SUBSTEPS: Final = 20
_ROUNDS: Final = 3
# Ticks of a stream predicted together with others, and before them for the observer to settle
# (its slowest time constant is a few ticks).
_CHUNKS: Final = (200, 1000)
_SETTLE: Final = 50
# Chunks side by side from which on the arithmetic, not the interpreter, takes the time.
_SIDE_BY_SIDE: Final = 300
_GAINS: Final = (0.2, 0.4, 0.6, 0.8, 1.0)
_SPEED_GAINS: Final = (0.0, 0.2, 0.4, 0.6, 0.8)


@dataclass(frozen=True, eq=False)
class Gains:
    """Of the observer, (3,) each; ``None`` for the speed takes it from two readings."""

    angle: Array
    speed: Array | None


@dataclass(frozen=True, eq=False)
class NominalLeg:
    """The leg's nominal constants, from the model file and the servo's data sheet."""

    mass_kg: Array  # (3,) coxa, femur, tibia
    centre_m: Array  # (3, 2) along and above each link
    inertia: Array  # (3, 3) principal, kg m², link frame
    offset_m: Array  # (3,) where each link begins along the one before
    servo: ServoParameters  # nominal servo constants
    step_s: float  # physics step
    gravity: float  # m/s²

    @classmethod
    def of(cls, leg: str = "rf") -> NominalLeg:
        """Read the constants; legs are equal, and so are nominal servos."""
        model = mujoco.MjSpec.from_string(robot_xml()).compile()
        bodies = [model.body(f"{leg}_{joint}").id for joint in JOINTS]
        return cls(
            mass_kg=model.body_mass[bodies].copy(),
            centre_m=model.body_ipos[bodies][:, [0, 2]].copy(),
            inertia=model.body_inertia[bodies].copy(),
            offset_m=np.array([0.0, *model.body_pos[bodies[1:]][:, 0]]),
            servo=ServoParameters(),
            step_s=float(model.opt.timestep),
            gravity=float(-model.opt.gravity[2]),
        )


class Dynamics:
    """Advances many copies of the leg at once, state (3, s): joints first, which is faster."""

    def __init__(self, leg: NominalLeg) -> None:
        self.leg = leg
        p, self.h = leg.servo, leg.step_s
        self.armature = p.armature_kgm2[:3, None]
        self.back_emf = (p.stall_torque_nm / p.no_load_speed_rad_s)[:3, None]
        self.damping = self.back_emf + p.viscous_nms[:3, None]
        self.coulomb = p.coulomb_nm[:3, None]
        self.stribeck = p.stribeck_nm[:3, None]
        self.per_speed = -1.0 / p.stribeck_speed_rad_s[:3, None]
        self.load_friction = p.load_friction[:3, None]
        steps = np.arange(-FULL_SCALE_STEPS, FULL_SCALE_STEPS + 1, dtype=np.float64)
        table = [
            p.stall_torque_nm[j]
            * duty(
                steps,
                margin=p.margin_steps[j],
                slope=p.slope_steps[j],
                punch=p.punch[j],
                limit=p.torque_limit[j],
            )
            for j in range(3)
        ]
        self.table = np.array(table)

    def tick(self, q: Array, v: Array, goal: Array) -> tuple[Array, Array]:
        """One control tick: (3, s) angles and speeds after it."""
        goal_steps = np.rint(goal / QUANTUM_RAD)
        acceleration = np.zeros_like(q)
        torque = self._motor(q, goal_steps)
        for _ in range(_SUBSTEPS):
            load = np.abs(torque - self.back_emf * v - self.armature * acceleration)
            bound = (
                self.coulomb
                + self.stribeck * np.exp(np.abs(v) * self.per_speed)
                + self.load_friction * load
            )
            v_new = self._step(q, v, torque, bound)
            acceleration = (v_new - v) / self.h
            v = v_new
            q = q + self.h * v
            torque = self._motor(q, goal_steps)
        return q, v

    def _motor(self, q: Array, goal_steps: Array) -> Array:
        error = goal_steps - np.rint(q / QUANTUM_RAD)
        index = np.clip(error + FULL_SCALE_STEPS, 0, 2 * FULL_SCALE_STEPS).astype(np.intp)
        return np.stack([self.table[j].take(index[j]) for j in range(3)])

    def _step(self, q: Array, v: Array, torque: Array, bound: Array) -> Array:
        """Speeds after one physics step."""
        leg, h = self.leg, self.h
        _, m_f, m_t = leg.mass_kg
        l0, l1 = leg.offset_m[1], leg.offset_m[2]
        (_, _), (xf, zf), (xt, zt) = leg.centre_m
        c1, s1 = np.cos(q[1]), np.sin(q[1])
        c2, s2 = np.cos(q[1] + q[2]), np.sin(q[1] + q[2])
        # Along the horizon and up, from the coxa axis: femur's and tibia's centre of mass.
        fr, fz = xf * c1 - zf * s1, xf * s1 + zf * c1
        tr, tz = xt * c2 - zt * s2, xt * s2 + zt * c2
        kr, kz = l1 * c1, l1 * s1  # the knee, from the femur axis
        rf, rt = l0 + fr, l0 + kr + tr

        # Inertia: yaw apart from the pitch joints, which share a plane.
        (_, _, cz), (ix_f, iy_f, iz_f), (ix_t, iy_t, iz_t) = leg.inertia
        yaw = (
            cz
            + leg.mass_kg[0] * leg.centre_m[0, 0] ** 2
            + m_f * rf**2
            + ix_f * s1**2
            + iz_f * c1**2
            + m_t * rt**2
            + ix_t * s2**2
            + iz_t * c2**2
        )
        cross = kr * tr + kz * tz
        own = iy_t + m_t * (xt**2 + zt**2)
        m22 = own + np.zeros_like(c1)
        m12 = own + m_t * cross
        m11 = iy_f + m_f * (xf**2 + zf**2) + own + m_t * (l1**2 + 2.0 * cross)

        # What a yaw does to the pitch joints (half the slope of its inertia), and they to it.
        slope2 = -2.0 * m_t * rt * tz + 2.0 * (ix_t - iz_t) * s2 * c2
        slope1 = -2.0 * m_f * rf * fz + 2.0 * (ix_f - iz_f) * s1 * c1 - 2.0 * m_t * rt * kz + slope2
        coriolis = m_t * (kr * tz - kz * tr)  # -d(cross)/d(q3)
        g = leg.gravity
        rest = np.stack(
            [
                (slope1 * v[1] + slope2 * v[2]) * v[0],
                -coriolis * (2.0 * v[1] + v[2]) * v[2]
                - 0.5 * slope1 * v[0] ** 2
                + g * (m_f * fr + m_t * (kr + tr)),
                coriolis * v[1] ** 2 - 0.5 * slope2 * v[0] ** 2 + g * m_t * tr,
            ]
        )
        push = h * (torque - self.damping * v - rest)
        a = self.armature + h * self.damping
        yaw, m11, m22 = yaw + a[0], m11 + a[1], m22 + a[2]
        determinant = m11 * m22 - m12**2
        i11, i22, i12 = m22 / determinant, m11 / determinant, -m12 / determinant
        free0 = v[0] + push[0] / yaw
        free1 = v[1] + i11 * push[1] + i12 * push[2]
        free2 = v[2] + i12 * push[1] + i22 * push[2]
        limit = h * bound
        first = np.clip(free0 * yaw, -limit[0], limit[0])
        second = third = np.zeros_like(free1)
        for _ in range(_ROUNDS):
            second = np.clip((free1 - i12 * third) / i11, -limit[1], limit[1])
            third = np.clip((free2 - i12 * second) / i22, -limit[2], limit[2])
        return np.stack(
            [
                free0 - first / yaw,
                free1 - i11 * second - i12 * third,
                free2 - i12 * second - i22 * third,
            ]
        )


def predict(leg: NominalLeg, streams: list[tuple[Array, Array]], gains: Gains) -> list[Array]:
    """One-step predictions of whole streams.

    Args:
        leg: the nominal leg.
        streams: (measured, desired), (n, 3) rad each.
        gains: of the observer.

    Returns:
        (n, 3) rad for each, the reading predicted one tick before; NaN at the first.
    """
    total = sum(len(measured) for measured, _ in streams)
    chunk = int(np.clip(total // _SIDE_BY_SIDE, *_CHUNKS))
    parts = [
        (which, start)
        for which, (measured, _) in enumerate(streams)
        for start in range(0, len(measured), chunk)
    ]
    # (span, 3, parts): every chunk with what came before it; ends repeat the last row.
    rows = [
        np.clip(np.arange(start - _SETTLE, start + chunk), 0, len(streams[which][0]) - 1)
        for which, start in parts
    ]
    measured = np.stack([streams[w][0][r].T for (w, _), r in zip(parts, rows, strict=True)], -1)
    desired = np.stack([streams[w][1][r].T for (w, _), r in zip(parts, rows, strict=True)], -1)
    measured, desired = measured.transpose(1, 0, 2), desired.transpose(1, 0, 2)
    predicted = _observe(Dynamics(leg), measured, desired, gains)
    out = [np.full_like(m, np.nan) for m, _ in streams]
    for column, (which, start) in enumerate(parts):
        stop = min(start + chunk, len(out[which]))
        out[which][start:stop] = predicted[_SETTLE : _SETTLE + stop - start, :, column]
    for values in out:
        values[0] = np.nan
    return out


def _observe(dynamics: Dynamics, measured: Array, desired: Array, gains: Gains) -> Array:
    """(ticks, 3, s) readings predicted, the first repeating the reading."""
    predicted = np.empty_like(measured)
    predicted[0] = measured[0]
    q, v = measured[0].copy(), np.zeros_like(measured[0])
    angle = gains.angle[:, None]
    period = dynamics.h * _SUBSTEPS
    for k in range(len(measured) - 1):
        innovation = measured[k] - q
        q = q + angle * innovation
        if gains.speed is None:
            v = (measured[k] - measured[max(k - 1, 0)]) / period
        else:
            v = v + gains.speed[:, None] * innovation / period
        q, v = dynamics.tick(q, v, desired[k])
        predicted[k + 1] = q
    return predicted


def tune_gains(leg: NominalLeg, streams: list[tuple[Array, Array]], free: list[Mask]) -> Gains:
    """The gains with the least residual on free ticks, chosen joint by joint.

    Args:
        leg: the nominal leg.
        streams: training streams.
        free: (n,) of each, ticks that count.
    """
    best = np.full(3, np.inf)
    angle, speed = np.ones(3), np.zeros(3)
    for gamma in _GAINS:
        for gamma_speed in _SPEED_GAINS:
            predicted = predict(leg, streams, Gains(np.full(3, gamma), np.full(3, gamma_speed)))
            residual = np.concatenate(
                [(s[0] - t)[f] for s, t, f in zip(streams, predicted, free, strict=True)]
            )
            rms = np.sqrt(np.nanmean(np.square(residual), axis=0))
            better = rms < best
            best[better], angle[better], speed[better] = rms[better], gamma, gamma_speed
    return Gains(angle, speed)
