"""Baseline detectors against slow reference mathematics."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.core.detect.contact import swing_tick
from adaptive_contact.core.detect.layout import DECIDED, TOUCHED, new_legs
from adaptive_contact_studies.paper.detectors import (
    Calibration,
    Evidence,
    alarm_ticks,
    rule,
    tracking_error,
)


def reference_alarms(
    score: np.ndarray, swing: np.ndarray, threshold: float, descending: np.ndarray
) -> list[int]:
    """The state machine of the product, tick by tick, on one score."""
    legs = new_legs(1).view(np.recarray)
    found, before = [], -1
    for k in range(len(score)):
        if swing[k] != before:
            before = swing[k]
            legs[0] = new_legs(1)[0]
            legs[0].period_ns = 20_000_000
        if swing[k] < 0:
            continue
        value = score[k] / threshold
        legs[0].found, legs[0].at_ns = 0, k
        swing_tick(legs[0], value, value, k, bool(descending[k]))
        if legs[0].found & DECIDED and legs[0].found & TOUCHED:
            found.append(k)
    return found


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.05, 3.0), st.floats(0.0, 0.4))
def test_alarms_of_a_stream_equal_those_of_the_state_machine(
    seed: int, threshold: float, missing: float
) -> None:
    rng = np.random.default_rng(seed)
    n = 300
    score = rng.exponential(size=n)
    score[rng.random(n) < missing] = np.nan
    tick = np.arange(n)
    swing = np.where(tick % 23 < 20, tick // 23, -1)
    descending = tick % 23 >= rng.integers(5, 20)
    assert alarm_ticks(score, swing, threshold, descending).tolist() == reference_alarms(
        score, swing, threshold, descending
    )


def test_rules_tick_by_tick() -> None:
    rng = np.random.default_rng(1)
    e, m, d = rng.normal(scale=0.01, size=(3, 60, 3))
    paper = rule(e)
    naive = rule(np.diff(m, axis=0, prepend=np.nan))
    lag = 2
    error = tracking_error(cast(Evidence, SimpleNamespace(measured=m, desired=d)), lag)
    for k in range(4, 60):
        for j in range(3):
            assert paper[k, j] == pytest.approx(abs(abs(e[k, j]) - abs(e[k - 1, j])))
            steps = abs(m[k, j] - m[k - 1, j]), abs(m[k - 1, j] - m[k - 2, j])
            assert naive[k, j] == pytest.approx(abs(steps[0] - steps[1]))
            assert error[k, j] == pytest.approx(abs(d[k - 1 - lag, j] - m[k, j]))
    assert np.isnan(paper[0]).all()
    assert np.isnan(naive[:2]).all()
    assert np.isnan(error[: lag + 1]).all()


def test_thresholds_hold_the_rate_they_aim_at() -> None:
    rng = np.random.default_rng(4)
    calibration = Calibration.from_statistics(
        [rng.exponential(size=(100_000, 2)) for _ in range(3)]
    )
    rate = 1e-4
    score = calibration.score(rng.exponential(size=(400_000, 2)), rate)
    assert np.mean(score > 1.0) == pytest.approx(rate, rel=0.35)
    only = replace(calibration, channels=(1,))
    # Its share is the whole of the rate: a lower threshold.
    assert only.score(np.ones((1, 2)), rate) > calibration.score(np.ones((1, 2)), rate)
