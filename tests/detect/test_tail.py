"""The fitted tail against distributions whose quantiles are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from adaptive_contact.errors import IdentificationError, TooLittleDataError
from adaptive_contact.model.tail import PRIOR_EXCEEDANCES, PRIOR_SHAPE, Tail, fit_tail


def exceedance(tail: Tail, value: float) -> float:
    """Probability that a free tick's statistic is above a value."""
    y = max(value - tail.level, 0.0)
    return float(tail.rate * stats.genpareto(tail.shape, scale=tail.scale).sf(y))


@pytest.mark.parametrize("shape", [-0.1, 0.0, 0.2, 0.4])
def test_the_shape_of_a_pareto_tail_is_found(shape: float) -> None:
    values = stats.genpareto(shape, scale=2.0).rvs(400_000, random_state=1)
    tail = fit_tail(values)
    # Asymptotic standard deviation of the estimator (Hosking and Wallis 1987, with k = -shape).
    k, n = -shape, 4000
    variance = (1 + k) * (2 + k) ** 2 * (1 + k + 2 * k**2) / ((1 + 2 * k) * (3 + 2 * k)) / n
    # The prior pulls by its share of the exceedances.
    expected = (n * shape + PRIOR_EXCEEDANCES * PRIOR_SHAPE) / (n + PRIOR_EXCEEDANCES)
    assert tail.shape == pytest.approx(expected, abs=3.5 * variance**0.5)
    assert tail.rate == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize("law", [stats.chi2(3), stats.norm(), stats.expon(), stats.t(8)])
def test_an_extrapolated_quantile_is_near_the_true_one(law: stats.rv_continuous) -> None:
    errors = []
    for seed in range(5):
        tail = fit_tail(law.rvs(100_000, random_state=seed))
        q = tail.quantile(2e-6)
        errors.append(np.log10(law.sf(q) / 2e-6))
        assert exceedance(tail, q) == pytest.approx(2e-6, rel=1e-6)
    # Within a factor of ten each, of four in the median: what 10^5 ticks can give.
    assert np.abs(errors).max() < 1.0
    assert abs(np.median(errors)) < np.log10(4)


def test_nan_is_left_out_and_order_does_not_matter() -> None:
    values = np.random.default_rng(0).exponential(size=20_000)
    dirty = np.concatenate([values[::-1], [np.nan] * 100])
    assert fit_tail(values) == fit_tail(dirty)


def test_too_few_ticks_are_refused() -> None:
    with pytest.raises(TooLittleDataError, match="999 free swing ticks are too few") as told:
        fit_tail(np.arange(999.0))
    assert (told.value.have, told.value.needed) == (999, 1000)


@pytest.mark.parametrize("ticks", [1000, 3000])
def test_of_few_ticks_a_threshold_is_cautious(ticks: int) -> None:
    """It is fitted to more than their largest hundredth, and still seldom too low."""
    law = stats.chi2(1)
    found = [
        fit_tail(law.rvs(ticks, random_state=seed)).cautious().quantile(1e-6) for seed in range(60)
    ]
    assert np.mean(np.array(found) < law.isf(1e-6)) <= 0.05
    assert np.median(found) < 3.0 * law.isf(1e-6)


def test_a_constant_statistic_has_a_threshold_above_it() -> None:
    tail = fit_tail(np.ones(10_000))
    assert tail.quantile(1e-6) > 1.0


def test_probabilities_outside_the_tail_are_refused() -> None:
    tail = fit_tail(np.random.default_rng(0).exponential(size=20_000))
    for p in (0.0, -1.0, 0.5):
        with pytest.raises(IdentificationError, match="outside"):
            tail.quantile(p)
    assert exceedance(tail, tail.level) == pytest.approx(tail.rate)
    assert exceedance(tail, -1e9) == pytest.approx(tail.rate)
