"""Thresholds from the largest statistics of free ticks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from adaptive_contact.model.noise import AFTER, DESCENT, DIRECTIONS, LIFT, WINDOWS
from adaptive_contact.model.peaks import LEAST_TICKS, MARGIN, Peaks
from adaptive_contact.robot import ROBOT_HOUR_TICKS

RATE = 200.0  # per hour: 200 / 540,000 / 3 of the ticks exceed it in each window


def of(values: NDArray[np.float64], direction: int = AFTER) -> Peaks | None:
    return Peaks.from_values(values, np.full(len(values), direction))


def free(rng: np.random.Generator, *shape: int) -> NDArray[np.float64]:
    """Draw the statistic of Gaussian residuals: half of them go with the motion."""
    return np.asarray(np.maximum(rng.standard_normal(shape), 0.0) ** 2)


def thresholds(peaks: Peaks | None, rate: float) -> NDArray[np.float64]:
    return peaks.thresholds(np.full(DIRECTIONS, rate))


@pytest.mark.parametrize(("direction", "margin"), [(AFTER, 1.0), (DESCENT, MARGIN)])
@pytest.mark.parametrize("wider", [1.0, 4.0])
@pytest.mark.parametrize("ticks", [500, 5000])
def test_the_rate_of_scaled_noise_is_kept_within_a_factor(
    wider: float, ticks: int, direction: int, margin: float
) -> None:
    rng = np.random.default_rng(ticks)
    per_tick = RATE / ROBOT_HOUR_TICKS / len(WINDOWS)
    rates = []
    for _ in range(200):
        found = of(wider * free(rng, ticks, len(WINDOWS)), direction)
        limits = thresholds(found, RATE)[direction] / margin
        rates.append(norm.sf(np.sqrt(limits / wider)) / per_tick)
    assert 0.3 < np.median(rates) < 3.0


def test_more_free_ticks_do_not_make_it_duller() -> None:
    rng = np.random.default_rng(2)

    def median(ticks: int) -> float:
        made = [of(free(rng, ticks, len(WINDOWS))) for _ in range(200)]
        return float(np.median([thresholds(peaks, 1.0)[AFTER] for peaks in made]))

    assert median(30_000) < 1.05 * median(1_000)


def test_few_ticks_say_nothing_and_a_missing_window_is_left_out() -> None:
    values = np.ones((LEAST_TICKS, len(WINDOWS)))
    assert of(values[1:]) is None
    values[0, 2] = np.nan
    found = of(values)
    assert found.largest[AFTER] == pytest.approx(1.0)
    assert np.isnan(found.largest[:AFTER]).all()
    values[:, 2] = np.nan
    assert of(values) is None


@pytest.mark.parametrize("ticks", [3, 8, 30])
@pytest.mark.parametrize("rougher", [1.0, 6.0])
def test_lifts_of_a_leg_that_has_grown_rougher_show_by_how_much(ticks: int, rougher: float) -> None:
    rng = np.random.default_rng(ticks)
    found = of(free(rng, 3000, len(WINDOWS)), LIFT)
    maxima = rougher * free(rng, 500, ticks).max(axis=1)
    assert np.median([found.excess(value, ticks) for value in maxima]) == pytest.approx(
        rougher, rel=0.5
    )
