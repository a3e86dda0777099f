r"""Computes the geometry of a leg: a chain of joints, each with an axis and an origin.

Angles :math:`q` (J,) rad; the leg's frame has x along its zero direction, z up.  With all angles 0,
joint i turns about the unit vector :math:`a_i`, and :math:`o_i` leads from it to the next joint,
the last one to the foot, both in the leg's frame.  With :math:`R_i = \exp(a_i^\times q_i)` the foot
is at

.. math:: p = R_1 (o_1 + R_2 (o_2 + \dots + R_J o_J))

and a joint raises it by

.. math:: \partial z/\partial q_i = e_z \cdot R_1 \cdots R_i (a_i \times s_i)

where :math:`s_i = o_i + R_{i+1} (\dots)` leads from joint i to the foot.

A straight leg is the usual case: yaws, then pitches, with links of lengths :math:`l_i` along x.
Its pitches add to the absolute link angles :math:`\phi_i`, and the foot is at
:math:`r = \sum_i l_i \cos\phi_i`, :math:`z = \sum_i l_i \sin\phi_i`.  For the three-joint leg (yaw,
pitch, pitch), the coxa-femur-tibia chain, :func:`inverse` has a closed form.

Reference:
    K. Lynch, F. Park, *Modern Robotics*, 4.1 (product of exponentials).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

from adaptive_contact.arrays import Array, ArrayLike, Mask, np
from adaptive_contact.errors import ConfigurationError

Vector = tuple[float, float, float]

# What the words mean.  A pitch raises a link that points along x: a turn about -y.
AXES: Final[dict[str, Vector]] = {
    "roll": (1.0, 0.0, 0.0),
    "pitch": (0.0, -1.0, 0.0),
    "yaw": (0.0, 0.0, 1.0),
}


def axis_text(axis: str | Vector) -> str:
    """Format an axis as text: its word, or ``0 0.5 0.87``."""
    return axis if isinstance(axis, str) else " ".join(f"{x:.3g}" for x in axis)


def yaws_then_pitches(axes: Sequence[str | Vector]) -> bool:
    """Return whether all yaws come before all pitches, and there is nothing else."""
    kinds = [axis if isinstance(axis, str) else "" for axis in axes]
    yaws = kinds.count("yaw")
    return all(kind == "yaw" for kind in kinds[:yaws]) and all(
        kind == "pitch" for kind in kinds[yaws:]
    )


@dataclasses.dataclass(frozen=True)
class Chain:
    """Describes the geometry of one leg."""

    # (J,) a word of `AXES`, or a unit vector of the leg's frame, with all angles 0
    axes: tuple[str | Vector, ...]
    # (J,) m from each joint to the next, the last to the foot's tip, likewise
    origins_m: tuple[Vector, ...]

    @cached_property
    def is_straight(self) -> bool:
        """Return whether it consists of yaws, then pitches, with all links along x."""
        return yaws_then_pitches(self.axes) and not any(y or z for _, y, z in self.origins_m)

    @cached_property
    def vectors(self) -> Array:
        """Return the axes as vectors, (J, 3)."""
        return np.array(self.axis_vectors)

    @cached_property
    def reach_m(self) -> float:
        """Return the sum of the links' lengths, m: no foot is further from its first joint."""
        return sum(math.hypot(*origin) for origin in self.origins_m)

    @cached_property
    def size(self) -> float:
        """Return the reach over a hexapod leg's; limits in m scale with it."""
        # Reach of the leg on which limits of lengths were measured: the PhantomX-class hexapod's.
        return self.reach_m / 0.256

    @cached_property
    def raises_foot(self) -> bool:
        """Return whether any joint can raise the foot in any posture; computed without numpy."""
        return any(self._raising)

    @cached_property
    def lifts(self) -> Mask:
        """Return whether each joint, (J,), can raise the foot at all; a yaw on top cannot."""
        return np.array(self._raising)

    @cached_property
    def _raising(self) -> tuple[bool, ...]:
        joints = range(len(self.axes))
        # Multiples of irrational steps: spread over all postures, the same each time.  No joint is
        # at a singularity in all of them.
        postures = [[k * math.sqrt(2 + j) for j in joints] for k in range(1, 17)]

        def raises(joint: int, q: list[float]) -> bool:
            turned = [*q]
            turned[joint] += 1.0
            # One that raises the foot by less than this share of the leg's reach does not.
            return abs(self.point(turned)[2] - self.point(q)[2]) > 1e-9 * self.reach_m

        return tuple(any(raises(joint, q) for q in postures) for joint in joints)

    def foot(self, q: ArrayLike) -> Array:
        """Compute the foot's position in the leg's frame, (..., J) rad to (..., 3) m."""
        angles = np.asarray(q, dtype=np.float64)
        columns = [*np.moveaxis(angles, -1, 0)]
        return np.asarray(np.stack(self._tip(columns, np.cos, np.sin), axis=-1))

    def point(self, q: Sequence[float]) -> Vector:
        """Compute the foot's position in one posture, m, equal to ``foot(q)``.

        Plain floats; for so few of them numpy's call overhead is twenty times the arithmetic.
        """
        x, y, z = self._tip(q, math.cos, math.sin)
        return x, y, z

    def _tip(self, q: Sequence[Any], cosine: Any, sine: Any) -> list[Any]:
        """Turn the way to the foot about one joint after the other, from the foot inwards."""
        x = y = z = 0.0 * q[0]
        for angle, origin, (a, b, c) in zip(
            reversed(q), reversed(self.origins_m), reversed(self.axis_vectors), strict=True
        ):
            cos, sin = cosine(angle), sine(angle)
            x, y, z = x + origin[0], y + origin[1], z + origin[2]
            along = (a * x + b * y + c * z) * (1.0 - cos)
            x, y, z = (
                x * cos + (b * z - c * y) * sin + a * along,
                y * cos + (c * x - a * z) * sin + b * along,
                z * cos + (a * y - b * x) * sin + c * along,
            )
        return [x, y, z]

    @cached_property
    def axis_vectors(self) -> tuple[Vector, ...]:
        """Return the axes as vectors of plain floats, (J,)."""
        return tuple(AXES[axis] if isinstance(axis, str) else axis for axis in self.axes)

    def frames(self, q: ArrayLike) -> tuple[Array, Array]:
        """Compute the joints' positions and directions in the leg's frame.

        Args:
            q: (..., J) rad.

        Returns:
            (..., J + 1, 3) m, the joints and the foot; (..., J, 3), the axes as they stand.
        """
        angles = np.asarray(q, dtype=np.float64)
        turn = np.eye(3)
        points, axes = [np.zeros((*angles.shape[:-1], 3))], []
        for i, axis in enumerate(self.vectors):
            axes.append(np.broadcast_to(turn @ axis, points[0].shape))
            turn = turn @ rotation(axis, angles[..., i])
            points.append(points[-1] + turn @ np.array(self.origins_m[i]))
        return np.stack(points, axis=-2), np.stack(axes, axis=-2)


def straight(lengths_m: Sequence[float], axes: Sequence[str | Vector]) -> Chain:
    """Make the chain of links that lie along x with all angles 0.

    Args:
        lengths_m: (J,) m from the body outwards.
        axes: (J,) of each joint.
    """
    return Chain(tuple(axes), tuple((float(length), 0.0, 0.0) for length in lengths_m))


def foot(q: ArrayLike, lengths_m: Sequence[float], axes: Sequence[str | Vector]) -> Array:
    """Compute the foot of a :func:`straight` chain, (..., J) rad to (..., 3) m."""
    return straight(lengths_m, axes).foot(q)


def rotation(axis: ArrayLike, angles: ArrayLike) -> Array:
    """Return the matrices, (..., 3, 3), that turn about a unit vector by (...) rad (Rodrigues)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.asarray(angles, dtype=np.float64)[..., None, None]
    turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return np.asarray(turn)


def inverse(point_m: ArrayLike, lengths_m: Sequence[float]) -> Array:
    """Compute joint angles that put a yaw-pitch-pitch leg's foot at a point, knee up.

    Args:
        point_m: (..., 3) m in the leg's frame.
        lengths_m: (3,) m.

    Returns:
        (..., 3) rad; NaN rows where the point is out of reach.

    Raises:
        ConfigurationError: the leg has not three links.

    Reference:
        Law of cosines on the femur-tibia triangle, e.g. Siciliano et al., *Robotics*, 2.12.
    """
    if len(lengths_m) != 3:
        raise ConfigurationError(
            f"closed-form inverse kinematics needs 3 links, found {len(lengths_m)}"
        )
    l0, l1, l2 = lengths_m
    point = np.asarray(point_m, dtype=np.float64)
    x, y, z = point[..., 0], point[..., 1], point[..., 2]
    radial = np.hypot(x, y) - l0
    distance2 = radial**2 + z**2
    cos_tibia = (distance2 - l1**2 - l2**2) / (2 * l1 * l2)
    with np.errstate(invalid="ignore"):
        tibia = -np.arccos(np.where(np.abs(cos_tibia) <= 1.0, cos_tibia, np.nan))
    femur = np.arctan2(z, radial) - np.arctan2(l2 * np.sin(tibia), l1 + l2 * np.cos(tibia))
    return np.stack([np.where(np.isnan(tibia), np.nan, np.arctan2(y, x)), femur, tibia], axis=-1)
