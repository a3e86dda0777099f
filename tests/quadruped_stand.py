"""Recordings of a robot of two-joint legs: what shows whether anything only fits the hexapod.

Each leg makes trials of its own, as in ``sim pose``: an ascent and a descent of 14 ticks each
between random foot points, then a hold of three ticks marked stance.  On a share of the descents
a plate waits at a random height.  All through, the body is held on its stand.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.wire import ContactTruth, Phase, ServoSample
from adaptive_contact_sim.scene import PARKED_M, robot_xml, set_surface
from adaptive_contact_sim.terrain import HARD_SOLREF
from adaptive_contact_sim.truth import TruthTracker

LEGS: Final = ("fl", "fr", "rl", "rr")
SERVOS: Final = tuple((leg, joint) for leg in LEGS for joint in ("hip", "knee"))
PARTS: Final = ("hip", "knee", "foot")
# The servo is an XL330 in position mode with its delivered gains (P 400, I and D 0), of torque,
# friction and speed as its manual and Rhoban/bam have them (docs/simulator.md).
STEP_RAD: Final = 2 * math.pi / 4096
_GAIN: Final = 400.0 / 128.0  # of PWM per step
_PWM: Final = 885.0
_STALL_NM: Final = 0.52
_NO_LOAD_RAD_S: Final = 104.0 * 2 * math.pi / 60
_COULOMB_NM, _VISCOUS_NMS = 0.0128, 0.0037
_SPREAD: Final = 0.12  # between servos of one kind, as for the hexapod
_L1, _L2 = 0.07, 0.09
_BODY_M: Final = 0.3
_TICKS, _HOLD = 14, 3
_SUBSTEPS: Final = 20
_PERIOD_NS: Final = 20_000_000
_SOLE_M: Final = 0.006
# Foot points in the leg's plane: reach and height of the lower and the upper layer, m.
_LOWER: Final = ((0.04, 0.12), (-0.125, -0.075))
_UPPER: Final = ((0.05, 0.13), (-0.055, -0.015))
# Off the joints' stops, which would be contacts too.
_HIP_RAD, _KNEE_RAD = (-2.0, 0.8), -2.3
_NOISE_STEPS: Final = 0.5
# Where on the commanded descent a plate is met; the foot comes there four ticks later.
_PLATE_SHARE: Final = (0.1, 0.5)
_PLATE_M: Final = (0.05, 0.03, 0.02)
# Physics steps over which a foot's speed is kept for the truth, which comes 60 ms late at most.
_KEPT_STEPS: Final = 200
# A plate comes when the foot is this clear of it.
_CLEAR_M: Final = 0.008


@dataclass(frozen=True)
class Scenario:
    """A run of the quadruped; names and seeds are permanent."""

    name: str
    about: str
    seed: int
    seconds: float
    plates: float = 0.0  # share of descents onto a plate
    # lowest and highest stiffness of the plates, None for hard ones
    soft_n_m: tuple[float, float] | None = None
    friction: float = 1.0  # factor of the gears' friction
    supply_v: float = 5.0  # of 5 V


SCENARIOS: Final = (
    Scenario("quadruped-free", "No plates: every event is a false alarm", 31, 300.0),
    Scenario("quadruped-collisions", "Half of the descents onto a hard plate", 32, 300.0, 0.5),
    Scenario("quadruped-soft", "Plates of 300 to 3000 N/m", 33, 300.0, 0.5, (300.0, 3000.0)),
    Scenario(
        "quadruped-worn", "Hard plates, friction x 3, from the start", 34, 300.0, 0.5, None, 3.0
    ),
    Scenario(
        "quadruped-battery", "Hard plates, 4.2 V, from the start", 35, 300.0, 0.5, None, 1.0, 4.2
    ),
)


class Recorded(NamedTuple):
    """Samples and truth, in order of time."""

    samples: list[tuple[str, ServoSample]]
    truth: list[tuple[str, ContactTruth]]


@dataclass
class _Trial:
    """One leg's way through a trial."""

    goals: Array  # (n, 2) rad
    points: Array  # (n, 2) m
    plate: float | None = None  # share of the descent at which to touch
    tick: int = 0


@dataclass
class _Walker:
    """One leg's trials."""

    rng: np.random.Generator
    plates: float
    point: Array = field(default_factory=lambda: np.array([0.08, -0.1]))
    trial: _Trial | None = None

    def begin(self) -> _Trial:
        top, end = self._draw(_UPPER), self._draw(_LOWER)
        share = (np.arange(1, _TICKS + 1) / _TICKS)[:, None]
        points = np.concatenate(
            [
                self.point + share * (top - self.point),
                top + share * (end - top),
                np.repeat(end[None], _HOLD, axis=0),
            ]
        )
        self.point = end
        plate = float(self.rng.uniform(*_PLATE_SHARE)) if self.rng.random() < self.plates else None
        return _Trial(_joints(points), points, plate)

    def _draw(self, layer: tuple[tuple[float, float], tuple[float, float]]) -> Array:
        while True:
            point = np.array([self.rng.uniform(*layer[0]), self.rng.uniform(*layer[1])])
            if not 0.03 < math.hypot(*point) < _L1 + _L2 - 0.004:
                continue
            hip, knee = _joints(point[None])[0]
            if _HIP_RAD[0] < hip < _HIP_RAD[1] and knee > _KNEE_RAD:
                return point


class PlatedPlant:
    """The quadruped with a plate under each leg that can be moved, and its truth.

    Attributes:
        goal: (8,) rad, written by :meth:`write_goal`.
        steps: physics steps made, of 1 ms.
        drive_nm: (8,) of full PWM.
    """

    def __init__(self, start_rad: Array) -> None:
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
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        names = [f"{leg}_{joint}" for leg, joint in SERVOS]
        ids = [self.model.joint(name).id for name in names]
        self._qpos = np.array([self.model.jnt_qposadr[i] for i in ids])
        self.dof = np.array([self.model.jnt_dofadr[i] for i in ids])
        self._ctrl = np.array([self.model.actuator(name).id for name in names])
        spread = np.random.default_rng([0, 0x330]).uniform(1 - _SPREAD, 1 + _SPREAD, (4, 8))
        self.drive_nm, no_load = _STALL_NM * spread[0], _NO_LOAD_RAD_S * spread[1]
        self.model.dof_damping[self.dof] = self.drive_nm / no_load + _VISCOUS_NMS * spread[3]
        self.model.dof_frictionloss[self.dof] = _COULOMB_NM * spread[2]
        self.data.qpos[self._qpos] = start_rad
        mujoco.mj_forward(self.model, self.data)
        self.write_goal(start_rad)
        self.steps = 0
        self._touch = np.array(
            [
                [int(self.model.sensor(f"{leg}_{part}_touch").adr[0]) for part in PARTS]
                for leg in LEGS
            ]
        )
        self._feet = np.array([self.model.site(f"{leg}_foot").id for leg in LEGS])
        self._plates = np.array([int(self.model.body(f"plate_{leg}").mocapid[0]) for leg in LEGS])

    @property
    def joint_angles(self) -> Array:
        """(8,) rad."""
        return np.asarray(self.data.qpos[self._qpos])

    def write_goal(self, goal_rad: Array) -> Array:
        """Write the goal registers; returns what they hold, (8,) rad."""
        self.goal = np.asarray(np.rint(goal_rad / STEP_RAD) * STEP_RAD)
        return self.goal

    def step(self) -> None:
        """Make one physics step of 1 ms."""
        error = np.rint(self.goal / STEP_RAD) - np.rint(self.joint_angles / STEP_RAD)
        duty = np.clip(_GAIN * error / _PWM, -1.0, 1.0)
        self.data.ctrl[self._ctrl] = self.drive_nm * duty
        mujoco.mj_step(self.model, self.data)
        self.steps += 1

    @property
    def forces(self) -> Array:
        """(4,) N."""
        return np.asarray(self.data.sensordata[self._touch].sum(axis=1))

    @property
    def feet_m(self) -> Array:
        """(4, 3) m, in the world."""
        return np.asarray(self.data.site_xpos[self._feet])

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


def record(scenario: Scenario) -> Recorded:
    """Simulate a scenario, as fast as possible."""
    seeds = np.random.SeedSequence(scenario.seed).spawn(len(LEGS) + 1)
    rng = np.random.default_rng(seeds[-1])
    walkers = [_Walker(np.random.default_rng(s), scenario.plates) for s in seeds[:-1]]
    start = np.tile(_joints(walkers[0].point[None])[0], len(LEGS))
    plant = PlatedPlant(start)
    plant.model.dof_frictionloss[plant.dof] *= scenario.friction
    plant.drive_nm = plant.drive_nm * (scenario.supply_v / 5.0)
    plant.write_goal(start)
    for _ in range(500):
        plant.step()
    plant.steps = 0
    tracker = TruthTracker(0.001, _SUBSTEPS, len(LEGS))
    forces = np.zeros((_SUBSTEPS, len(LEGS)))
    changes = tracker.start(forces[0], 0)
    recorded = Recorded([], [])
    speeds = np.zeros((_KEPT_STEPS, len(LEGS)))
    surface = "hard" if scenario.soft_n_m is None else "soft"
    goal = start.copy()
    for k in range(round(scenario.seconds / 0.02)):
        noise = _NOISE_STEPS * rng.standard_normal(goal.size)
        measured = np.rint(plant.joint_angles / STEP_RAD + noise) * STEP_RAD
        phases: list[Phase] = []
        for i, walker in enumerate(walkers):
            trial = walker.trial
            if trial is None or trial.tick >= len(trial.goals):
                trial = walker.trial = walker.begin()
            _serve_plate(plant, i, trial, scenario, rng)
            goal[2 * i : 2 * i + 2] = trial.goals[trial.tick]
            phases.append("swing" if trial.tick < 2 * _TICKS else "stance")
            trial.tick += 1
        desired = plant.write_goal(goal)
        for i, leg in enumerate(LEGS):
            sample = ServoSample(
                t_ns=k * _PERIOD_NS,
                seq=k,
                measured=measured[2 * i : 2 * i + 2].tolist(),
                desired=desired[2 * i : 2 * i + 2].tolist(),
                phase=phases[i],
            )
            recorded.samples.append((leg, sample))
        for j in range(_SUBSTEPS):
            before = plant.feet_m
            plant.step()
            forces[j] = plant.forces
            moved = np.linalg.norm(plant.feet_m - before, axis=1)
            speeds[plant.steps % _KEPT_STEPS] = moved / 0.001
        changes += tracker.update(forces, [deque()] * len(LEGS), plant.steps)
        for change in changes:
            # Just before the step in which the force came up.
            speed = float(speeds[(change.step - 2) % _KEPT_STEPS, change.leg])
            message = ContactTruth(
                t_ns=change.step * 1_000_000,
                contact=change.contact,
                force=change.force_n,
                speed_m_s=speed if change.contact else None,
                surface=surface if change.contact else None,
                part="foot" if change.contact else None,
            )
            recorded.truth.append((LEGS[change.leg], message))
        changes = []
    return recorded


def _serve_plate(
    plant: PlatedPlant, leg: int, trial: _Trial, scenario: Scenario, rng: np.random.Generator
) -> None:
    """Put a plate in the way of a descent once the foot is clear of it; take it away after."""
    if trial.tick < _TICKS:
        if trial.tick >= 1 and plant.forces[leg] == 0.0:
            plant.clear_plate(leg)
        return
    if trial.plate is None or trial.tick >= 2 * _TICKS:
        return
    descent = trial.points[_TICKS : 2 * _TICKS, 1]
    height = _BODY_M + float(np.interp(trial.plate * (_TICKS - 1), np.arange(_TICKS), descent))
    height -= _SOLE_M
    if plant.feet_m[leg, 2] - _SOLE_M > height + _CLEAR_M:
        stiffness = None
        if scenario.soft_n_m is not None:
            stiffness = float(np.exp(rng.uniform(*np.log(scenario.soft_n_m))))
        plant.place_plate(leg, height, stiffness_n_m=stiffness)
        trial.plate = None
    elif trial.tick >= _TICKS + 5:
        trial.plate = None


def _joints(points_m: Array) -> Array:
    """Hip and knee angles of foot points in the leg's plane, (n, 2) m to (n, 2) rad, knee up."""
    x, z = points_m[:, 0], points_m[:, 1]
    cos_knee = (x**2 + z**2 - _L1**2 - _L2**2) / (2 * _L1 * _L2)
    knee = -np.arccos(np.clip(cos_knee, -1.0, 1.0))
    hip = np.arctan2(z, x) - np.arctan2(_L2 * np.sin(knee), _L1 + _L2 * np.cos(knee))
    return np.stack([hip, knee], axis=1)
