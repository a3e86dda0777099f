"""Forward kinematics against homogeneous matrices, the inverse against the forward."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from adaptive_contact.core.detect import swing
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import (
    Chain,
    Leg,
    Mount,
    foot,
    inverse,
)
from adaptive_contact.robot.kinematics import AXES as WORDS

LENGTHS = (0.052, 0.066, 0.138)
AXES = ("yaw", "pitch", "pitch")


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


def by_matrices(q: list[float], chain: Chain) -> np.ndarray:
    """(J + 1, 3) joints and foot, by homogeneous matrices, joint after joint."""
    frame, points = np.eye(4), [np.zeros(3)]
    for angle, axis, origin in zip(q, chain.axes, chain.origins_m, strict=True):
        vector = np.array(WORDS[axis] if isinstance(axis, str) else axis)
        joint, link = np.eye(4), np.eye(4)
        joint[:3, :3] = Rotation.from_rotvec(angle * vector).as_matrix()
        link[:3, 3] = origin
        frame = frame @ joint @ link
        points.append(frame[:3, 3])
    return np.array(points)


def number(least: float, most: float) -> st.SearchStrategy[float]:
    return st.floats(least, most, allow_nan=False)


@st.composite
def chains(draw: st.DrawFn) -> Chain:
    """Any chain of one to seven joints: words and tilted axes, lateral and vertical offsets."""
    joints = draw(st.integers(1, 7))
    direction = st.tuples(*[number(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)
    axes = draw(
        st.lists(st.sampled_from(list(WORDS)) | direction, min_size=joints, max_size=joints)
    )
    offset = st.tuples(*[number(-0.4, 0.4)] * 3)
    origins = draw(st.lists(offset, min_size=joints, max_size=joints))
    names = tuple(f"j{k}" for k in range(joints))
    return Leg(id="l", joints=names, axes=tuple(axes), origins_m=tuple(origins)).chain


@st.composite
def postures(draw: st.DrawFn) -> tuple[Chain, list[float]]:
    chain = draw(chains())
    joints = len(chain.axes)
    return chain, draw(st.lists(number(-3.2, 3.2), min_size=joints, max_size=joints))


@given(postures())
def test_any_chain_matches_homogeneous_matrices(case: tuple[Chain, list[float]]) -> None:
    chain, q = case
    expected = by_matrices(q, chain)
    np.testing.assert_allclose(chain.foot(q), expected[-1], atol=1e-13)
    np.testing.assert_allclose(chain.foot([q, q]), [expected[-1]] * 2, atol=1e-13)
    np.testing.assert_allclose(chain.point(q), expected[-1], atol=1e-13)
    np.testing.assert_allclose(chain.frames(q)[0], expected, atol=1e-13)
    compiled = np.zeros(3)
    swing.locate_foot(np.array(q), *swing.tabulate(chain), compiled)
    np.testing.assert_allclose(compiled, expected[-1], atol=1e-13)


@given(postures())
def test_the_gradient_of_any_chain_is_the_slope_of_its_matrices(
    case: tuple[Chain, list[float]],
) -> None:
    chain, q = case
    step = 1e-5 * np.eye(len(q))
    slopes = [
        (by_matrices(q + by, chain) - by_matrices(q - by, chain))[-1, 2] / 2e-5 for by in step
    ]
    compiled = np.zeros(len(q))
    swing.height_gradient(np.array(q), *swing.tabulate(chain), compiled)
    np.testing.assert_allclose(compiled, slopes, atol=1e-8)
    assert chain.lifts[np.abs(slopes) > 1e-6 * max(chain.reach_m, 1.0)].all()


def test_joints_that_never_raise_the_foot_are_known() -> None:
    """An upright axis on top, and one that goes through the foot."""
    chain = Chain(
        ("yaw", "roll", "pitch", (0.0, 0.0, -1.0)),
        ((0.0, 0.05, 0.0), (0.0, 0.0, -0.1), (0.0, 0.0, -0.1), (0.0, 0.0, -0.05)),
    )
    assert chain.lifts.tolist() == [False, True, True, False]


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.floats(-3, 3))
def test_an_outline_is_the_mounted_chain(q: list[float], yaw: float) -> None:
    """Joint by joint by matrices, turned about z and moved as the mount says."""
    mount = Mount(xyz_m=(0.1, -0.2, 0.03), yaw_rad=yaw)
    leg = Leg(id="rf", joints=("coxa", "femur", "tibia"), lengths_m=LENGTHS, mount=mount)
    turn = Rotation.from_rotvec([0, 0, yaw])
    expected = turn.apply(by_matrices(q, leg.chain)) + mount.xyz_m
    np.testing.assert_allclose(leg.outline(q), expected, atol=1e-12)


def test_an_outline_needs_geometry_mount_and_angles() -> None:
    mount, joints, q = Mount(xyz_m=(0.1, 0.0, 0.0)), ("coxa", "femur", "tibia"), [0.1, 0.2, 0.3]
    assert Leg(id="a", joints=joints, mount=mount).outline(q) == []
    assert Leg(id="a", joints=joints, lengths_m=LENGTHS).outline(q) == []
    leg = Leg(id="a", joints=joints, lengths_m=LENGTHS, mount=mount)
    assert leg.outline(q[:2]) == []
    assert len(leg.outline(q)) == 4
