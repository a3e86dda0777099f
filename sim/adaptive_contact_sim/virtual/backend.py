"""What moves behind the virtual servos: a robot on a stand, or one that walks by itself.

On a stand goals come from the bus only.  The body is fixed; all legs hang free, or reach the floor
where the stand is low enough.  Physics runs in steps of 1 ms as time goes by, so a goal written at
any moment acts from that moment on.

A robot that walks by itself is the simulation of ``adaptive-contact sim``, untouched: same
settings, same samples and truth.  Each tick's physics is made a tick ahead and kept step by step,
so that a reading at any moment sees the robot as it is then.  It is made in a process of its own:
in one process the engine and the bus would wait for each other, as the interpreter serves one at a
time, and a reading that comes 5 ms late is no reading.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import time
from collections.abc import Sequence
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, Self

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.bridge.plan import JointPlan, PortPlan
from adaptive_contact.errors import ConfigurationError, SimulationDivergedError
from adaptive_contact_sim.elements import N_SERVOS
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.scene import robot_xml
from adaptive_contact_sim.servo import QUANTUM_RAD, manufactured
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import HARD_SOLREF

STEP_S: Final = 0.001
# Further behind than this, lost time is let go.
LET_GO_S: Final = 0.5


class Backend(Protocol):
    """A set of servos by index; angles in the servos' own frames, rad from the horn's centre.

    What the bus sets is ignored, and no other source writes goals, unless a backend says otherwise.
    """

    def advance(self, now_s: float) -> float:
        """Bring the servos up to a moment.

        Args:
            now_s: monotonic time.

        Returns:
            Monotonic time at which it wants to be called again at the latest.
        """

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Write a servo's goal."""
        return

    def goal(self, index: int) -> float | None:
        """A goal that another source (a gait inside) has written, or None."""
        return None

    def set_torque(self, index: int, on: bool) -> None:
        """Switch a servo's drive on or off."""
        return

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set the position error at which a servo drives with all it has."""
        return


def mounted(plans: Sequence[PortPlan], order: Sequence[tuple[str, str]]) -> tuple[JointPlan, ...]:
    """Return the servos of a description, which say how they are mounted.

    Args:
        plans: the robot's ports.
        order: (leg, joint) of every simulated joint.

    Raises:
        ConfigurationError: the description lacks one of them.
    """
    known = {
        (leg.id, joint.name): joint for plan in plans for leg in plan.legs for joint in leg.joints
    }
    missing = [f"{leg} {joint}" for leg, joint in order if (leg, joint) not in known]
    if missing:
        raise ConfigurationError(
            f"the description has no servo for {', '.join(missing)}; give the simulated "
            "robot's own robot.toml, or one with the same legs and joints"
        )
    return tuple(known[pair] for pair in order)


class _OnHorns(Backend):
    """Joints whose angles and speeds, (n,), are read through their horns.

    A joint's angle is ``direction * horn + offset``, as in ``robot.toml``.
    """

    def __init__(self, joints: Sequence[JointPlan], angles: Array, speeds: Array) -> None:
        self._joints, self._angles, self._speeds = joints, angles, speeds

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""
        return self._horn(index, self._angles)

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""
        return self._joints[index].direction * float(self._speeds[index])

    def _horn(self, index: int, angles: Array) -> float:
        joint = self._joints[index]
        return joint.direction * (float(angles[index]) - joint.offset_rad)


class PassiveBackend(_OnHorns):
    """A hexapod on a stand; a backend of virtual servos.

    Args:
        joints: how the servos are mounted.
        height_m: of the body over the floor; by default it is out of reach of the legs.
    """

    def __init__(self, joints: Sequence[JointPlan], *, height_m: float = 1.0) -> None:
        self.plant = Plant(_on_a_stand(height_m), manufactured(0), period_s=STEP_S)
        super().__init__(joints, self.plant.joint_angles, self.plant.joint_speeds)
        self._goal = np.zeros(N_SERVOS)  # stretched out level
        self._on = np.zeros(N_SERVOS, dtype=np.bool_)
        self._start_s: float | None = None
        self.plant.joint_angles[:] = 0.0
        mujoco.mj_forward(self.plant.model, self.plant.data)
        self._written: Array | None = None

    def advance(self, now_s: float) -> float:
        """Bring the robot up to a moment."""
        if self._start_s is None:
            self._start_s = now_s
        behind = int((now_s - self._start_s) / STEP_S) - self.plant.steps
        if behind * STEP_S > LET_GO_S:
            self._start_s += behind * STEP_S
            behind = 0
        for _ in range(min(behind, 5)):  # Steps made at one call: more would keep the bus waiting.
            self._step()
        return float(self._start_s + (self.plant.steps + 1) * STEP_S)

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Write a servo's goal."""
        joint = self._joints[index]
        self._goal[index] = joint.direction * angle_rad + joint.offset_rad

    def set_torque(self, index: int, on: bool) -> None:
        """Switch a servo's drive on or off."""
        self._on[index] = on

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set a servo's compliance slope."""
        self.plant.servos.parameters.slope_steps[index] = slope_rad / QUANTUM_RAD
        self.plant.servos.refresh()

    def _step(self) -> None:
        """Make one physics step; a servo without torque has its goal where it is."""
        plant = self.plant
        target = np.where(self._on, self._goal, plant.joint_angles)
        if self._written is None or not np.array_equal(target, self._written):
            plant.servos.write_goal(target)
            self._written = target
        plant.advance()


def _on_a_stand(height_m: float) -> mujoco.MjModel:
    """The robot with its body fixed over a hard floor."""
    spec = mujoco.MjSpec.from_string(robot_xml())
    spec.delete(spec.joint("body"))
    spec.body("body").pos = [0.0, 0.0, height_m]
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2.0, 2.0, 0.1],
        contype=0,
        conaffinity=1,
        friction=[0.9, 0.005, 0.0001],
        solref=list(HARD_SOLREF),
    )
    return spec.compile()


class MadeTick(NamedTuple):
    """One control tick of a simulation."""

    # angles, speeds: (20, 18) rad and rad/s in the servos' frames, after each physics step
    angles: Array
    speeds: Array
    goals: Array  # (18,) rad, in force from the tick's start on


class ProcessSource:
    """Has ticks made by another process; a context manager.

    Args:
        settings: what is simulated.
        record: MCAP file of its samples and truth.
    """

    def __init__(self, settings: SimulationSettings, record: Path | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process: Any = context.Process(
            target=_make_ticks, args=(theirs, settings, record), name="physics"
        )
        self._process.start()
        theirs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def wait(self) -> None:
        """Wait until the simulation stands, which takes a second or two."""
        self._receive()

    def begin(self, epoch_ns: int) -> None:
        """Ask for the next tick."""
        with contextlib.suppress(BrokenPipeError):  # `receive_tick` reports what has become of it
            self._pipe.send(epoch_ns)

    def receive_tick(self) -> MadeTick:
        """Receive the tick that was asked for."""
        made = self._receive()
        assert isinstance(made, MadeTick)
        return made

    def _receive(self) -> object:
        try:
            got = self._pipe.recv()
        except (EOFError, ConnectionResetError):
            raise SimulationDivergedError(
                "the physics ended unexpectedly; see the lines above, and report them"
            ) from None
        if isinstance(got, Exception):
            raise got
        return got


def _make_ticks(pipe: Connection, settings: SimulationSettings, record: Path | None) -> None:
    """Make ticks as they are asked for; the target of the spawned process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the bus ends us, when it has ended
    _stand_back()
    with ExitStack() as stack:
        try:
            sim = Simulation(settings)
            plant = sim.plant
            angles: list[Array] = []
            speeds: list[Array] = []

            def keep() -> None:
                angles.append(plant.joint_angles + plant.servos.offset_rad)
                speeds.append(plant.joint_speeds.copy())

            plant.on_step = keep
            recorder = None
            if record is not None:
                from adaptive_contact_sim.recorder import TickRecorder

                recorder = stack.enter_context(TickRecorder(record, sim))
            pipe.send("ready")
            while True:
                epoch_ns = pipe.recv()
                sim.settings = dataclasses.replace(sim.settings, epoch_ns=epoch_ns)
                angles.clear()
                speeds.clear()
                tick = sim.tick()
                if recorder is not None:
                    recorder.write(tick)
                pipe.send(MadeTick(np.stack(angles), np.stack(speeds), sim.desired.copy()))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return  # the bus has ended
        except Exception as error:
            with contextlib.suppress(BrokenPipeError):
                pipe.send(error)


def _stand_back() -> None:
    """Let real-time physics never keep the bus from running."""
    if os.sched_getscheduler(0) == os.SCHED_RR:
        first = os.sched_getparam(0).sched_priority
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(max(first - 5, 1)))


class GaitedBackend(_OnHorns):
    """A walking simulation as a set of servos: its own controller writes goals, with torque on.

    Args:
        source: of the simulation's ticks.
        joints: how the servos are mounted.
        period_s: control tick.
    """

    def __init__(
        self, source: ProcessSource, joints: Sequence[JointPlan], *, period_s: float = 0.02
    ) -> None:
        super().__init__(joints, np.zeros(N_SERVOS), np.zeros(N_SERVOS))
        self._source = source
        self._period_s = period_s
        self._made: MadeTick | None = None
        self._start_s, self._epoch_ns = 0.0, 0
        self._tick = 0

    def advance(self, now_s: float) -> float:
        """Bring the robot up to a moment."""
        if self._made is None:
            self._let_begin(now_s)
            self._source.begin(self._epoch_ns)
            self._made = self._source.receive_tick()
            self._source.begin(self._epoch_ns)
        start = self._start_s + self._tick * self._period_s
        if now_s - start > LET_GO_S:
            self._let_begin(now_s)
            start = now_s
        while now_s >= start + self._period_s:
            self._made = self._source.receive_tick()
            self._tick += 1
            start += self._period_s
            self._source.begin(self._epoch_ns)
        at = min(int((now_s - start) / STEP_S), len(self._made.angles) - 1)
        self._angles, self._speeds = self._made.angles[at], self._made.speeds[at]
        return start + self._period_s

    def goal(self, index: int) -> float | None:
        """The goal in force, of the robot's own controller."""
        return self._horn(index, self._angles if self._made is None else self._made.goals)

    def _let_begin(self, now_s: float) -> None:
        """Let the present tick be now, by the monotonic clock and in the time stamps to come."""
        self._start_s = now_s - self._tick * self._period_s
        self._epoch_ns = time.time_ns() - round(self._tick * self._period_s * 1e9)
