r"""The legs' geometry as one block of arrays, for controllers.

Lengths, mounts and limits come from the shipped ``robot.toml``.  A controller never sees the
engine's state through this.  :class:`LegGeometry` is the hexapod's, with the closed forms of
:mod:`adaptive_contact.robot`.  :class:`ChainLegs` takes any chains: with the Jacobian :math:`J` at
the foot and the error :math:`e`, it steps by

.. math:: \delta q = r + J^T (J J^T + \lambda^2 I)^{-1} (e - J r)

where :math:`r` leads back to the posture at rest, which joints beyond three are free to follow.

Reference:
    C. Wampler, Manipulator inverse kinematic solutions based on damped least squares, IEEE SMC
    16(1), 1986.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.robot import Robot, foot, inverse, shipped_robot
from adaptive_contact_sim.elements import LEGS

# How near to the rim of its reach a foot is ever sent, m.
_REACH_MARGIN_M = 0.002
# Damped least squares: the largest step; when it is done, and when it is given up.
_STEP_RAD: Final = 0.4
_EXACT_M: Final = 1e-6


class _Mounted:
    """Where legs sit on the body, and what a controller asks of them besides their reach."""

    def __init__(self, robot: Robot) -> None:
        # (L, 3) m, where the legs' first joints are in the body's frame
        self.mounts_m = np.array([leg.mount.xyz_m for leg in robot.legs])
        yaw = np.array([leg.mount.yaw_rad for leg in robot.legs])
        self.rotations = np.zeros((len(yaw), 3, 3))  # from a leg's frame to the body's
        self.rotations[:, 0, 0] = self.rotations[:, 1, 1] = np.cos(yaw)
        self.rotations[:, 1, 0] = np.sin(yaw)
        self.rotations[:, 0, 1] = -np.sin(yaw)
        self.rotations[:, 2, 2] = 1.0

    def to_leg(self, points_m: Array) -> Array:
        """From the body's frame to the legs': (L, 3) m, one point per leg."""
        offset = points_m - self.mounts_m
        return np.asarray(np.matmul(offset[:, None, :], self.rotations)[:, 0, :])

    def to_body(self, points_m: Array) -> Array:
        """From the legs' frames to the body's: (L, 3) m, one point per leg."""
        turned = np.matmul(self.rotations, points_m[:, :, None])[:, :, 0]
        return np.asarray(turned + self.mounts_m)


class LegGeometry(_Mounted):
    """Geometry of the hexapod's six equal legs.

    Args:
        robot: its description, the shipped hexapod's by default.
    """

    def __init__(self, robot: Robot | None = None) -> None:
        robot = robot or shipped_robot()
        first = robot.legs[0]
        assert first.lengths_m is not None
        assert first.limits is not None
        super().__init__(robot)
        self.lengths_m = first.lengths_m  # coxa, femur, tibia
        _, l1, l2 = first.lengths_m
        self.lower_rad = np.array(first.limits.lower_rad)
        self.upper_rad = np.array(first.limits.upper_rad)
        # Foot from femur axis, as the tibia's limit and length allow.
        nearest = np.sqrt(l1**2 + l2**2 + 2 * l1 * l2 * np.cos(self.lower_rad[2]))
        self.nearest_m = float(nearest) + _REACH_MARGIN_M
        self.farthest_m = l1 + l2 - _REACH_MARGIN_M
        # Hexapod: neutral feet from the body's centre, as turning moves them.
        self.outer_foot_m = 0.22
        # Hexapod: a foot of a robot in pose, under its knee.
        self.standing_m = np.array((0.115, 0.0, -0.165))
        self.middle_rad = self.joints(self.standing_m)

    def neutral(self, reach_m: float, height_m: float) -> Array:
        """(6, 3) m in the legs' frames: feet so far from their coxa axes, the body so high."""
        return np.tile([reach_m, 0.0, -height_m], (len(LEGS), 1))

    def reachable(self, points_m: Array) -> Mask:
        """Return which foot points (..., 3) m in the leg's frame lie within reach and limits."""
        joints = inverse(points_m, self.lengths_m)
        with np.errstate(invalid="ignore"):
            inside = (joints >= self.lower_rad) & (joints <= self.upper_rad)
        return np.asarray(inside.all(axis=-1))

    def joints(
        self, points_m: Array, near_rad: Array | None = None, rest_rad: Array | None = None
    ) -> Array:
        """Joint angles for foot points, (..., 3) each; a closed form, of the points only."""
        l0 = self.lengths_m[0]
        x, y, z = points_m[..., 0], points_m[..., 1], points_m[..., 2]
        flat = np.hypot(x, y)
        radial = flat - l0
        distance = np.hypot(radial, z)
        scale = np.clip(distance, self.nearest_m, self.farthest_m) / np.maximum(distance, 1e-9)
        pulled = np.empty_like(points_m)
        turn = (l0 + radial * scale) / np.maximum(flat, 1e-9)
        pulled[..., 0] = x * turn
        pulled[..., 1] = y * turn
        pulled[..., 2] = z * scale
        return np.clip(inverse(pulled, self.lengths_m), self.lower_rad, self.upper_rad)

    def feet(self, joints_rad: Array) -> Array:
        """Foot points (..., 3) m in the legs' frames for joint angles (..., 3) rad."""
        return foot(joints_rad, self.lengths_m, ("yaw", "pitch", "pitch"))


class ChainLegs(_Mounted):
    """Geometry of legs that are any chains, each its own.

    Args:
        robot: their description, with a chain and limits of every leg.
        rest_rad: (L, J) a posture in the middle of what they do: it chooses between the solutions
            of a knee, and of joints beyond three.
    """

    def __init__(self, robot: Robot, rest_rad: Array) -> None:
        chains = [leg.chain for leg in robot.legs if leg.chain is not None]
        limits = [leg.limits for leg in robot.legs if leg.limits is not None]
        super().__init__(robot)
        self.rest_rad = np.asarray(rest_rad, dtype=np.float64)
        self.lower_rad = np.array([limit.lower_rad for limit in limits])
        self.upper_rad = np.array([limit.upper_rad for limit in limits])
        self._axes = np.array([chain.vectors for chain in chains])
        self._origins = np.array([chain.origins_m for chain in chains])
        self._redundant = self._axes.shape[1] > 3
        feet = self.feet(self.rest_rad)
        self.standing_m = feet[0]
        self.middle_rad = self.rest_rad[0]
        on_body = self.to_body(feet)
        self.outer_foot_m = float(np.hypot(on_body[:, 0], on_body[:, 1]).max())

    def neutral(self, reach_m: float, height_m: float) -> Array:
        """(L, 3) m in the legs' frames: feet so far beside their first joint, the body so high."""
        feet = self.feet(self.rest_rad)
        side = np.where(feet[:, 1] < 0.0, -1.0, 1.0)
        return np.stack([np.zeros(len(side)), side * reach_m, np.full(len(side), -height_m)], 1)

    def reachable(self, points_m: Array) -> Mask:
        """Return which foot points (..., 3) m in the leg's frame lie within reach and limits."""
        off = np.linalg.norm(self.feet(self.joints(points_m)) - points_m, axis=-1)
        return np.asarray(off < 1e-3)

    def joints(
        self, points_m: Array, near_rad: Array | None = None, rest_rad: Array | None = None
    ) -> Array:
        """(..., J) rad for foot points (..., 3) m, as near as a posture within the limits comes.

        Args:
            points_m: one per leg, or any number where all legs are alike.
            near_rad: a posture not far from it, where one is known: it saves time.
            rest_rad: what joints beyond three follow instead of the posture at rest.
        """
        rest = self.rest_rad if rest_rad is None else rest_rad
        shape = np.broadcast_shapes(points_m.shape[:-1], rest.shape[:-1])
        start = rest if near_rad is None else near_rad
        q = np.broadcast_to(start, (*shape, rest.shape[-1])).copy()
        damping = 1e-3**2 * np.eye(3)
        for _ in range(30):
            foot, jacobian = self._linearized(q)
            error = points_m - foot
            back = np.zeros_like(q)
            if self._redundant:
                back = 0.3 * (rest - q)
            elif float(np.abs(error).max()) < _EXACT_M:
                break
            error = error - np.matmul(jacobian, back[..., None])[..., 0]
            across = np.swapaxes(jacobian, -1, -2)
            force = np.linalg.solve(np.matmul(jacobian, across) + damping, error[..., None])
            step = back + np.matmul(across, force)[..., 0]
            q = np.clip(q + np.clip(step, -_STEP_RAD, _STEP_RAD), self.lower_rad, self.upper_rad)
            if float(np.abs(step).max()) < _EXACT_M:
                break
        return q

    def feet(self, joints_rad: Array) -> Array:
        """Foot points (..., 3) m in the legs' frames for joint angles (..., J) rad."""
        return self._linearized(joints_rad)[0]

    def _linearized(self, q: Array) -> tuple[Array, Array]:
        """The foot (..., 3) m, and its Jacobian (..., 3, J) m per rad."""
        turn: Array = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
        place = np.zeros((*q.shape[:-1], 3))
        places, axes = [], []
        for i in range(q.shape[-1]):
            axis = self._axes[..., i, :]
            places.append(place)
            axes.append(np.matmul(turn, axis[..., None])[..., 0])
            turn = np.matmul(turn, _rotation(axis, q[..., i]))
            place = place + np.matmul(turn, self._origins[..., i, :, None])[..., 0]
        arms = place[..., None, :] - np.stack(places, axis=-2)
        return place, np.swapaxes(np.cross(np.stack(axes, axis=-2), arms), -1, -2)


# What a controller knows of its legs: where they sit on the body, and how they reach.
Geometry: TypeAlias = LegGeometry | ChainLegs


def _rotation(axis: Array, angle: Array) -> Array:
    """(..., 3, 3), a turn by (...) rad about (..., 3) unit vectors (Rodrigues)."""
    axis = np.broadcast_to(axis, (*angle.shape, 3))
    cross = np.zeros((*angle.shape, 3, 3))
    cross[..., 0, 1], cross[..., 0, 2] = -axis[..., 2], axis[..., 1]
    cross[..., 1, 0], cross[..., 1, 2] = axis[..., 2], -axis[..., 0]
    cross[..., 2, 0], cross[..., 2, 1] = -axis[..., 1], axis[..., 0]
    sin, cos = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.asarray(np.eye(3) + sin * cross + (1.0 - cos) * np.matmul(cross, cross))
