"""A simulation's ticks with every physics step kept; made in a process of its own.

In one process the engine and the bus would wait for each other: the interpreter serves one at a
time, and a reading that comes 5 ms late is no reading.

Servos of a robot that walks by itself: a simulation with a controller of its own.

The simulation is the one of ``adaptive-contact sim``, untouched: same settings, same samples and
truth.  Each tick's physics is made a tick ahead and kept step by step, so that a reading at any
moment sees the robot as it is then.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import SimulationDivergedError
from adaptive_contact_sim.simulation import Simulation, SimulationSettings, Tick
from adaptive_contact_sim.virtual.backend import Backend
from adaptive_contact_sim.virtual.horns import LET_GO_S, STEP_S, Horns


class MadeTick(NamedTuple):
    """One control tick of a simulation."""

    # angles, speeds: (20, 18) rad and rad/s in the servos' frames, after each physics step
    angles: Array
    speeds: Array
    goals: Array  # (18,) rad, in force from the tick's start on


class LocalSource:
    """Makes ticks here and now."""

    def __init__(
        self, settings: SimulationSettings, on_tick: Callable[[Tick], None] = lambda _: None
    ) -> None:
        self.sim = Simulation(settings)
        self.on_tick = on_tick
        self._rows: list[tuple[Array, Array]] = []
        plant = self.sim.plant
        plant.on_step = lambda: self._rows.append(
            (plant.joint_angles.copy(), plant.joint_speeds.copy())
        )

    def begin(self, epoch_ns: int) -> None:
        """Take up the time stamp of tick 0; the tick is made when it is taken."""
        if epoch_ns != self.sim.settings.epoch_ns:
            self.sim.settings = dataclasses.replace(self.sim.settings, epoch_ns=epoch_ns)

    def take(self) -> MadeTick:
        """Make the next tick."""
        self._rows.clear()
        self.on_tick(self.sim.tick())
        offset = self.sim.plant.servos.offset_rad
        angles = np.stack([row[0] for row in self._rows]) + offset
        return MadeTick(angles, np.stack([row[1] for row in self._rows]), self.sim.desired.copy())


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
        with contextlib.suppress(BrokenPipeError):  # `take` reports what has become of it
            self._pipe.send(epoch_ns)

    def take(self) -> MadeTick:
        """The tick that was asked for."""
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
            source = LocalSource(settings)
            if record is not None:
                from adaptive_contact_sim.recorder import TickRecorder

                source.on_tick = stack.enter_context(TickRecorder(record, source.sim)).write
            pipe.send("ready")
            while True:
                source.begin(pipe.recv())
                pipe.send(source.take())
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


Source = LocalSource | ProcessSource


class GaitedBackend(Backend):
    """A walking simulation as a set of servos: its own controller writes goals, with torque on.

    Args:
        source: of the simulation's ticks.
        horns: how the servos are mounted.
        period_s: control tick.
    """

    def __init__(self, source: Source, horns: Horns, *, period_s: float = 0.02) -> None:
        self._source = source
        self._horns = horns
        self._period_s = period_s
        self._made: MadeTick | None = None
        self._at = 0
        self._start_s, self._epoch_ns = 0.0, 0
        self._tick = 0

    def advance(self, now_s: float) -> float:
        """Bring the robot up to a moment."""
        if self._made is None:
            self._let_begin(now_s)
            self._source.begin(self._epoch_ns)
            self._made = self._source.take()
            self._source.begin(self._epoch_ns)
        start = self._start_s + self._tick * self._period_s
        if now_s - start > LET_GO_S:
            self._let_begin(now_s)
            start = now_s
        while now_s >= start + self._period_s:
            self._made = self._source.take()
            self._tick += 1
            start += self._period_s
            self._source.begin(self._epoch_ns)
        self._at = min(int((now_s - start) / STEP_S), len(self._made.angles) - 1)
        return start + self._period_s

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""
        made = self._made
        return 0.0 if made is None else self._horns.horn(index, float(made.angles[self._at, index]))

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""
        made = self._made
        if made is None:
            return 0.0
        return float(self._horns.direction[index] * made.speeds[self._at, index])

    def goal(self, index: int) -> float | None:
        """The goal in force, of the robot's own controller."""
        made = self._made
        return self._horns.horn(index, 0.0 if made is None else float(made.goals[index]))

    def _let_begin(self, now_s: float) -> None:
        """Let the present tick be now, by the monotonic clock and in the time stamps to come."""
        self._start_s = now_s - self._tick * self._period_s
        self._epoch_ns = time.time_ns() - round(self._tick * self._period_s * 1e9)
