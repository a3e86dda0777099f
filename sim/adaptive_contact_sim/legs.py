"""The six legs' geometry as one block of arrays, for controllers.

Lengths, mounts and limits come from the shipped ``robot.toml``; forward and inverse kinematics are
those of :mod:`adaptive_contact.robot`.  A controller never sees the engine's state through this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Robot, foot, inverse, shipped_robot
from adaptive_contact_sim.elements import JOINTS, LEGS

__all__ = ["LegGeometry"]

Array = NDArray[np.float64]

# How near to the rim of its reach a foot is ever sent, m.
_REACH_MARGIN_M = 0.002


@dataclass(frozen=True, eq=False)
class LegGeometry:
    """Geometry of six equal legs.

    Attributes:
        lengths_m: coxa, femur, tibia.
        mounts_m: (6, 3) of the coxa axes in the body's frame.
        rotations: (6, 3, 3) from a leg's frame to the body's.
        lower_rad, upper_rad: (3,) joint limits.
        nearest_m, farthest_m: foot from femur axis, as the tibia's limit and length allow.
    """

    lengths_m: tuple[float, float, float]
    mounts_m: Array
    rotations: Array
    lower_rad: Array
    upper_rad: Array
    nearest_m: float
    farthest_m: float

    @classmethod
    def of(cls, robot: Robot | None = None) -> LegGeometry:
        """Take the geometry from a robot description, the shipped hexapod's by default.

        Raises:
            ConfigurationError: the description does not fit the simulated robot.
        """
        robot = robot or shipped_robot()
        if robot.leg_ids != LEGS:
            raise ConfigurationError(
                f"robot '{robot.name}' has legs {', '.join(robot.leg_ids)}; the simulated robot "
                f"has {', '.join(LEGS)}"
            )
        first = robot.leg(LEGS[0])
        if first.lengths_m is None or first.limits is None or first.joints != JOINTS:
            raise ConfigurationError(
                f"robot '{robot.name}' lacks lengths_m or limits, or its joints are not "
                f"{', '.join(JOINTS)}; give them for the simulator"
            )
        l0, l1, l2 = first.lengths_m
        yaw = np.array([robot.leg(leg).mount.yaw_rad for leg in LEGS])
        rotations = np.zeros((len(LEGS), 3, 3))
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
        rotations[:, 1, 0] = np.sin(yaw)
        rotations[:, 0, 1] = -np.sin(yaw)
        rotations[:, 2, 2] = 1.0
        lower = np.array(first.limits.lower_rad)
        upper = np.array(first.limits.upper_rad)
        nearest = np.sqrt(l1**2 + l2**2 + 2 * l1 * l2 * np.cos(lower[2]))
        return cls(
            lengths_m=(l0, l1, l2),
            mounts_m=np.array([robot.leg(leg).mount.xyz_m for leg in LEGS]),
            rotations=rotations,
            lower_rad=lower,
            upper_rad=upper,
            nearest_m=float(nearest) + _REACH_MARGIN_M,
            farthest_m=l1 + l2 - _REACH_MARGIN_M,
        )

    def reachable(self, points_m: Array) -> NDArray[np.bool_]:
        """Tell which foot points (..., 3) m in the leg's frame lie within reach and limits."""
        joints = inverse(points_m, self.lengths_m)
        with np.errstate(invalid="ignore"):
            inside = (joints >= self.lower_rad) & (joints <= self.upper_rad)
        return np.asarray(inside.all(axis=-1))

    def joints(self, points_m: Array) -> Array:
        """Joint angles for foot points, the nearest that can be reached.

        Args:
            points_m: (..., 3) m in the legs' frames.

        Returns:
            (..., 3) rad, within limits.
        """
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

    def to_leg(self, points_m: Array) -> Array:
        """From the body's frame to the legs': (6, 3) m, one point per leg."""
        offset = points_m - self.mounts_m
        return np.asarray(np.matmul(offset[:, None, :], self.rotations)[:, 0, :])

    def to_body(self, points_m: Array) -> Array:
        """From the legs' frames to the body's: (6, 3) m, one point per leg."""
        turned = np.matmul(self.rotations, points_m[:, :, None])[:, :, 0]
        return np.asarray(turned + self.mounts_m)
