"""Exact intervals against scipy's own tests, and against what they must mean."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from adaptive_contact.score import clopper_pearson, poisson_mean


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 3000), st.integers(0, 3000), st.sampled_from([0.9, 0.95, 0.99]))
def test_clopper_pearson_equals_scipy(a: int, b: int, confidence: float) -> None:
    successes, trials = min(a, b), max(a, b, 1)
    expected = stats.binomtest(successes, trials).proportion_ci(confidence, method="exact")
    assert clopper_pearson(successes, trials, confidence) == pytest.approx(
        (expected.low, expected.high), abs=1e-9
    )


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2000))
def test_poisson_ends_leave_half_of_5_percent_outside(count: int) -> None:
    low, high = poisson_mean(count)
    assert stats.poisson.cdf(count, high) == pytest.approx(0.025, rel=1e-6)
    if count:
        assert stats.poisson.sf(count - 1, low) == pytest.approx(0.025, rel=1e-6)
    else:
        assert low == 0.0


def test_ends_of_the_range() -> None:
    assert clopper_pearson(0, 0) == (0.0, 1.0)
    assert clopper_pearson(0, 10) == pytest.approx((0.0, 0.30849711))
    assert clopper_pearson(10, 10) == pytest.approx((0.69150289, 1.0))
    assert poisson_mean(0) == pytest.approx((0.0, 3.68887945))


@pytest.mark.parametrize(("successes", "trials"), [(-1, 3), (4, 3)])
def test_impossible_counts_raise(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="no share"):
        clopper_pearson(successes, trials)


def test_negative_count_raises() -> None:
    with pytest.raises(ValueError, match="cannot be -1"):
        poisson_mean(-1)
