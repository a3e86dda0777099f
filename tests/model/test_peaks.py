"""Thresholds after the turn to stance, from the largest statistics of free ticks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from adaptive_contact.model.noise import WINDOWS
from adaptive_contact.model.peaks import LEAST_TICKS, Peaks
from adaptive_contact.robot import ROBOT_HOUR_TICKS

J = 3
RATE = 200.0  # per hour: 200 / 540,000 / 3 of the ticks exceed it in each window


@pytest.mark.parametrize("wider", [1.0, 4.0])
@pytest.mark.parametrize("ticks", [500, 5000])
def test_the_rate_of_scaled_chi_square_is_kept_within_a_factor(wider: float, ticks: int) -> None:
    rng = np.random.default_rng(ticks)
    per_tick = RATE / ROBOT_HOUR_TICKS / len(WINDOWS)
    rates = []
    for _ in range(200):
        found = Peaks.of(wider * rng.chisquare(J, (ticks, len(WINDOWS))), J)
        assert found is not None
        rates.append(chi2.sf(found.thresholds(RATE) / wider, J) / per_tick)
    assert 0.3 < np.median(rates) < 3.0


def test_more_free_ticks_do_not_make_it_duller() -> None:
    rng = np.random.default_rng(2)

    def median(ticks: int) -> float:
        made = [Peaks.of(rng.chisquare(J, (ticks, len(WINDOWS))), J) for _ in range(200)]
        return float(np.median([of.thresholds(1.0) for of in made if of is not None]))

    assert median(30_000) < 1.05 * median(1_000)


def test_few_ticks_say_nothing_and_a_missing_window_is_left_out() -> None:
    values = np.ones((LEAST_TICKS, len(WINDOWS)))
    assert Peaks.of(values[1:], J) is None
    values[0, 2] = np.nan
    found = Peaks.of(values, J)
    assert found is not None
    assert found.largest == pytest.approx(1.0)
