"""Servos of a robot that walks by itself: a simulation with a controller of its own.

The simulation is the one of ``adaptive-contact sim``, untouched: same settings, same samples and
truth.  Each tick's physics is made a tick ahead and kept step by step, so that a reading at any
moment sees the robot as it is then.
"""

from __future__ import annotations

import time
from typing import Final, Protocol

from adaptive_contact_sim.virtual.horns import Horns
from adaptive_contact_sim.virtual.physics import MadeTick

__all__ = ["GaitedBackend", "Source"]

# Further behind than this, lost time is let go.
_LET_GO_S: Final = 0.5


class Source(Protocol):
    """Where ticks come from; see :mod:`adaptive_contact_sim.virtual.physics`."""

    def begin(self, epoch_ns: int) -> None:
        """Begin to make the next tick, of a run whose tick 0 has this time stamp."""

    def take(self) -> MadeTick:
        """The tick that was begun, when it is made."""


class GaitedBackend:
    """A walking simulation as a set of servos; a backend of virtual servos.

    Args:
        source: of the simulation's ticks.
        horns: how the servos are mounted.
        period_s: control tick.
        step_s: physics step.
    """

    def __init__(
        self, source: Source, horns: Horns, *, period_s: float = 0.02, step_s: float = 0.001
    ) -> None:
        self._source = source
        self._horns = horns
        self._period_s, self._step_s = period_s, step_s
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
        if now_s - start > _LET_GO_S:
            self._let_begin(now_s)
            start = now_s
        while now_s >= start + self._period_s:
            self._made = self._source.take()
            self._tick += 1
            start += self._period_s
            self._source.begin(self._epoch_ns)
        self._at = min(int((now_s - start) / self._step_s), len(self._made.angles) - 1)
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

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Not heard: the robot's own controller writes goals."""

    def goal(self, index: int) -> float | None:
        """The goal in force, of the robot's own controller."""
        made = self._made
        return self._horns.horn(index, 0.0 if made is None else float(made.goals[index]))

    def set_torque(self, index: int, on: bool) -> None:
        """Not heard: the robot's own controller keeps the torque on."""

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Not heard: the servos are the simulation's own."""

    def _let_begin(self, now_s: float) -> None:
        """Let the present tick be now, by the monotonic clock and in the time stamps to come."""
        self._start_s = now_s - self._tick * self._period_s
        self._epoch_ns = time.time_ns() - round(self._tick * self._period_s * 1e9)
