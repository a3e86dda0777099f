r"""Finds the angles on which the torques of gravity depend, for any chain.

A link's weight pulls along the vertical as the link sees it,
:math:`u_i = R_i^\top \cdots R_1^\top e_z`, and every torque of gravity is made of the entries of
these and of their derivatives.  A rotation is

.. math:: R = P_0 + P_+ e^{jq} + P_- e^{-jq}

with the projectors :math:`P` onto the eigenspaces of :math:`a^\times`, so that :math:`u_i` is a sum
of cosines and sines of :math:`\sum_k s_k q_k, s_k \in \{-1, 0, 1\}`.  Joints with parallel axes
come as their sum only, and one that is upright does not come at all: for yaws, then pitches, the
absolute link angles :math:`\phi_i` are what is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.robot.description import Axis
from adaptive_contact.robot.kinematics import AXES, Vector, yaws_then_pitches

Complex = NDArray[np.complex128]


class GravityAngle(NamedTuple):
    """Holds an angle on which gravity depends: a signed sum of joints."""

    name: str  # ``φ_knee``, or ``φ(roll+hip-knee)``
    weights: tuple[float, ...]  # (J,) 1, -1 or 0


def gravity_angles(joints: Sequence[str], axes: Sequence[Axis]) -> tuple[GravityAngle, ...]:
    """Find the angles on which gravity depends.

    Args:
        joints: (J,) names.
        axes: (J,) of each, with all angles 0.
    """
    if yaws_then_pitches(axes):
        pitched = [1.0 if axis == "pitch" else 0.0 for axis in axes]
        return tuple(
            GravityAngle(f"φ_{joint}", (*pitched[: j + 1], *[0.0] * (len(axes) - j - 1)))
            for j, joint in enumerate(joints)
            if pitched[j]
        )
    found: dict[tuple[int, ...], None] = {}
    vertical: dict[tuple[int, ...], Complex] = {
        (0,) * len(axes): np.array([0.0, 0.0, 1.0], dtype=np.complex128)
    }
    for j, axis in enumerate(axes):
        still, turning = _projectors(AXES[axis] if isinstance(axis, str) else axis)
        turned: dict[tuple[int, ...], Complex] = {}
        for signs, part in vertical.items():
            for sign, projector in ((0, still), (1, turning), (-1, turning.conj())):
                of = (*signs[:j], sign, *signs[j + 1 :])
                turned[of] = turned.get(of, 0.0) + part @ projector
        # Of a link's weight; less moves no servo by a step, and axes in files are off by as much.
        there = [of for of, part in turned.items() if np.abs(part).max() > 0.01]
        # Parts of a product that are followed; each joint may triple them.
        vertical = {of: turned[of] for of in _simplest(there, 729)}
        # Of an angle and its negative, which come in pairs, one is enough.
        found |= dict.fromkeys(of for of in vertical if _leading(of) > 0)
    # Angles per joint: a hip of yaw, roll and pitch, knee and ankle need 7 for 5 joints.  Of a
    # chain with more, those that fewer joints turn are kept: its library is to stay small enough to
    # learn.
    kept = _simplest(list(found), 3 * len(axes))
    return tuple(
        GravityAngle(_name(joints, signs), tuple(float(sign) for sign in signs)) for signs in kept
    )


def _projectors(axis: Vector) -> tuple[Complex, Complex]:
    """Return (3, 3) projectors onto the axis, and onto what turns with plus the angle."""
    a, b, c = axis
    cross = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]])
    still = np.outer(axis, axis)
    return still.astype(np.complex128), 0.5 * (np.eye(3) - still - 1j * cross)


def _simplest(angles: Sequence[tuple[int, ...]], most: int) -> list[tuple[int, ...]]:
    """Return the ``most`` angles that fewest joints turn, in their order."""
    if len(angles) <= most:
        return list(angles)
    kept = set(sorted(angles, key=lambda signs: sum(map(abs, signs)))[:most])
    return [signs for signs in angles if signs in kept]


def _leading(signs: Sequence[int]) -> int:
    """Sign of the first joint that turns it; 0 where none does."""
    return next((sign for sign in signs if sign), 0)


def _name(joints: Sequence[str], signs: Sequence[int]) -> str:
    names = "".join(f"{'+' if s > 0 else '-'}{j}" for j, s in zip(joints, signs, strict=True) if s)
    return f"φ({names.removeprefix('+')})"
