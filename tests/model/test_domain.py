"""What a fit knows of a row, against the dense inverse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.model import Domain, Factor
from adaptive_contact.model.training_domain import PRIOR_DEVIATIONS


def domain_of(theta: np.ndarray) -> Domain:
    factor = Factor(theta.shape[1], 1)
    factor.add(theta, np.zeros((len(theta), 1)))
    return Domain.of(factor, factor.scale())


@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 60), terms=st.integers(1, 7))
def test_leverage_is_that_of_the_dense_inverse(seed: int, rows: int, terms: int) -> None:
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(rows, terms)) * 10.0 ** rng.uniform(-3, 3, terms)
    new = rng.normal(size=(5, terms)) * np.abs(theta).mean(axis=0)
    scale = np.sqrt(np.square(theta).mean(axis=0))
    phi, asked = theta / scale, new / scale
    information = phi.T @ phi + np.eye(terms) / PRIOR_DEVIATIONS**2
    dense = np.einsum("ij,ji->i", asked, np.linalg.solve(information, asked.T))
    np.testing.assert_allclose(domain_of(theta).leverage(new), dense, rtol=1e-6)


def test_known_ground_is_told_from_new_ground() -> None:
    rng = np.random.default_rng(0)
    theta = np.column_stack([np.ones(500), rng.normal(size=500), np.zeros(500)])
    domain = domain_of(theta)
    assert domain.leverage(np.array([1.0, 0.3, 0.0])) < 0.01
    assert domain.leverage(np.array([1.0, 30.0, 0.0])) > 1.0
    # A column that was never there: as uncertain as the prior says, and finite.
    assert domain.leverage(np.array([0.0, 0.0, 1.0])) == pytest.approx(PRIOR_DEVIATIONS**2)


def test_a_domain_widened_is_that_of_all_its_rows() -> None:
    rng = np.random.default_rng(1)
    first, more = rng.normal(size=(80, 4)), 5.0 * rng.normal(size=(30, 4))
    domain = domain_of(first)
    factor = Factor(4, 1)
    factor.add(more, np.zeros((30, 1)))
    wide = domain.widened(factor)
    phi = np.concatenate([first, more]) / domain.scale
    np.testing.assert_allclose(wide.gram, phi.T @ phi + np.eye(4) / PRIOR_DEVIATIONS**2)
    new = rng.normal(size=(10, 4))
    assert (wide.leverage(new) < domain.leverage(new)).all()
    np.testing.assert_allclose(domain.widened(Factor(4, 1)).gram, domain.gram)


@pytest.mark.parametrize(("most", "weight"), [(50.0, 0.1), (1000.0, 1.0)])
def test_rows_that_stand_for_those_seen(most: float, weight: float) -> None:
    rng = np.random.default_rng(2)
    theta = np.column_stack([np.ones(500), rng.normal(size=(500, 3)) * [0.01, 1.0, 100.0]])
    rows = domain_of(theta).rows_like(most)
    np.testing.assert_allclose(rows.T @ rows, weight * theta.T @ theta, rtol=1e-9, atol=1e-9)
