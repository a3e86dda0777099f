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
