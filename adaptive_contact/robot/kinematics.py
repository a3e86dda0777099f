r"""Geometry of a serial leg: a chain of yaw and pitch joints.

Angles :math:`q` (J,) rad; the leg's frame has x along its zero direction, z up.  A pitch
raises the links beyond it, angles of pitch joints add along the chain (:math:`\phi_i`, the absolute
link angle over the horizon), a yaw turns what lies beyond it about z:

.. math:: r = \sum_i l_i \cos\phi_i, \quad z = \sum_i l_i \sin\phi_i

For the three-joint leg (yaw, pitch, pitch) this is the usual coxa-femur-tibia chain, and
:func:`inverse` solves it in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adaptive_contact.errors import ConfigurationError

__all__ = ["foot", "foot_point", "height_gradient", "height_gradients", "inverse", "link_angles"]

Array = NDArray[np.float64]


def link_angles(q: ArrayLike, axes: Sequence[str]) -> Array:
    """Absolute pitch of every link over the horizon of the leg's frame.

    Args:
        q: (..., J) rad joint angles.
        axes: (J,) ``yaw`` or ``pitch`` per joint.

    Returns:
        (..., J) rad; a yaw joint's own link keeps the pitch of the link before it.
    """
    angles = np.asarray(q, dtype=np.float64)
    pitch = np.array([1.0 if axis == "pitch" else 0.0 for axis in axes])
    return np.cumsum(angles * pitch, axis=-1)


def foot(q: ArrayLike, lengths_m: Sequence[float], axes: Sequence[str]) -> Array:
    """Foot position in the leg's frame.

    Args:
        q: (..., J) rad joint angles.
        lengths_m: (J,) m link lengths from the body outwards.
        axes: (J,) ``yaw`` or ``pitch`` per joint.

    Returns:
        (..., 3) m.
    """
    angles = np.asarray(q, dtype=np.float64)
    lengths = np.asarray(lengths_m, dtype=np.float64)
    yaw_mask = np.array([1.0 if axis == "yaw" else 0.0 for axis in axes])
    phi = link_angles(angles, axes)
    heading = np.cumsum(angles * yaw_mask, axis=-1)
    reach = lengths * np.cos(phi)
    return np.stack(
        [
            np.sum(reach * np.cos(heading), axis=-1),
            np.sum(reach * np.sin(heading), axis=-1),
            np.sum(lengths * np.sin(phi), axis=-1),
        ],
        axis=-1,
    )


def foot_point(
    q: Sequence[float], lengths_m: Sequence[float], axes: Sequence[str]
) -> tuple[float, float, float]:
    """Place of the foot in one posture: what every control tick asks.

    Plain floats; for so few of them numpy's call overhead is twenty times the arithmetic.

    Args:
        q: (J,) rad joint angles.
        lengths_m: (J,) m.
        axes: (J,) ``yaw`` or ``pitch`` per joint.

    Returns:
        x, y, z in m, equal to ``foot(q, ...)``.
    """
    if axes[0] == "yaw" and "yaw" not in axes[1:]:  # as nearly all legs are: in one plane
        pitch = z = 0.0
        reach = lengths_m[0]
        for i in range(1, len(axes)):
            pitch += q[i]
            reach += lengths_m[i] * math.cos(pitch)
            z += lengths_m[i] * math.sin(pitch)
        return reach * math.cos(q[0]), reach * math.sin(q[0]), z
    pitch = yaw = x = y = z = 0.0
    for angle, length, axis in zip(q, lengths_m, axes, strict=True):
        if axis == "pitch":
            pitch += angle
        else:
            yaw += angle
        reach = length * math.cos(pitch)
        x += reach * math.cos(yaw)
        y += reach * math.sin(yaw)
        z += length * math.sin(pitch)
    return x, y, z


def height_gradient(q: Sequence[float], lengths_m: Sequence[float], axes: Sequence[str]) -> Array:
    """How the foot rises with each joint: the third row of the leg's Jacobian.

    Args:
        q: (J,) rad joint angles.
        lengths_m: (J,) m.
        axes: (J,) ``yaw`` or ``pitch`` per joint.

    Returns:
        (J,) m per rad; 0 for a yaw joint, whose axis is upright.
    """
    pitch, reach = 0.0, []
    for angle, length, axis in zip(q, lengths_m, axes, strict=True):
        pitch += angle if axis == "pitch" else 0.0
        reach.append(length * math.cos(pitch))
    beyond, rises = 0.0, [0.0] * len(reach)
    for i in range(len(reach) - 1, -1, -1):
        beyond += reach[i]
        if axes[i] == "pitch":
            rises[i] = beyond
    return np.array(rises)


def height_gradients(q: ArrayLike, lengths_m: Sequence[float], axes: Sequence[str]) -> Array:
    """:func:`height_gradient` of many postures, (..., J) rad to (..., J) m per rad."""
    reach = np.asarray(lengths_m, dtype=np.float64) * np.cos(link_angles(q, axes))
    beyond = np.cumsum(reach[..., ::-1], axis=-1)[..., ::-1]
    return np.asarray(np.where([axis == "pitch" for axis in axes], beyond, 0.0))


def inverse(point_m: ArrayLike, lengths_m: Sequence[float]) -> Array:
    """Joint angles that put the foot of a yaw-pitch-pitch leg at a point, knee up.

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
