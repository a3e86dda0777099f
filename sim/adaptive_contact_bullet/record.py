"""Records runs, with a twin at each touch: the same leg, state and commands without its ground.

What an ideal observer of the free path sees of a touch is the difference between a leg's readings
and those of its twin.  It is the bound that recall is held against: a touch that this observer does
not find within the window, at the same rate of false alarms, is beyond any detector.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from typing import Final, Literal, NamedTuple

import msgspec
import numpy as np
from scipy.stats import chi2

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.wire import ContactTruth
from adaptive_contact_bullet.drawn import shape_of
from adaptive_contact_bullet.gait import Gait, Walker
from adaptive_contact_bullet.plant import STEP_S, Ground, Plant, State
from adaptive_contact_bullet.robots import Shape
from adaptive_contact_sim.arrays import LegArrays, Run, contact_at
from adaptive_contact_sim.truth import AIR_FORCE_N, TOUCH_FORCE_N, Change, TruthTracker

_SETTLE_S: Final = 1.5
_FALLEN: Final = 0.5  # cosine of the body's tilt
_EPOCH_NS: Final = 1_700_000_000_000_000_000
# 540,000 judged ticks are a robot-hour.
_PER_HOUR: Final = 540_000

Drift = Literal["friction", "joint", "supply", "play", "mass"]


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is recorded."""

    robot: str
    gait: Gait
    ground: Ground
    seconds: float
    seed: int  # of the ground, the motion and the readings
    robot_seed: int = 1  # of what differs between robots of one make
    plates: float = 0.0  # share of an arm's descents onto one
    drifts: tuple[tuple[Drift, float], ...] = ()  # which, and after how many seconds
    twins: bool = False


class Observed(NamedTuple):
    """What the ideal observer sees of a touch."""

    leg: str
    onset_ns: int
    # largest over the ticks of the window: the squared distance over the limit at one false alarm
    # per hour
    ratio: float


class Recorded(NamedTuple):
    """A run, and what its twins show."""

    shape: Shape
    run: Run
    observed: tuple[Observed, ...]


@dataclasses.dataclass(eq=False)
class _Twin:
    leg: int
    tick: int
    onset_step: int
    state: State


def record(plan: Plan) -> Recorded:
    """Record a run as fast as possible.

    Raises:
        RuntimeError: the physics diverged, or the robot fell: what its feet do then is no walk.
    """
    return _Recorder(plan).record()


class _Recorder:
    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        shape = self._shape = shape_of(plan.robot)
        self._rng = np.random.default_rng([plan.seed, 0xB011E7])
        fixed = len(shape.legs) == 1
        self._plant = Plant(shape, plan.ground, self._rng, robot_seed=plan.robot_seed, fixed=fixed)
        self._walker = Walker(shape, plan.gait, self._rng)
        self._substeps = round(shape.period_s / STEP_S)
        n = self._n = round(plan.seconds / shape.period_s)
        legs, joints = len(shape.legs), shape.joints
        self._measured, self._desired, self._angle = (
            np.zeros((n, legs * joints)) for _ in range(3)
        )
        self._swing = np.zeros((n, legs), dtype=bool)
        self._forces = np.zeros((n * self._substeps, legs))
        self._position, self._rotation = np.zeros((n, 3)), np.zeros((n, 3, 3))
        self._air = np.zeros(legs, dtype=np.int64)  # steps in the air
        self._twins: list[_Twin] = []
        self._observed: list[Observed] = []

    def record(self) -> Recorded:
        plan, shape, plant = self._plan, self._shape, self._plant
        for _ in range(round(_SETTLE_S / shape.period_s)):  # stand before walking
            plant.drives.command(plant.drives.goal)
            plant.advance(self._substeps)
        touching: Mask = plant.touching
        legs = len(shape.legs)
        tracker = TruthTracker(STEP_S, self._substeps, legs)
        # What touches at first is no touch.
        started = tracker.start(touching.astype(np.float64), 0)  # 1 N
        self._changes = [change for change in started if not change.contact]
        for k in range(self._n):
            for drift, after_s in plan.drifts:
                if k == round(after_s / shape.period_s):
                    self._change(drift)
            state = plant.state if plan.twins else None
            self._angle[k] = plant.angles
            self._position[k], self._rotation[k] = plant.pose
            if self._rotation[k, 2, 2] < _FALLEN:
                at_s = k * shape.period_s
                raise RuntimeError(f"{shape.name} fell after {at_s:.0f} s; take lower bumps")
            self._measured[k] = plant.drives.read(plant.angles)
            self._desired[k] = self._walker.tick(touching)
            self._swing[k] = self._walker.swing
            if plan.plates:
                self._serve_plates()
            plant.drives.command(self._desired[k])
            steps = slice(k * self._substeps, (k + 1) * self._substeps)
            forces = self._forces[steps] = plant.advance(self._substeps)
            touching = np.asarray((forces > TOUCH_FORCE_N).any(axis=0))
            steps_made = (k + 1) * self._substeps
            self._changes += tracker.update(forces, [deque() for _ in range(legs)], steps_made)
            for leg, step in self._touched(forces):
                if state is not None and self._swing[k, leg]:
                    self._twins.append(_Twin(leg, k, k * self._substeps + step, state))
            self._go_through_twins(k)
        plant.close()
        return Recorded(shape, self._run(), tuple(self._observed))

    def _change(self, drift: Drift) -> None:
        drives, joints = self._plant.drives, self._shape.joints
        constants = drives.constants
        match drift:
            case "friction":
                constants[5:7] *= 2.5
            case "joint":  # one joint of each leg rubs
                constants[5:7, 1::joints] *= 4.0
            case "supply":
                drives.supply = 0.78
            case "play":
                constants[9] += math.radians(0.9)
            case "mass":
                for leg, built in enumerate(self._shape.legs):
                    self._plant.load(leg, 0.6 * built.masses_kg[-1])

    def _serve_plates(self) -> None:
        for leg in np.flatnonzero(self._walker.began).tolist():
            at = None
            if self._rng.random() < self._plan.plates:
                at = self._walker.targets_m[leg].copy()
                at[2] += self._rng.uniform(0.0, 0.035) - self._shape.sole_m
            self._waiting = at
        for leg in np.flatnonzero(self._walker.swing).tolist():
            # Under the descent only: the lift is free.
            self._plant.place_plate(leg, self._waiting if self._walker.down[leg] else None)

    def _touched(self, forces: Array) -> list[tuple[int, int]]:
        """Legs that touch after 60 ms in the air, and the step of the tick."""
        found = []
        for leg in range(forces.shape[1]):
            for step in range(len(forces)):
                if forces[step, leg] > TOUCH_FORCE_N:
                    if self._air[leg] >= round(0.060 / STEP_S):
                        found.append((leg, step))
                    self._air[leg] = 0
                elif forces[step, leg] < AIR_FORCE_N:
                    self._air[leg] += 1
        return found

    def _go_through_twins(self, k: int) -> None:
        """Simulate the twins whose window is over."""
        # A detection's window on hard ground, and a tick.
        ticks = math.ceil(0.14 / self._shape.period_s)
        due = [twin for twin in self._twins if k - twin.tick >= ticks]
        if due:
            kept = self._plant.keep()
            for twin in due:
                self._observe(twin, ticks)
            self._plant.go_on(kept)
            self._twins = [twin for twin in self._twins if twin not in due]

    def _observe(self, twin: _Twin, ticks: int) -> None:
        plant, joints, leg = self._plant, self._shape.joints, twin.leg
        plant.resume(twin.state)
        plant.let_through(leg, through=True)
        own = slice(leg * joints, (leg + 1) * joints)
        free = np.zeros((ticks, joints))
        for i in range(ticks):
            plant.drives.command(self._desired[twin.tick + i])
            plant.advance(self._substeps)
            free[i] = plant.angles[own]
        plant.let_through(leg, through=False)
        off = self._measured[twin.tick + 1 : twin.tick + 1 + ticks, own] - free
        squares = (off / plant.drives.reading_sd_rad) ** 2
        total = np.cumsum(squares.sum(axis=1))
        limit = chi2.isf(1.0 / _PER_HOUR / ticks, joints * np.arange(1, ticks + 1))
        onset_ns = self._ns(twin.onset_step)
        name = self._shape.legs[leg].id
        self._observed.append(Observed(name, onset_ns, float((total / limit).max())))

    def _ns(self, step: int) -> int:
        return _EPOCH_NS + round((step + 1) * STEP_S * 1e9)

    def _run(self) -> Run:
        shape, period_ns = self._shape, round(self._shape.period_s * 1e9)
        t_ns = _EPOCH_NS + np.arange(self._n, dtype=np.int64) * period_ns
        legs, joints = {}, shape.joints
        robot = shape.description
        for i, leg in enumerate(shape.legs):
            own = slice(i * joints, (i + 1) * joints)
            chain = robot.leg(leg.id).chain
            assert chain is not None
            feet = chain.foot(self._angle[:, own])
            cos, sin = math.cos(leg.yaw_rad), math.sin(leg.yaw_rad)
            world = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            feet = feet @ world.T + np.array(leg.mount_m)
            feet = np.einsum("nij,nj->ni", self._rotation, feet) + self._position
            speed = np.zeros_like(feet)
            speed[1:] = np.diff(feet, axis=0) / shape.period_s
            changes = tuple(
                self._told(change, speed) for change in self._changes if change.leg == i
            )
            legs[leg.id] = LegArrays(
                measured=self._measured[:, own],
                desired=self._desired[:, own],
                valid=np.ones((self._n, joints), dtype=bool),
                swing=self._swing[:, i],
                contact=contact_at(t_ns, changes),
                force_n=self._forces[:, i].reshape(self._n, -1).mean(axis=1),
                angle=self._angle[:, own],
                changes=changes,
            )
        return Run(t_ns, legs, self._position, self._rotation)

    def _told(self, change: Change, speed: Array) -> ContactTruth:
        """Make a change of contact a message; ``speed`` (n, 3) m/s is the foot's."""
        told = change.message(self._ns(change.step - 1), (), str)
        if not change.contact:
            return told
        *way, rise = speed[(change.step - 1) // self._substeps].tolist()
        surface = "soft" if self._plan.ground.kind == "soft" else "hard"
        down, grazing = max(-rise, 0.0), math.hypot(*way) > 5.0 * max(-rise, 1e-9)
        return msgspec.structs.replace(
            told, speed_m_s=down, part="foot", surface=surface, grazing=grazing
        )
