"""Servos of a robot that walks by itself: a simulation with a controller of its own.

The simulation is the one of ``adaptive-contact sim``, untouched: same settings, same samples and
truth.  Each tick's physics is made a tick ahead and kept step by step, so that a reading at any
moment sees the robot as it is then.  It is made on another thread: the engine lets go of the
interpreter in every step, and the bus is answered in between.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact_sim.elements import N_SERVOS
from adaptive_contact_sim.simulation import Simulation, Tick
from adaptive_contact_sim.virtual.horns import Horns

__all__ = ["GaitedBackend"]

Array = NDArray[np.float64]

# Further behind than this, lost time is let go.
_LET_GO_S: Final = 0.5


class GaitedBackend:
    """A walking simulation as a set of servos; a backend of virtual servos.

    Args:
        sim: what walks; its time stamps begin now.
        horns: how the servos are mounted.
        on_tick: gets every tick, when its moment has come.
    """

    def __init__(
        self, sim: Simulation, horns: Horns, on_tick: Callable[[Tick], None] = lambda _: None
    ) -> None:
        self.sim = sim
        self._horns = horns
        self._on_tick = on_tick
        self._period_s = sim.settings.period_s
        self._step_s = sim.plant.step_s
        n = sim.plant.substeps
        self._angles = [np.zeros((n, N_SERVOS)) for _ in range(2)]  # of this tick, of the next
        self._speeds = [np.zeros((n, N_SERVOS)) for _ in range(2)]
        self._goals = [np.zeros(N_SERVOS) for _ in range(2)]
        self._maker = ThreadPoolExecutor(1, "physics", initializer=_stand_back)
        self._made: Future[Tick] | None = None
        self._row = 0
        self._at = 0
        self._start_s: float | None = None
        self._tick = 0
        self._watch()

    def advance(self, now_s: float) -> float:
        """Bring the robot up to a moment."""
        if self._start_s is None:
            self._begin(now_s, 0)
            self._make()
            self._next()
            self._tick = 0
        assert self._start_s is not None
        start = self._start_s + self._tick * self._period_s
        if now_s - start > _LET_GO_S:
            self._begin(now_s, self._tick)
            start = now_s
        while now_s >= start + self._period_s:
            self._next()
            start += self._period_s
        self._at = min(int((now_s - start) / self._step_s), len(self._angles[0]) - 1)
        return start + self._period_s

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""
        offset = self.sim.plant.servos.offset_rad[index]
        return self._horns.horn(index, float(self._angles[0][self._at, index] + offset))

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""
        return float(self._horns.direction[index] * self._speeds[0][self._at, index])

    def set_goal(self, index: int, angle_rad: float) -> None:
        """The robot's own controller writes goals, twice as often as anybody else could."""

    def goal(self, index: int) -> float | None:
        """The goal in force, of the robot's own controller."""
        return self._horns.horn(index, float(self._goals[0][index]))

    def set_torque(self, index: int, on: bool) -> None:
        """The robot's own controller keeps the torque on."""

    # -- private -------------------------------------------------------------------------------

    def _begin(self, now_s: float, tick: int) -> None:
        """Let a tick be now, by the monotonic clock and in the time stamps."""
        self._start_s = now_s - tick * self._period_s
        epoch_ns = time.time_ns() - round(tick * self._period_s * 1e9)
        self.sim.settings = dataclasses.replace(self.sim.settings, epoch_ns=epoch_ns)

    def _watch(self) -> None:
        """Keep the joints' state after every physics step."""
        plant = self.sim.plant
        rub = plant.servos.rub

        def after_step() -> None:
            rub()
            self._angles[1][self._row] = plant.joint_angles
            self._speeds[1][self._row] = plant.joint_speeds
            self._row += 1

        plant.servos.rub = after_step  # type: ignore[method-assign]

    def _make(self) -> None:
        """Begin to make the next tick."""
        self._row = 0
        self._made = self._maker.submit(self.sim.tick)

    def _next(self) -> None:
        """Let the next tick be this one."""
        assert self._made is not None
        tick = self._made.result()
        self._goals[1][:] = self.sim.desired
        for pair in (self._angles, self._speeds, self._goals):
            pair.reverse()
        self._tick += 1
        self._on_tick(tick)
        self._make()


def _stand_back() -> None:
    """Let a real-time physics thread never keep the bus from running."""
    if os.sched_getscheduler(0) == os.SCHED_RR:
        first = os.sched_getparam(0).sched_priority
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(max(first - 5, 1)))
