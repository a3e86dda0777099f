"""A light stand-in for the physics behind virtual servos."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact_sim.virtual import Backend


class KinematicBackend(Backend):
    """Servos that run to their goals: exponentially, with a largest speed; no forces, no slope.

    The closed form between two calls makes it as fast as it gets, and exact at any moment.
    """

    _IDLE_S: Final = 0.05
    _tau: Final = 0.03  # time constant, s
    _top: Final = 5.0  # speed, rad/s

    def __init__(self, size: int) -> None:
        self._angle = np.zeros(size)
        self._speed = np.zeros(size)
        self._goal = np.zeros(size)
        self._driven = np.ones(size, dtype=np.bool_)
        self._now: float | None = None

    def advance(self, now_s: float) -> float:
        """Bring the servos up to a moment."""
        if self._now is None:
            self._now = now_s
        elapsed = now_s - self._now
        if elapsed > 0.0:
            self._now = now_s
            off = np.where(self._driven, self._goal - self._angle, 0.0)
            # At full speed as long as the error is beyond top * tau, then exponentially.
            linear = np.clip((np.abs(off) - self._top * self._tau) / self._top, 0.0, elapsed)
            rest = off - np.sign(off) * self._top * linear
            left = rest * np.exp(-(elapsed - linear) / self._tau)
            self._angle = self._angle + off - left
            self._speed = np.clip(left / self._tau, -self._top, self._top)
        return now_s + self._IDLE_S

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""
        return float(self._angle[index])

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""
        return float(self._speed[index])

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Write a servo's goal."""
        if not math.isfinite(angle_rad):
            raise ValueError(f"goal {angle_rad} of servo {index} is not finite")
        self._goal[index] = angle_rad

    def set_torque(self, index: int, on: bool) -> None:
        """Switch a servo's drive on or off."""
        self._driven[index] = on

    def place(self, index: int, angle_rad: float) -> None:
        """Put a servo somewhere, at rest, goal included."""
        self._angle[index] = self._goal[index] = angle_rad
        self._speed[index] = 0.0
