"""Recursive least squares against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.identify.recursive import RecursiveLeastSquares, RlsSettings

P, J = 6, 2
NOISE = np.array([0.5, 2.0])
SUPPORT = np.array([[1, 1], [1, 0], [0, 1], [1, 1], [0, 0], [1, 1]], dtype=bool)
SCALE = np.array([1.0, 10.0, 0.1, 2.0, 1.0, 5.0])


def make(**settings: float) -> RecursiveLeastSquares:
    start = np.where(SUPPORT, 0.3, 0.0)
    return RecursiveLeastSquares(start, SUPPORT, SCALE, NOISE, RlsSettings(**settings))


def data(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(n, P)) * SCALE
    truth = np.where(SUPPORT, rng.normal(size=(P, J)), 0.0)
    return theta, theta @ truth + rng.normal(size=(n, J)) * NOISE, truth


def test_without_forgetting_one_by_one_equals_batch() -> None:
    theta, target, _ = data(80)
    rls = make(forgetting=1.0, prior=3.0, bound=1e9, huber=1e9)
    for row, y in zip(theta, target, strict=True):
        rls.update(row, y)
    for j in range(J):
        on = SUPPORT[:, j]
        phi = theta[:, on]
        prior = np.diag(np.square(SCALE[on] / (3.0 * NOISE[j])))
        information = phi.T @ phi / NOISE[j] ** 2 + prior
        start = np.full(on.sum(), 0.3)
        expected = np.linalg.solve(
            information, phi.T @ target[:, j] / NOISE[j] ** 2 + prior @ start
        )
        np.testing.assert_allclose(rls.coefficients[on, j], expected, rtol=1e-9)
        kept = np.flatnonzero(on)
        index = [int(np.flatnonzero(rls.terms == k)[0]) for k in kept]
        ours = rls.covariance[j][np.ix_(index, index)] / np.outer(SCALE[on], SCALE[on])
        np.testing.assert_allclose(ours, np.linalg.inv(information), rtol=1e-8)


def test_forgetting_equals_the_dense_recursion() -> None:
    """Kulhavý's recursion on the covariance itself, written from the paper's formula."""
    lam = 0.97
    theta, target, _ = data(300, seed=1)
    rls = make(forgetting=lam, prior=3.0, bound=1e9, huber=1e9)
    j = 0
    on = SUPPORT[:, j]
    p = np.diag(np.square(3.0 * NOISE[j] / SCALE[on]))
    xi = np.full(on.sum(), 0.3)
    for row, y in zip(theta, target, strict=True):
        rls.update(row, y)
        phi = row[on] / NOISE[j]
        zeta = phi @ p @ phi
        xi = xi + p @ phi / (1 + zeta) * (y[j] / NOISE[j] - phi @ xi)
        eps = lam - (1 - lam) / zeta
        p = p - np.outer(p @ phi, phi @ p) / (1 / eps + zeta)
    np.testing.assert_allclose(rls.coefficients[on, j], xi, rtol=1e-7)


def test_terms_outside_the_support_never_move() -> None:
    theta, target, _ = data(200)
    rls = make()
    for row, y in zip(theta, target, strict=True):
        rls.update(row, y)
    assert (rls.coefficients[~SUPPORT] == 0.0).all()


def test_it_follows_a_change() -> None:
    theta, target, truth = data(3000, seed=2)
    moved = truth + np.where(SUPPORT, 0.5, 0.0)
    target[1500:] += theta[1500:] @ (moved - truth)
    rls = make(forgetting=0.98, prior=5.0)
    for row, y in zip(theta, target, strict=True):
        rls.update(row, y)
    error = np.abs(rls.coefficients - moved) * SCALE[:, None] / NOISE
    assert error[SUPPORT].max() < 0.6


def test_standing_still_for_an_hour_changes_nothing_else() -> None:
    theta, target, _ = data(500, seed=3)
    rls = make(forgetting=0.998)
    for row, y in zip(theta, target, strict=True):
        rls.update(row, y)
    before = rls.covariance.copy()
    still = np.array([1.0, 0, 0, 0, 0, 0])
    rng = np.random.default_rng(0)
    for _ in range(50 * 3600 // 10):
        rls.update(still, still @ rls.coefficients + rng.normal(size=J) * NOISE)
    after = rls.covariance
    # Orthogonal to what stood still, the knowledge is the same.
    others = np.array([k for k in range(len(rls.terms)) if rls.terms[k] != 0])
    np.testing.assert_allclose(
        np.linalg.inv(after[0][np.ix_(others, others)] + 1e-12 * np.eye(len(others))).max(),
        np.linalg.inv(before[0][np.ix_(others, others)] + 1e-12 * np.eye(len(others))).max(),
        rtol=0.2,
    )
    assert np.isfinite(rls.coefficients).all()


@pytest.mark.slow
def test_the_covariance_stays_definite_and_bounded_over_a_million_rows() -> None:
    rng = np.random.default_rng(4)
    rls = make(forgetting=0.99, bound=20.0)
    theta = rng.normal(size=(1000, P)) * SCALE
    theta[::3] = theta[0]  # long spells of the same posture
    target = theta @ rls.coefficients
    on = [np.flatnonzero(SUPPORT[rls.terms, j]) for j in range(J)]
    for n in range(1_000_000):
        k = n % 1000
        rls.update(theta[k], target[k])
        if n % 100_000 == 0:
            for j in range(J):
                values = np.linalg.eigvalsh(rls.covariance[j][np.ix_(on[j], on[j])])
                assert values.min() > 0
                assert np.sqrt(values.max()) < 20.0 * NOISE[j] * len(on[j]) ** 0.5
    assert np.isfinite(rls.coefficients).all()


def test_an_outlier_moves_it_little() -> None:
    theta, target, _ = data(500, seed=5)
    rls = make(prior=5.0)
    for row, y in zip(theta, target, strict=True):
        rls.update(row, y)
    before = rls.coefficients
    rls.update(theta[0], target[0] + 1000.0 * NOISE)
    moved = np.abs(rls.coefficients - before) * SCALE[:, None] / NOISE
    assert moved.max() < 0.3


def test_bad_rows_are_left_out() -> None:
    rls = make()
    before = rls.coefficients
    rls.update(np.full(P, np.nan), np.zeros(J))
    rls.update(np.ones(P), np.array([np.inf, 0.0]))
    np.testing.assert_array_equal(rls.coefficients, before)
    assert rls.rows == 0


def test_uncertainty_is_the_variance_of_the_prediction() -> None:
    theta, target, _ = data(60, seed=6)
    rls = make()
    for row, y in zip(theta[:30], target[:30], strict=True):
        rls.update(row, y)
    phi = theta[30:, rls.terms] / SCALE[rls.terms]
    expected = np.einsum("nq,jqr,nr->nj", phi, rls.covariance, phi) / NOISE**2
    np.testing.assert_allclose(rls.uncertainty(theta[30:]), expected, rtol=1e-9)


def test_loosening_adds_covariance_along_the_directions() -> None:
    rls = make(prior=0.5, bound=1e9)
    before = rls.covariance.copy()
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(J, 3, P))
    rls.loosen(directions)
    for j in range(J):
        moves = (directions[j] * SCALE * SUPPORT[:, j])[:, rls.terms]
        np.testing.assert_allclose(rls.covariance[j], before[j] + moves.T @ moves, atol=1e-9)
