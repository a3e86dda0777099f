"""What ground can do to a foot, and what is left of a residual without it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from adaptive_contact.compiled import records
from adaptive_contact.core.detect.contact import push_from_ground
from adaptive_contact.core.detect.layout import new_legs
from adaptive_contact.model.labelled_swing import ROW
from adaptive_contact.model.noise import CONTEXTS

GRADIENT = np.array([0.0, 0.15, 0.09])
TARGET = np.array([0.01, -0.1, 0.06])


class Push(NamedTuple):
    """What a push from the ground can have made of a residual, in deviations, and the rest."""

    sigma: float
    aside: np.ndarray


def push_of(
    residual: np.ndarray, target: np.ndarray, whitening: np.ndarray, gradient: np.ndarray
) -> Push:
    """As the tick splits it, with a variance scale of one."""
    rows, aside = np.zeros(1, dtype=ROW), np.zeros(3)
    whiten = np.zeros((CONTEXTS, 3, 3, 3))
    whiten[0, 0] = whitening
    push_from_ground(
        new_legs(1)[0], records(rows)[0], aside, residual, target, whiten, np.ones(3),
        gradient,
    )  # fmt: skip
    return Push(float(rows[0]["sigma"]), aside)


@pytest.fixture
def whitening() -> np.ndarray:
    rng = np.random.default_rng(0)
    root = np.diag([0.003, 0.004, 0.006]) @ (np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
    return np.linalg.inv(np.linalg.cholesky(root @ root.T))


def test_a_foot_pushed_up_is_all_push(whitening: np.ndarray) -> None:
    push = push_of(0.2 * GRADIENT, TARGET, whitening, GRADIENT)
    assert push.sigma == pytest.approx(0.2 * np.linalg.norm(whitening @ GRADIENT))
    np.testing.assert_allclose(push.aside, TARGET - 0.2 * GRADIENT)
    down = push_of(-0.2 * GRADIENT, TARGET, whitening, GRADIENT)
    assert down.sigma == -push.sigma


def test_what_is_left_shows_no_push(whitening: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    for residual in rng.normal(size=(100, 3)) * 0.02:
        push = push_of(residual, TARGET, whitening, GRADIENT)
        left = residual - (TARGET - push.aside)
        again = push_of(left, TARGET, whitening, GRADIENT)
        assert again.sigma == pytest.approx(0.0, abs=1e-12)
        # In units of the noise the two are at right angles.
        whole = np.sum((whitening @ residual) ** 2)
        assert whole == pytest.approx(push.sigma**2 + np.sum((whitening @ left) ** 2))


def test_noise_has_a_push_of_unit_variance(whitening: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    root = np.linalg.inv(whitening)
    noise = rng.normal(size=(4000, 3)) @ root.T
    sigma = [push_of(one, TARGET, whitening, GRADIENT).sigma for one in noise]
    assert np.std(sigma) == pytest.approx(1.0, abs=0.05)


def test_where_no_joint_lifts_the_foot_nothing_can_be_told(whitening: np.ndarray) -> None:
    assert push_of(TARGET, TARGET, whitening, np.zeros(3)).sigma == math.inf
