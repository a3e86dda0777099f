r"""Draws legs of random robots, and records how they move.

A drawn leg hangs from a fixed body.  It swings between random points, as in ``sim pose``, or steps
as a gait does, with a push-off along the ground; a plate may wait under a descent.  Drawn are
joints and axes, lengths, masses, the servo (gain, torque, speed, back-EMF, friction with Stribeck
and load, dead zone, punch, position step, noise), the latency of its commands, the control rate and
the gait.

Two generators: legs of the first have servos of the law in :mod:`adaptive_contact_sim.servo`.
Those of the second have a cascade of a position and a speed loop, friction that grows with the
square of the speed, and other profiles: nothing is learned from them.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final, Literal

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import SimulationDivergedError
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact_sim.arrays import LegArrays, Run, contact_at
from adaptive_contact_sim.servo import ServoBank, ServoKind, ServoParameters
from adaptive_contact_sim.truth import TruthTracker

Motion = Literal["pose", "gait"]

LEG: Final = "leg"
_AXES: Final = {"yaw": "0 0 1", "roll": "1 0 0", "pitch": "0 -1 0"}
_JOINTS: Final = (
    ("pitch", "pitch"),
    ("yaw", "pitch", "pitch"),
    ("roll", "pitch", "pitch"),
    ("yaw", "pitch", "pitch", "pitch"),
    ("yaw", "roll", "pitch", "pitch"),
    ("yaw", "roll", "pitch", "pitch", "pitch"),
    ("yaw", "roll", "pitch", "pitch", "pitch", "roll"),
)
_HOW_OFTEN: Final = (0.12, 0.35, 0.23, 0.05, 0.05, 0.15, 0.05)
# Steps of servos with 10 bits over 300 degrees, 12 bits, 10 bits over 240 degrees, and 14 bits.
_QUANTA_RAD: Final = (
    math.radians(300) / 1023,
    math.tau / 4096,
    math.radians(0.24),
    math.tau / 2**14,
)
_SOLE_M: Final = 0.008
_PARKED_M: Final = (0.0, 0.0, -5.0)
# Physics steps of about so long.
_STEP_S: Final = 0.001


@dataclass(frozen=True, eq=False)
class DrawnLeg:
    """One leg of a robot."""

    robot: Robot  # its description; the slope in it is off by some 8 %, as a register's is
    axes: tuple[str, ...]  # a word per joint
    origins_m: Array  # (J, 3)
    masses_kg: Array  # (J,) of the links
    rest_rad: Array  # (J,) rad, a posture in the middle of what it does
    servo: ServoKind  # its servos
    parameters: ServoParameters  # their constants
    # proportional gains of position and speed, 1/s and of full torque per rad/s, of the second
    # generator's law; None for the first's
    cascade: tuple[float, float] | None
    noise_steps: float  # of a reading, before rounding
    latency_ticks: int  # from a command to its servo
    swing_s: float  # up and down again
    profile: str  # of a joint's way from one point to the next

    @property
    def reach_m(self) -> float:
        """Length of the leg, stretched."""
        return float(np.linalg.norm(self.origins_m, axis=1).sum())


def draw_leg(seed: int, *, second: bool = False) -> DrawnLeg:
    """Draw a leg."""
    rng = np.random.default_rng([seed, 0x1E6, int(second)])

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    axes = _JOINTS[rng.choice(len(_JOINTS), p=_HOW_OFTEN)]
    joints = len(axes)
    sprawling = axes[0] == "yaw" and joints <= 4 and rng.random() < 0.7
    size = log_uniform(0.12, 0.4)
    origins, rest = _geometry(rng, axes, size, sprawling=sprawling)
    masses = 0.055 * math.exp(rng.normal(0.0, 0.3)) * size / 0.25 * rng.uniform(0.8, 2.0, joints)
    masses[-1] *= rng.uniform(0.4, 1.0)
    period_s = log_uniform(1 / 200, 1 / 30) if rng.random() < 0.5 else 0.02
    quantum = float(rng.choice(_QUANTA_RAD, p=(0.25, 0.45, 0.15, 0.15)))
    slope = log_uniform(0.07, 0.4)
    true_slope = slope * math.exp(rng.normal(0.0, 0.08))
    # Torque against gravity's on the leg stretched out; drives of like build are like fast.
    reach = np.linalg.norm(origins, axis=1)
    arms = [reach[i:].cumsum() - reach[i:] / 2 for i in range(joints)]
    weight = max(9.81 * float(masses[i:] @ arm) for i, arm in enumerate(arms))
    stall = weight * log_uniform(2.5, 9.0)
    speed = log_uniform(3.5, 9.0)
    damping = stall / speed
    coulomb = stall * rng.uniform(0.015, 0.07)

    def spread(value: float, by: float = 0.12) -> Array:
        return np.asarray(value * rng.uniform(1 - by, 1 + by, joints))

    parameters = ServoParameters(
        stall_torque_nm=spread(stall),
        no_load_speed_rad_s=spread(speed),
        margin_steps=np.full(joints, float(rng.choice((0, 0, 1, 2)))),
        slope_steps=np.full(joints, true_slope / quantum),
        punch=np.full(joints, float(rng.choice((0.0, 0.016, 0.03)))),
        torque_limit=np.full(joints, rng.uniform(0.9, 1.0)),
        coulomb_nm=spread(coulomb, 0.3),
        stribeck_nm=spread(coulomb * rng.uniform(0.1, 0.6)),
        stribeck_speed_rad_s=np.full(joints, 0.1),
        load_friction=spread(rng.uniform(0.0, 0.2)),
        viscous_nms=spread(damping * rng.uniform(0.01, 0.08)),
        # Time constants of 8 to 45 ms.
        armature_kgm2=spread(damping * log_uniform(0.008, 0.045)),
        stall_current_a=np.ones(joints),
    )
    centre = round(math.tau / quantum)
    profiles = ("trapezoid", "sine") if second else ("line", "quintic", "cycloid")
    # A position loop of its own slope at no-load speed; the speed loop is stiffer than the motor.
    cascade = (speed / true_slope, rng.uniform(2.0, 6.0) / speed) if second else None
    return DrawnLeg(
        robot=_described(axes, origins, period_s, quantum, slope),
        axes=axes,
        origins_m=origins,
        masses_kg=masses,
        rest_rad=rest,
        servo=ServoKind("drawn", quantum, 2 * centre, parameters),
        parameters=parameters,
        cascade=cascade,
        noise_steps=rng.uniform(0.1, 0.7),
        latency_ticks=int(rng.choice(4, p=(0.7, 0.17, 0.09, 0.04))),
        swing_s=log_uniform(0.22, 0.8),
        profile=str(rng.choice(profiles)),
    )


def record(leg: DrawnLeg, motion: Motion, swings: int, seed: int, *, plates: float = 0.0) -> Run:
    """Record a leg, as fast as possible.

    Args:
        leg: drawn.
        motion: from point to point, or as a gait steps.
        swings: how many.
        seed: of the motion, the plates and the noise.
        plates: share of descents onto a plate.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    rng = np.random.default_rng([seed, 0x5EED])
    plan = _Plan(leg, motion, rng)
    for _ in range(swings):
        plan.swing(plates)
    return _play(leg, plan, rng)


def _geometry(
    rng: np.random.Generator, axes: tuple[str, ...], size_m: float, *, sprawling: bool
) -> tuple[Array, Array]:
    """Draw links, (J, 3) m, and a posture at rest, (J,) rad."""
    along = np.array([1.0, 0.0, 0.0]) if sprawling else np.array([0.0, 0.0, -1.0])
    pitches = [i for i, axis in enumerate(axes) if axis == "pitch"]
    shares = rng.uniform(0.6, 1.4, len(pitches))
    origins = np.zeros((len(axes), 3))
    for i, axis in enumerate(axes):
        if axis == "pitch":
            origins[i] = along * size_m * shares[pitches.index(i)] / shares.sum()
        else:
            origins[i] = along * size_m * rng.uniform(0.1, 0.3)
            origins[i, 1] += size_m * rng.uniform(-0.1, 0.1) * (axis == "roll")
    rest = np.zeros(len(axes))
    if sprawling:
        rest[pitches[0]] = rng.uniform(0.1, 0.5)
        rest[pitches[1:]] = -rng.uniform(0.7, 1.5) / (len(pitches) - 1)
    else:
        bent = (rng.uniform(0.4, 0.8), -rng.uniform(0.9, 1.6), rng.uniform(0.2, 0.6))
        rest[pitches] = rng.choice((-1.0, 1.0)) * np.array(bent[: len(pitches)])
    return origins, rest


def _described(
    axes: tuple[str, ...], origins_m: Array, period_s: float, quantum: float, slope: float
) -> Robot:
    joints = ", ".join(f'"{axis}{i}"' for i, axis in enumerate(axes))
    words = ", ".join(f'"{axis}"' for axis in axes)
    origins = [[round(x, 5) for x in origin] for origin in origins_m.tolist()]
    return parse_robot(
        f'[robot]\nname = "drawn"\nperiod_s = {period_s:.6f}\nquantum_rad = {quantum:.7f}\n'
        f"[servo]\nslope_rad = {slope:.5f}\n[detector]\nfalse_alarms_per_hour = 1.0\n"
        f'[[leg]]\nid = "{LEG}"\njoints = [{joints}]\naxes = [{words}]\norigins_m = {origins}\n',
        source="a drawn leg",
    )


def _scene(leg: DrawnLeg) -> mujoco.MjModel:
    """Compile the leg, hung up, with a plate that can be moved."""
    parts = [
        '<mujoco><compiler angle="radian"/>',
        f'<option timestep="{_STEP_S}" integrator="implicitfast" iterations="20"/>',
        '<default><geom contype="0" conaffinity="0"/></default><worldbody>',
        f'<body name="plate" mocap="true" pos="{" ".join(map(str, _PARKED_M))}">',
        '<geom type="box" size="1 1 0.02" contype="1" conaffinity="1" solref="0.004 1"/></body>',
        '<body pos="0 0 1.0">',
    ]
    start = np.zeros(3)
    for axis, origin, mass in zip(leg.axes, leg.origins_m, leg.masses_kg, strict=True):
        place, end = (" ".join(f"{x:.6f}" for x in point) for point in (start, origin))
        width = max(0.012, 0.06 * float(np.linalg.norm(origin)))
        parts.append(
            f'<body pos="{place}"><joint axis="{_AXES[axis]}" armature="0.001" '
            'solreffriction="0.004 1"/>'
            f'<geom type="capsule" size="{width}" fromto="0 0 0 {end}" mass="{mass}"/>'
        )
        start = origin
    end = " ".join(f"{x:.6f}" for x in leg.origins_m[-1])
    parts.append(
        f'<geom type="sphere" size="{_SOLE_M}" pos="{end}" mass="0.003" contype="1" '
        f'conaffinity="1"/><site name="foot" pos="{end}" size="{2 * _SOLE_M}"/>'
    )
    parts.append("</body>" * (len(leg.axes) + 1))
    parts.append('</worldbody><sensor><touch site="foot"/></sensor></mujoco>')
    return mujoco.MjModel.from_xml_string("".join(parts))


class _Plan:
    """Commands of a leg, swing after swing."""

    def __init__(self, leg: DrawnLeg, motion: Motion, rng: np.random.Generator) -> None:
        self._leg, self._motion, self._rng = leg, motion, rng
        self._model = _scene(leg)
        self._data = mujoco.MjData(self._model)
        self._q = leg.rest_rad.copy()
        self._stand = self._foot(self._q)
        self._period_s = leg.robot.period_s
        self._half = max(6, round(leg.swing_s / 2 / self._period_s))
        self._hold = max(4, round(leg.swing_s * rng.uniform(0.3, 1.0) / self._period_s))
        self.goals: list[Array] = []  # (n, J) rad, a list of rows
        self.phases: list[bool] = []  # (n,) in swing
        # ticks at which a plate may come, each with the end of its descent
        self.plates: dict[int, int] = {}

    def swing(self, plates: float) -> None:
        """Add a swing and the stance after it."""
        rng = self._rng
        top, end = self._points()
        ticks = max(5, round(self._half * rng.uniform(0.85, 1.15)))
        self._go(top, ticks, swing=True)
        begin = len(self.goals)
        self._go(end, ticks, swing=True)
        share = rng.uniform(0.6, 0.9) if self._motion == "gait" else rng.uniform(0.05, 0.6)
        if rng.random() < plates:
            self.plates[begin + int(share * ticks)] = begin + ticks
        if self._motion == "gait":
            foot = self._foot(end)
            back = self._stand - (foot - self._stand) * (1.0, 1.0, 0.0)
            self._go(self._reach(np.append(back[:2], foot[2]), end)[0], self._hold, swing=False)
        else:
            self._go(end, max(3, round(self._hold * rng.uniform(0.2, 1.0))), swing=False)

    def _points(self) -> tuple[Array, Array]:
        """Draw the top of a swing and its end, (J,) rad each."""
        rng, leg = self._rng, self._leg
        size = leg.reach_m * np.array([1.0, float(leg.axes[0] != "pitch"), 1.0])
        fastest = float(leg.parameters.no_load_speed_rad_s.mean()) * self._half * self._period_s
        for _ in range(6):
            if self._motion == "gait":
                low = self._stand + size * (rng.uniform(0.06, 0.16), rng.uniform(-0.08, 0.08), 0.0)
                top = (self._foot(self._q) + low) / 2
                top[2] += size[2] * rng.uniform(0.15, 0.22)
            else:
                wide = rng.uniform(-0.25, 0.25, (2, 2))
                top = self._stand + size * (*wide[0], rng.uniform(0.1, 0.3))
                low = self._stand + size * (*wide[1], rng.uniform(-0.12, 0.03))
            up, far = self._reach(top, self._q)
            down, further = self._reach(low, up)
            most = max(np.abs(up - self._q).max(), np.abs(down - up).max())
            if max(far, further) < 0.02 and most < 0.75 * fastest:
                return up, down
        return leg.rest_rad + rng.uniform(-0.2, 0.2, len(leg.rest_rad)), leg.rest_rad.copy()

    def _go(self, end: Array, ticks: int, *, swing: bool) -> None:
        x = np.arange(1, ticks + 1) / ticks
        self.goals += list(self._q + _profile(self._leg.profile, x)[:, None] * (end - self._q))
        self.phases += [swing] * ticks
        self._q = end

    def _foot(self, q: Array) -> Array:
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        return np.array(self._data.site_xpos[0])

    def _reach(self, point: Array, near: Array) -> tuple[Array, float]:
        """Angles that bring the foot to a point, and by how much they miss it, m.

        Unlike :class:`~adaptive_contact_sim.legs.ChainLegs` it refuses no point: drawn legs are
        sent to points drawn, and take the nearest of six.
        """
        q, jacobian = near.copy(), np.zeros((3, len(near)))
        off = np.inf
        for _ in range(25):
            error = point - self._foot(q)
            off = float(np.abs(error).max())
            if off < 1e-4:
                break
            mujoco.mj_comPos(self._model, self._data)
            mujoco.mj_jacSite(self._model, self._data, jacobian, None, 0)
            across = np.linalg.solve(
                jacobian @ jacobian.T + 1e-6 * np.eye(3), np.clip(error, -0.05, 0.05)
            )
            q += np.clip(jacobian.T @ across, -0.3, 0.3)
            np.clip(q, self._leg.rest_rad - 1.2, self._leg.rest_rad + 1.2, out=q)
        return q, off


def _profile(name: str, x: Array) -> Array:
    """Share of the way after a share of the time, (n,) in 0 to 1."""
    match name:
        case "quintic":
            return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))
        case "cycloid":
            return np.asarray(x - np.sin(math.tau * x) / math.tau)
        case "sine":
            return np.asarray(0.5 - 0.5 * np.cos(math.pi * x))
        case "trapezoid":  # a fifth to speed up, a fifth to slow down
            return np.asarray(np.where(
                x < 0.2, x**2 / 0.32, np.where(x > 0.8, 1 - (1 - x) ** 2 / 0.32, (x - 0.1) / 0.8)
            ))  # fmt: skip
        case _:
            return x


def _play(leg: DrawnLeg, plan: _Plan, rng: np.random.Generator) -> Run:
    """Move the leg along a plan."""
    period_s, quantum = leg.robot.period_s, leg.servo.quantum_rad
    substeps = max(1, round(period_s / _STEP_S))
    model = _scene(leg)
    model.opt.timestep = period_s / substeps
    model.dof_armature[:] = leg.parameters.armature_kgm2
    data = mujoco.MjData(model)
    data.qpos[:] = leg.rest_rad
    mujoco.mj_forward(model, data)
    bank = ServoBank(
        leg.parameters, position=data.qpos, velocity=data.qvel, acceleration=data.qacc,
        torque=data.qfrc_applied, friction=model.dof_frictionloss, damping=model.dof_damping,
        kind=leg.servo,
    )  # fmt: skip
    drive = bank.drive if leg.cascade is None else _Cascade(leg, bank, data, model).drive
    n, joints = len(plan.goals), len(leg.axes)
    desired = np.rint(np.array(plan.goals) / quantum) * quantum
    measured, angle, force = np.zeros((n, joints)), np.zeros((n, joints)), np.zeros(n)
    tracker = TruthTracker(model.opt.timestep, substeps, 1)
    forces = np.zeros((substeps, 1))
    nothing: tuple[deque[object], ...] = (deque(),)
    bank.write_goal(desired[0])
    for _ in range(round(0.5 / model.opt.timestep)):
        drive()
        mujoco.mj_step(model, data)
        bank.rub()
    made = tracker.start(forces[0], 0)
    sent: deque[Array] = deque([desired[0]] * (leg.latency_ticks + 1), leg.latency_ticks + 1)
    until, before = 0, math.inf
    for k in range(n):
        angle[k] = data.qpos
        noise = leg.noise_steps * rng.standard_normal(joints)
        measured[k] = np.rint(data.qpos / quantum + noise) * quantum
        sent.append(desired[k])
        bank.write_goal(sent[0])
        until = plan.plates.get(k, until)
        height = float(data.site_xpos[0, 2])
        if plan.phases[k] and k and not plan.phases[k - 1]:
            data.mocap_pos[0] = _PARKED_M
        elif k < until and height < before:  # it comes down
            data.mocap_pos[0] = data.site_xpos[0] - (0.0, 0.0, _SOLE_M + 0.003 + 0.02)
            until = 0
        before = height
        for j in range(substeps):
            drive()
            mujoco.mj_step(model, data)
            bank.rub()
            forces[j, 0] = data.sensordata[0]
        if not float(np.abs(data.qvel).max()) < 200.0:  # rad/s, which no servo turns
            raise SimulationDivergedError(f"a drawn leg diverges at {k * period_s:.2f} s")
        force[k] = forces.mean()
        made += tracker.update(forces, nothing, (k + 1) * substeps)  # type: ignore[arg-type]
    changes = tuple(
        change.message(round(change.step * model.opt.timestep * 1e9), (), str) for change in made
    )
    t_ns = np.arange(n, dtype=np.int64) * round(period_s * 1e9)
    arrays = LegArrays(
        measured=measured, desired=desired, valid=np.ones((n, joints), dtype=np.bool_),
        swing=np.array(plan.phases), contact=contact_at(t_ns, changes),
        force_n=force, angle=angle, changes=changes,
    )  # fmt: skip
    return Run(t_ns, {LEG: arrays}, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))


class _Cascade:
    """The second generator's servo: a position loop around a speed loop, and its friction."""

    def __init__(
        self, leg: DrawnLeg, bank: ServoBank, data: mujoco.MjData, model: mujoco.MjModel
    ) -> None:
        assert leg.cascade is not None
        self._data, self._bank, self._parameters = data, bank, leg.parameters
        self._position, self._speed = leg.cascade
        self._viscous = leg.parameters.viscous_nms
        model.dof_damping[:] = self._viscous

    def drive(self) -> None:
        """Compute the torques of a step."""
        p, data = self._parameters, self._data
        fastest = p.no_load_speed_rad_s
        wanted = np.clip(self._position * (self._bank.goal_rad - data.qpos), -fastest, fastest)
        share = np.clip(self._speed * (wanted - data.qvel), -1.0, 1.0)
        drag = 2.0 * self._viscous / fastest * data.qvel * np.abs(data.qvel)
        data.qfrc_applied[:] = p.stall_torque_nm * share - drag
