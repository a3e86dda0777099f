"""Recursive least squares against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.compiled import compiles
from adaptive_contact.core.detect.contact import model_uncertainty
from adaptive_contact.core.learn.rls import RecursiveLeastSquares, RlsSettings

# A row of plain Python takes a thousand times as long as a compiled one.
SLOWER = 1 if compiles() else 20
MANY = [pytest.mark.slow, pytest.mark.skipif(not compiles(), reason="an hour uncompiled")]
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


def learn(rls: RecursiveLeastSquares, theta: np.ndarray, target: np.ndarray) -> None:
    """Rows, one by one."""
    for row in np.column_stack([np.atleast_2d(theta), np.atleast_2d(target)]):
        rls.learn(row[None], 0)


def uncertainty(rls: RecursiveLeastSquares, theta: np.ndarray) -> np.ndarray:
    """(n, J) as a tick computes it: variance of predictions over the noise's."""
    index, per_scale, root = rls.roots
    size = index.shape[1]
    return np.array(
        [
            [model_uncertainty(row, index, per_scale, root, size, j) for j in range(len(index))]
            for row in theta
        ]
    )


def covariance(rls: RecursiveLeastSquares) -> np.ndarray:
    """(J, p, p) of the scaled coefficients, zeros for terms that may not move."""
    support, factor = rls.support, rls.factor
    full = np.zeros((len(factor), len(support), len(support)))
    for j, root in enumerate(factor):
        on = np.flatnonzero(support[:, j])
        full[j][np.ix_(on, on)] = root[: len(on)] @ root[: len(on)].T
    return full


def test_without_forgetting_one_by_one_equals_batch() -> None:
    theta, target, _ = data(80)
    rls = make(forgetting=1.0, prior=3.0, bound=1e9, huber=1e9)
    learn(rls, theta, target)
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
        ours = covariance(rls)[j][np.ix_(on, on)] / np.outer(SCALE[on], SCALE[on])
        np.testing.assert_allclose(ours, np.linalg.inv(information), rtol=1e-8)


def test_standing_still_for_an_hour_changes_nothing_else() -> None:
    """Full covariance and coefficients, before and after 180,000 ticks at 50 Hz.

    A row moves both along P φ alone.  In coordinates in which the covariance was the identity, an
    hour of two rows (a posture whose reading flickers by a step) must leave all but their plane.
    """
    theta, target, truth = data(500, seed=3)
    rls = make(forgetting=0.998)
    learn(rls, theta, target)
    xi, before = rls.coefficients, covariance(rls)
    still = np.array([[1.0, 4.0, -0.05, 1.0, 0.3, 2.0], [1.0, 4.0, -0.05, 1.1, 0.3, 2.0]])
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(180_000 // SLOWER, J)) * NOISE
    which = (rng.random(len(noise)) < 0.3).astype(int)
    learn(rls, still[which], still[which] @ truth + noise)
    assert rls.rows == 500 + len(noise)
    for j in range(J):
        on = kept = np.flatnonzero(SUPPORT[:, j])
        root = np.linalg.cholesky(before[j][np.ix_(on, on)])
        turned, _ = np.linalg.qr(root.T @ (still[:, kept] / SCALE[kept]).T, mode="complete")
        back = np.linalg.inv(root) @ covariance(rls)[j][np.ix_(on, on)] @ np.linalg.inv(root).T
        back = turned.T @ back @ turned
        np.testing.assert_allclose(back[2:, 2:], np.eye(len(on) - 2), atol=1e-6)
        np.testing.assert_allclose(back[:2, 2:], 0.0, atol=1e-6)
        moved = SCALE[kept] * (rls.coefficients - xi)[kept, j]
        np.testing.assert_allclose((turned.T @ np.linalg.solve(root, moved))[2:], 0.0, atol=1e-6)
    # In the plane it knows what 500 rows can tell, and no more: nothing has wound up or closed.
    np.testing.assert_allclose(uncertainty(rls, still), 0.002, rtol=0.6)
    off = still @ (rls.coefficients - truth) / NOISE
    assert np.abs(off).max() < 4.0 * 0.002**0.5


@pytest.mark.parametrize("rows", [50_000 // SLOWER, pytest.param(1_000_000, marks=MANY)])
def test_the_covariance_stays_definite_and_bounded(rows: int) -> None:
    """As large as a leg's, with regressors that hang together, idle spells and loosening."""
    rng = np.random.default_rng(4)
    p, joints, bound = 45, 3, 20.0
    noise = np.array([0.004, 0.005, 0.006])
    scale = 10.0 ** rng.uniform(-1.5, 1.5, p)
    support = np.zeros((p, joints), dtype=bool)
    for j, count in enumerate((28, 30, 32)):  # the short ones are filled up with zeros
        support[rng.choice(p, count, replace=False), j] = True
    truth = np.where(support, rng.normal(size=(p, joints)) * noise / scale[:, None], 0.0)
    rls = RecursiveLeastSquares(truth, support, scale, noise, RlsSettings(bound=bound))
    # A swing moves few variables, of which the terms are functions.
    theta = rng.normal(size=(2048, 12)) @ rng.normal(size=(12, p)) / 12**0.5
    theta = (theta + 0.03 * rng.normal(size=theta.shape)) * scale
    target = theta @ truth + rng.normal(size=(len(theta), joints)) * noise
    idle = False
    # Whenever the bound has just been looked after: every 64 rows.
    for first in range(0, rows, 64):
        if first % 3200 == 0:
            idle = rng.random() < 0.4
        if first % 9600 == 0:
            units = rng.exponential(10.0, size=(joints, 6, 1))  # beyond the bound, too
            rls.inflate(units * noise[:, None, None] * rng.normal(size=(joints, 6, p)) / scale)
        seen = np.full(64, first) if idle else np.arange(first, first + 64)
        learn(rls, theta[seen % len(theta)], target[seen % len(theta)])
        if first % 6400 == 0 or first + 64 >= rows:
            found = covariance(rls)
            for j in range(joints):
                on = np.flatnonzero(support[:, j])
                own = found[j][np.ix_(on, on)] / noise[j] ** 2
                values = np.linalg.eigvalsh(own)
                assert values.min() > 1e-12 * values.max(), first
                assert np.sqrt(np.diag(own)).max() <= bound * (1.0 + 1e-9), first
                off = np.flatnonzero(~support[:, j])
                assert not found[j][off].any()
    assert rls.rows >= rows
    assert (rls.coefficients[~support] == 0.0).all()
    # It has not only stayed finite: after a minute of swings it knows its leg.
    learn(rls, theta, target)
    error = theta @ (rls.coefficients - truth) / noise
    assert np.sqrt(np.square(error).mean()) < 0.5


def test_an_outlier_moves_it_little() -> None:
    theta, target, _ = data(500, seed=5)
    rls = make(prior=5.0)
    learn(rls, theta, target)
    before = rls.coefficients
    learn(rls, theta[0], target[0] + 1000.0 * NOISE)
    moved = np.abs(rls.coefficients - before) * SCALE[:, None] / NOISE
    assert moved.max() < 0.3


def test_bad_rows_are_left_out() -> None:
    rls = make()
    before = rls.coefficients
    learn(rls, np.full(P, np.nan), np.zeros(J))
    learn(rls, np.ones(P), np.array([np.inf, 0.0]))
    np.testing.assert_array_equal(rls.coefficients, before)
    assert rls.rows == 0


def test_uncertainty_is_the_variance_of_the_prediction() -> None:
    theta, target, _ = data(60, seed=6)
    rls = make()
    learn(rls, theta[:30], target[:30])
    phi = theta[30:] / SCALE
    expected = np.einsum("nq,jqr,nr->nj", phi, covariance(rls), phi) / NOISE**2
    np.testing.assert_allclose(uncertainty(rls, theta[30:]), expected, rtol=1e-9)


def test_loosening_adds_covariance_along_the_directions() -> None:
    rls = make(prior=0.5, bound=1e9)
    before = covariance(rls)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(J, 3, P))
    rls.inflate(directions)
    for j in range(J):
        moves = directions[j] * SCALE * SUPPORT[:, j]
        np.testing.assert_allclose(covariance(rls)[j], before[j] + moves.T @ moves, atol=1e-9)


def test_coefficients_beyond_what_a_term_may_move_are_told() -> None:
    theta, target, truth = data(60, seed=7)
    most = 1.2 * float(np.abs(truth * SCALE[:, None]).max())
    settings = RlsSettings(prior=5.0)
    rls = RecursiveLeastSquares(truth, SUPPORT, SCALE, NOISE, settings, most)
    values = np.concatenate([theta, target], axis=1)
    assert all(rls.learn(values, k) for k in range(60))
    assert not all(rls.learn(np.concatenate([theta, 40.0 * target], axis=1), k) for k in range(60))
    assert np.abs(rls.coefficients * SCALE[:, None]).max() > most
    nan = RecursiveLeastSquares(truth * np.nan, SUPPORT, SCALE, NOISE, settings, most)
    assert not nan.learn(values, 0)
