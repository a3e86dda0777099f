"""Gaits: what the legs are told, tick by tick, and when they are told to stop.

A foot's way is lift, transfer and descent, of half cosines; other ways than those of
:mod:`adaptive_contact_sim.gait`.  A descent aims ``below_m`` under the ground.  It stops
``react_s`` after a touch, as a controller with contacts would, or goes on to its end.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final, Literal

import numba
import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.robot import Chain
from adaptive_contact_bullet.robots import Shape

_LIFTED: Final = 0.35  # share of a swing after which the foot is up
_DOWN: Final = 0.55  # share after which it comes down
_LARGEST_RAD: Final = 0.3  # step of one iteration


Stop = Literal["touch", "never"]


@dataclasses.dataclass(frozen=True)
class Gait:
    """One way to walk, or to swing on the spot."""

    name: str
    offsets: tuple[float, ...]  # clock of each leg, of 1
    cycle_s: float
    duty: float  # share of the cycle in stance
    step_m: float
    height_m: float
    below_m: float  # of the ground, that a descent aims at
    stop: Stop = "touch"
    react_s: float = 0.08
    linger_s: float = 0.0  # that a swing waits for its touch after the command has ended
    scatter_m: float = 0.012  # of targets, and of step and height


class Inverse:
    """Finds joint angles for feet by damped least squares, from where the joints are.

    Args:
        chain: of the leg.
        angles: (J,) rad, to begin with.
    """

    def __init__(self, chain: Chain, angles: Array) -> None:
        self._axes, self._links = chain.vectors, np.array(chain.origins_m)
        self._rest, self.angles = angles.copy(), angles.copy()

    def to(self, foot_m: Array) -> Array:
        """Angles (J,) rad that bring the foot to a point of the leg's frame, (3,) m, or near it."""
        for _ in range(3):
            place, jacobian = _forward(self._axes, self._links, self.angles)
            square = jacobian.T @ jacobian + 1e-4 * np.eye(len(self.angles))  # m²
            back = 1e-6 * (self._rest - self.angles)  # m², where joints are more than a foot needs
            step = np.linalg.solve(square, jacobian.T @ (foot_m - place) + back)
            self.angles = self.angles + np.clip(step, -_LARGEST_RAD, _LARGEST_RAD)
        return self.angles


@numba.njit
def _forward(axes, links, angles):  # type: ignore[no-untyped-def]
    """Foot (3,) m and its Jacobian (3, J), built from the tip inwards."""
    joints = len(angles)
    jacobian = np.zeros((3, joints))
    x = y = z = 0.0
    for i in range(joints - 1, -1, -1):
        a, b, c = axes[i]
        x, y, z = x + links[i, 0], y + links[i, 1], z + links[i, 2]
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = b * z - c * y, c * x - a * z, a * y - b * x
        cos, sin = math.cos(angles[i]), math.sin(angles[i])
        for k in range(i, joints):
            u, v, w = jacobian[0, k], jacobian[1, k], jacobian[2, k]
            along = (a * u + b * v + c * w) * (1.0 - cos)
            jacobian[0, k] = u * cos + (b * w - c * v) * sin + a * along
            jacobian[1, k] = v * cos + (c * u - a * w) * sin + b * along
            jacobian[2, k] = w * cos + (a * v - b * u) * sin + c * along
        along = (a * x + b * y + c * z) * (1.0 - cos)
        x, y, z = (
            x * cos + (b * z - c * y) * sin + a * along,
            y * cos + (c * x - a * z) * sin + b * along,
            z * cos + (a * y - b * x) * sin + c * along,
        )
    return np.array([x, y, z]), jacobian


class Walker:
    """Commands of all legs.

    Args:
        shape: the robot.
        gait: how it walks.
        rng: of steps, heights and targets.
        ground_m: height of the ground in a leg's frame; that of the feet at rest by default.
    """

    def __init__(
        self, shape: Shape, gait: Gait, rng: np.random.Generator, ground_m: float | None = None
    ) -> None:
        self._shape, self._gait, self._rng = shape, gait, rng
        robot = shape.description
        chains = [robot.leg(leg.id).chain for leg in shape.legs]
        self._inverse = [
            Inverse(chain, np.array(leg.rest_rad))
            for chain, leg in zip(chains, shape.legs, strict=True)
            if chain is not None
        ]
        self._home = np.array(
            [
                chain.foot(np.array(leg.rest_rad))
                for chain, leg in zip(chains, shape.legs, strict=True)
                if chain
            ]
        )
        if ground_m is not None:
            self._home[:, 2] = ground_m
        n = len(shape.legs)
        self.foot = self._home.copy()  # (L, 3) m, commanded, in the legs' frames
        self.swing: Mask = np.zeros(n, dtype=bool)
        self._from, self._to = self._home.copy(), self._home.copy()
        self._top = np.zeros(n)
        self._reached = np.full(n, math.inf)  # s since the touch of this swing
        self._before = np.array(gait.offsets)  # clocks
        self._step = np.zeros((n, 3))
        turn = np.array([leg.yaw_rad for leg in shape.legs])
        self._forward = np.stack([np.cos(turn), -np.sin(turn), np.zeros(n)], axis=1)
        self.began: Mask = np.zeros(n, dtype=bool)  # a swing began in the last tick
        self.down: Mask = np.zeros(n, dtype=bool)  # the descent has begun

    @property
    def targets_m(self) -> Array:
        """(L, 3) where the present swings go, in the legs' frames."""
        return self._to

    def tick(self, touching: Mask) -> Array:
        """Advance by a control tick; (L J,) rad to be commanded.

        Args:
            touching: (L,) of each leg, whether its foot touches.
        """
        gait, dt = self._gait, self._shape.period_s
        clock = (self._before + dt / gait.cycle_s) % 1.0
        swung_s = (1.0 - gait.duty) * gait.cycle_s
        self.began[:] = False
        for i in range(len(clock)):
            starts = clock[i] >= gait.duty and self._before[i] < gait.duty
            if starts:
                self._begin(i)
            if self.swing[i]:
                over = clock[i] < gait.duty
                x = 1.0 if over else (clock[i] - gait.duty) / (1.0 - gait.duty)
                self.down[i] = x > _DOWN
                # A foot that is down ends its swing where it is; one in the lift still stands.
                if gait.stop == "touch" and touching[i] and x > _LIFTED:
                    self._reached[i] = min(self._reached[i], 0.0)
                self._reached[i] += dt
                waited = over and clock[i] * gait.cycle_s >= gait.linger_s
                if waited or gait.react_s <= self._reached[i] < math.inf:
                    self.swing[i] = False
                else:
                    self._swing(i, x)
            if not self.swing[i]:
                self.foot[i] -= self._step[i] * dt / (gait.cycle_s - swung_s)
                # A stance that began too high or low returns to the body's height.
                self.foot[i, 2] += (self._home[i, 2] - self.foot[i, 2]) * dt / 0.5
        self._before = clock
        return np.concatenate(
            [inverse.to(f) for inverse, f in zip(self._inverse, self.foot, strict=True)]
        )

    def _begin(self, i: int) -> None:
        gait, rng = self._gait, self._rng
        self.swing[i] = self.began[i] = True
        self._reached[i] = math.inf
        self._from[i] = self.foot[i]
        self._step[i] = self._forward[i] * gait.step_m * rng.uniform(0.7, 1.2)
        self._to[i] = self._home[i] + self._step[i] / 2.0
        self._to[i, :2] += rng.normal(0.0, gait.scatter_m, 2)
        self._to[i, 2] = self._home[i, 2] - gait.below_m
        self._top[i] = max(self._from[i, 2], self._home[i, 2]) + gait.height_m * rng.uniform(
            0.7, 1.3
        )

    def _swing(self, i: int, x: float) -> None:
        def half(at: float) -> float:
            return 0.5 - 0.5 * math.cos(math.pi * min(max(at, 0.0), 1.0))

        along = half((x - 0.15) / 0.65)
        self.foot[i, :2] = self._from[i, :2] + along * (self._to[i, :2] - self._from[i, :2])
        up = self._from[i, 2] + half(x / _LIFTED) * (self._top[i] - self._from[i, 2])
        self.foot[i, 2] = up + half((x - _DOWN) / (1.0 - _DOWN)) * (self._to[i, 2] - self._top[i])


_TRIPOD: Final = (0.0, 0.5, 0.0, 0.5, 0.0, 0.5)  # lf lm lr rf rm rr
_TROT: Final = (0.0, 0.5, 0.5, 0.0)  # fl fr bl br
GAITS: Final = {
    gait.name: gait
    for gait in (
        Gait("tripod", _TRIPOD, 1.2, 0.52, 0.06, 0.04, 0.03),
        Gait("tripod-slow", _TRIPOD, 2.4, 0.52, 0.06, 0.04, 0.03),
        Gait("tripod-fast", _TRIPOD, 0.84, 0.52, 0.06, 0.035, 0.03),
        Gait("ripple", (0.0, 0.333, 0.667, 0.5, 0.833, 0.167), 2.0, 0.68, 0.05, 0.04, 0.03),
        Gait("tripod-planned", _TRIPOD, 1.2, 0.52, 0.06, 0.04, 0.004, "never"),
        Gait("trot", _TROT, 0.45, 0.52, 0.04, 0.03, 0.015, linger_s=0.08),
        Gait("trot-slow", _TROT, 0.6, 0.52, 0.04, 0.04, 0.015, linger_s=0.08),
        Gait("trot-planned", _TROT, 0.45, 0.52, 0.04, 0.03, 0.003, "never"),
        Gait("steps", (0.0,), 1.2, 0.3, 0.07, 0.06, 0.03),
        Gait("steps-slow", (0.0,), 2.4, 0.3, 0.07, 0.06, 0.03),
    )
}
