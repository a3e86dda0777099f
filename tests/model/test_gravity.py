"""The angles of gravity against what gravity does, by differences of a leg's energy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adaptive_contact.model.gravity import gravity_angles
from adaptive_contact.robot.description import Axis
from adaptive_contact.robot.kinematics import AXES

ROLL_HIP: tuple[Axis, ...] = ("roll", "pitch", "pitch")
HANGING: tuple[Axis, ...] = ("yaw", "roll", "pitch", "pitch", "pitch")
TILTED: tuple[Axis, ...] = ((0.6, 0.0, 0.8), "pitch", "pitch")
DOWNWARDS: tuple[Axis, ...] = ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0))


def energies(q: np.ndarray, axes: tuple[Axis, ...], rng: np.random.Generator) -> np.ndarray:
    """(n,) of a leg with random masses anywhere on its links."""
    joints = len(axes)
    origins, centres = rng.normal(size=(2, joints, 3))
    masses = rng.uniform(0.5, 2.0, size=joints)
    found = []
    for row in q:
        turn, place, energy = Rotation.identity(), np.zeros(3), 0.0
        for j, axis in enumerate(axes):
            vector = np.array(AXES[axis] if isinstance(axis, str) else axis)
            turn = turn * Rotation.from_rotvec(row[j] * vector)
            energy += masses[j] * (place + turn.apply(centres[j]))[2]
            place = place + turn.apply(origins[j])
        found.append(energy)
    return np.array(found)


@pytest.mark.parametrize("axes", [ROLL_HIP, HANGING, TILTED, DOWNWARDS, ("pitch", "yaw", "pitch")])
def test_every_torque_of_gravity_is_made_of_them(axes: tuple[Axis, ...]) -> None:
    rng = np.random.default_rng(len(axes))
    q = rng.uniform(-3.0, 3.0, size=(80, len(axes)))
    angles = gravity_angles([f"j{k}" for k in range(len(axes))], axes)
    phi = q @ np.array([angle.weights for angle in angles]).T
    terms = np.concatenate([np.cos(phi), np.sin(phi)], axis=1)
    step = 1e-5 * np.eye(len(axes))
    for j in range(len(axes)):
        rng, other = np.random.default_rng(7), np.random.default_rng(7)
        torque = (energies(q + step[j], axes, rng) - energies(q - step[j], axes, other)) / 2e-5
        left = torque - terms @ np.linalg.lstsq(terms, torque, rcond=None)[0]
        assert np.abs(left).max() < 1e-7
