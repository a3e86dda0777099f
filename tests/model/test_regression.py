"""The compressed factor gives what the raw rows give."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.fit import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import Factor


def rows(seed: int, n: int, p: int, joints: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(n, p)) * 10.0 ** rng.uniform(-2, 2, size=p)
    truth = rng.normal(size=(p, joints)) * (rng.random((p, joints)) < 0.4)
    target = theta @ truth + 0.01 * rng.normal(size=(n, joints))
    return theta, target, truth


def factor_of(theta: np.ndarray, target: np.ndarray, pieces: int = 3) -> Factor:
    factor = Factor(theta.shape[1], target.shape[1])
    for part, out in zip(
        np.array_split(theta, pieces), np.array_split(target, pieces), strict=True
    ):
        factor.add(part, out)
    return factor


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 12), st.integers(1, 3), st.integers(1, 9))
def test_least_squares_equals_that_of_the_raw_rows(
    seed: int, p: int, joints: int, pieces: int
) -> None:
    theta, target, _ = rows(seed, 60, p, joints)
    fit = fit_sparse(factor_of(theta, target, pieces), FitSettings(ridge=0.0))
    expected = np.linalg.lstsq(theta, target, rcond=None)[0]
    np.testing.assert_allclose(fit.coefficients, expected, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(
        fit.rms, np.sqrt(np.square(target - theta @ expected).mean(axis=0)), rtol=1e-6
    )


def test_merging_equals_adding_and_order_does_not_matter() -> None:
    theta, target, _ = rows(1, 90, 6, 2)
    whole = factor_of(theta, target, 1)
    parts = [factor_of(theta[i::3], target[i::3], 1) for i in range(3)]
    merged = Factor.merged(reversed(parts), 6, 2)
    a, b = fit_sparse(whole, FitSettings()), fit_sparse(merged, FitSettings())
    np.testing.assert_allclose(a.coefficients, b.coefficients, atol=1e-9)
    assert merged.rows == whole.rows == 90


def test_bad_rows_are_left_out_and_counted() -> None:
    theta, target, _ = rows(2, 100, 5, 2)
    clean = factor_of(theta[10:], target[10:])
    theta[0, 2], theta[4, 1], target[9, 0] = np.nan, np.inf, -np.inf
    theta[[1, 2, 3, 5, 6, 7, 8], 0] = np.nan
    dirty = Factor(5, 2)
    assert dirty.add(theta, target) == 10
    np.testing.assert_allclose(dirty.rms(np.zeros((5, 2))), clean.rms(np.zeros((5, 2))))


@pytest.mark.parametrize(
    ("n", "threshold", "status"),
    [
        (7, 0.0, FitStatus.TOO_FEW_ROWS),
        (0, 0.0, FitStatus.TOO_FEW_ROWS),
        (100, 1e9, FitStatus.EMPTIED),
    ],
)
def test_what_no_model_comes_of_is_said(n: int, threshold: float, status: FitStatus) -> None:
    theta, target, _ = rows(2, n, 8, 2)
    fit = fit_sparse(factor_of(theta, target), FitSettings(threshold=threshold))
    assert fit.status is status
    assert not fit.coefficients.any()


def test_constant_repeated_and_zero_columns() -> None:
    theta, target, _ = rows(2, 200, 5, 2)
    theta = np.concatenate([theta, theta[:, :1], np.ones((200, 2)), np.zeros((200, 1))], axis=1)
    factor = factor_of(theta, target)
    fit = fit_sparse(factor, FitSettings())
    assert fit.status is FitStatus.OK
    assert np.isfinite(fit.coefficients).all()
    assert np.abs(fit.coefficients).max() < 1e3
    best = np.linalg.lstsq(theta, target, rcond=None)[0]
    np.testing.assert_allclose(fit.rms, factor.rms(best), rtol=1e-4)
