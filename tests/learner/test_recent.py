"""Covariance and thresholds that follow the confirmed free ticks."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.core.learn.noise_tracker import (
    CLIP,
    LEAST_LIFTS,
    OWN_LIFTS,
    RECENT_LIFTS,
    SHRINK_TICKS,
    NoiseTracker,
    turned_by,
)
from adaptive_contact.model.labelled_swing import Rows
from adaptive_contact.model.leg_prior import prior_tails
from adaptive_contact.model.noise import (
    AFTER,
    CONTEXTS,
    DESCENT,
    DIRECTIONS,
    LIFT,
    WINDOWS,
    NoiseModel,
)
from adaptive_contact.model.peaks import Peaks
from adaptive_contact.model.tail import Tail

from .ticks import Tick, rows_of

J = 3
SIGMA = 0.003


@pytest.fixture
def noise() -> NoiseModel:
    covariance = np.stack(
        [[SIGMA**2 * ticks * np.eye(J) for ticks in WINDOWS] for _ in range(CONTEXTS)]
    )
    return NoiseModel(covariance, np.full(CONTEXTS, 1000))


def recent(noise: NoiseModel, tails: tuple[Tail, ...] | None = None) -> NoiseTracker:
    return NoiseTracker(noise, tails or prior_tails(), 1.0)


def rows(values: list[float], ratio: float = 0.1, *, lift: bool = True) -> Rows:
    """Free ticks with a statistic, and a largest test ratio."""
    at, still = np.zeros(2), np.zeros(J)
    return rows_of([Tick(at, still, v / J, v, lift=lift, ratio=ratio) for v in values])


def test_whitening_is_turned_as_dense_algebra_does(noise: NoiseModel) -> None:
    rng = np.random.default_rng(5)
    whiten = np.array(noise.whiten)
    for ticks in (1, 7, 400, 401):
        residuals = rng.normal(size=(ticks, J)) @ rng.normal(size=(J, J)) * SIGMA
        residuals[::50] *= 30.0  # wild ones, which are clipped
        context = rng.integers(0, len(whiten), ticks)
        z = np.matvec(whiten[context, 0], residuals)
        size = np.sqrt(np.square(z).mean(axis=1))
        z *= np.minimum(1.0, CLIP * np.median(size) / size)[:, None]
        shape = z.T @ z + SHRINK_TICKS * np.square(z).mean() * np.eye(J)
        shape *= J / shape.trace()
        expected = np.linalg.inv(np.linalg.cholesky(shape)) @ whiten
        np.testing.assert_allclose(turned_by(whiten, residuals, context), expected, rtol=1e-9)


def test_thresholds_of_own_peaks_follow_the_last_lifts(
    noise: NoiseModel,
) -> None:
    rng = np.random.default_rng(3)
    values = 0.5 * rng.chisquare(1, (4000, len(WINDOWS)))
    peaks = Peaks.from_values(values, np.arange(len(values)) % DIRECTIONS)

    of = NoiseTracker(noise, prior_tails(), 1.0, peaks)
    first = of.thresholds
    assert (first[LIFT] < recent(noise).thresholds[LIFT]).all(), "below those of the tail"
    of.count(rows([200.0] * 10))
    for _ in range(RECENT_LIFTS):
        of.count(rows((0.5 * rng.chisquare(1, 10)).tolist()))
    assert of.thresholds == pytest.approx(first, rel=0.35), "one lift that struck moves no median"
    for _ in range(6):
        of.count(rows((0.9 * rng.chisquare(1, 10)).tolist()))
    for _ in range(RECENT_LIFTS):
        of.count(rows((50.0 * rng.chisquare(1, 10)).tolist()))
    limit = recent(noise).thresholds
    assert (of.thresholds[LIFT] >= limit[LIFT]).all(), "up to those of the tail"


def test_a_leg_without_peaks_is_judged_by_its_own_lifts(
    noise: NoiseModel,
) -> None:
    of, pooled = recent(noise), recent(noise).thresholds
    for _ in range(LEAST_LIFTS - 1):
        of.count(rows([1.0] * 10, ratio=0.05))
    np.testing.assert_array_equal(of.thresholds, pooled)
    of.count(rows([1.0] * 10, ratio=0.05))
    share = of.thresholds / pooled
    assert (share[:AFTER] < 0.3).all(), "it stays far below"
    assert (share[AFTER] == 1.0).all(), "lifts say nothing of what comes after the turn"
    of.count(rows([1.0] * 10, ratio=5.0))
    np.testing.assert_allclose(of.thresholds / pooled, share, rtol=0.05)  # one that struck
    for _ in range(OWN_LIFTS):
        of.count(rows([1.0] * 10, ratio=2.0))
    np.testing.assert_array_equal(of.thresholds, pooled)  # never above


def test_ticks_after_the_turn_of_a_leg_that_hangs_have_a_threshold_of_their_own(
    noise: NoiseModel,
) -> None:
    """A foot that is high says nothing of one that is to touch."""
    pooled, of, high = recent(noise).thresholds, recent(noise), recent(noise)
    descent = rows([1.0] * 6 + [9.0] * 4, ratio=0.1, lift=False)
    descent.records["after"][6:], descent.records["ratio"][6:] = True, 3.0
    for n in range(LEAST_LIFTS):
        assert not of.after_known, n
        of.count(descent)
    assert of.after_known
    share = of.thresholds / pooled
    assert (share[AFTER] > 3.0).all(), "above its own largest"
    assert (share[DESCENT] == 1.0).all(), "which is not that of the descent"
    descent.records["high"][6:] = True
    for _ in range(LEAST_LIFTS):
        high.count(descent)
    assert not high.after_known
