"""Forward kinematics against rotation matrices, the inverse against the forward."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import foot, foot_point, height_gradient, inverse, link_angles

LENGTHS = (0.052, 0.066, 0.138)
AXES = ("yaw", "pitch", "pitch")


def foot_by_rotations(
    q: list[float], lengths: tuple[float, ...], axes: tuple[str, ...]
) -> np.ndarray:
    """Chain of homogeneous rotations, link after link (pitch up = rotation about -y)."""
    turn = Rotation.identity()
    point = np.zeros(3)
    for angle, length, axis in zip(q, lengths, axes, strict=True):
        vector = [0, 0, angle] if axis == "yaw" else [0, -angle, 0]
        turn = turn * Rotation.from_rotvec(vector)
        point = point + turn.apply([length, 0, 0])
    return point


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_three_joints_match_a_chain_of_rotations(q: list[float]) -> None:
    np.testing.assert_allclose(
        foot(q, LENGTHS, AXES), foot_by_rotations(q, LENGTHS, AXES), atol=1e-12
    )


@given(st.floats(-1.2, 1.2), st.floats(-1.5, 1.5), st.floats(-2.6, -0.1))
def test_the_inverse_undoes_the_forward(coxa: float, femur: float, tibia: float) -> None:
    point = foot([coxa, femur, tibia], LENGTHS, AXES)
    if np.hypot(point[0], point[1]) * np.sign(np.cos(coxa) * point[0]) < 0.053:
        return  # folded back over its own axis: the yaw is not unique
    reached = foot(inverse(point, LENGTHS), LENGTHS, AXES)
    np.testing.assert_allclose(reached, point, atol=1e-9)


def test_out_of_reach_is_nan() -> None:
    assert np.isnan(inverse([1.0, 0, 0], LENGTHS)).all()
    both = inverse([[0.15, 0.02, -0.1], [1.0, 0, 0]], LENGTHS)
    assert np.isfinite(both[0]).all()
    assert np.isnan(both[1]).all()


def test_the_inverse_wants_three_links() -> None:
    with pytest.raises(ConfigurationError, match="needs 3 links, found 2"):
        inverse([0.1, 0, 0], (0.1, 0.1))


def test_link_angles_add_pitches_only() -> None:
    np.testing.assert_allclose(link_angles([0.5, 0.2, -1.0], AXES), [0.0, 0.2, -0.8])


@pytest.mark.parametrize(
    "axes",
    [("yaw", "pitch", "pitch"), ("yaw", "pitch"), ("pitch", "yaw", "pitch"), ("pitch",), ("yaw",)],
)
def test_the_place_of_one_posture_is_that_of_many(axes: tuple[str, ...]) -> None:
    rng = np.random.default_rng(len(axes))
    lengths = rng.uniform(0.02, 0.2, size=len(axes))
    angles = rng.uniform(-3.0, 3.0, size=(50, len(axes)))
    expected = foot(angles, lengths, axes)
    found = [foot_point(q, lengths.tolist(), axes) for q in angles.tolist()]
    np.testing.assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize(
    "axes",
    [("yaw", "pitch", "pitch"), ("yaw", "pitch"), ("pitch", "yaw", "pitch"), ("pitch",), ("yaw",)],
)
def test_the_height_s_gradient_is_its_slope(axes: tuple[str, ...]) -> None:
    rng = np.random.default_rng(len(axes))
    lengths = rng.uniform(0.02, 0.2, size=len(axes)).tolist()
    step = 1e-6 * np.eye(len(axes))
    for q in rng.uniform(-3.0, 3.0, size=(50, len(axes))):
        slopes = (foot(q + step, lengths, axes) - foot(q - step, lengths, axes))[:, 2] / 2e-6
        np.testing.assert_allclose(height_gradient(q.tolist(), lengths, axes), slopes, atol=1e-9)
