"""Baseline detectors against slow reference mathematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.core.detect.contact import swing_tick
from adaptive_contact.core.detect.layout import DECIDED, TOUCHED, new_legs
from adaptive_contact.model.glr import statistic
from adaptive_contact.model.noise import WINDOWS, context
from adaptive_contact_studies.paper.detectors import (
    JUDGED_AFTER_TICKS,
    Calibration,
    Motion,
    Prediction,
    alarm_ticks,
    learn_noise,
    likelihood_ratio,
    rule,
    tracking_error,
)

QUANTUM = 0.005


def walk(seed: int, n: int = 4000, swing: int = 20, hold: int = 3) -> tuple[Motion, Prediction]:
    rng = np.random.default_rng(seed)
    desired = np.cumsum(rng.normal(scale=0.03, size=(n, 3)), axis=0)
    noise = rng.normal(scale=QUANTUM / 2, size=(n, 3))
    measured = np.roll(desired, 3, axis=0) + noise
    residual = rng.normal(scale=QUANTUM, size=(n, 3)) @ np.array(
        [[1.0, 0.3, 0.0], [0.0, 1.0, -0.4], [0.0, 0.0, 1.0]]
    )
    increment = rng.normal(scale=0.03, size=(n, 3))
    tick = np.arange(n) % (swing + hold)
    swing_tick = np.where(tick < swing, tick + 1, 0)
    direction = (tick >= swing // 2).astype(np.int64)
    return Motion(measured, desired, swing_tick, direction), Prediction(residual, increment)


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
    motion, prediction = walk(1, n=60)
    paper = rule(prediction.residual)
    naive = rule(np.diff(motion.measured, axis=0, prepend=np.nan))
    lag = 2
    error = tracking_error(motion, lag)
    e, m, d = prediction.residual, motion.measured, motion.desired
    for k in range(4, 60):
        for j in range(3):
            assert paper[k, j] == pytest.approx(abs(abs(e[k, j]) - abs(e[k - 1, j])))
            steps = abs(m[k, j] - m[k - 1, j]), abs(m[k - 1, j] - m[k - 2, j])
            assert naive[k, j] == pytest.approx(abs(steps[0] - steps[1]))
            assert error[k, j] == pytest.approx(abs(d[k - 1 - lag, j] - m[k, j]))
    assert np.isnan(paper[0]).all()
    assert np.isnan(naive[:2]).all()
    assert np.isnan(error[: lag + 1]).all()


def test_likelihood_ratio_equals_the_online_statistic_tick_by_tick() -> None:
    motion, prediction = walk(2)
    noise = learn_noise(motion, prediction, motion.judged, QUANTUM)
    values = likelihood_ratio(motion, prediction, noise, QUANTUM)
    for k in range(40, 200):
        usable = min(max(motion.swing_tick[k] - JUDGED_AFTER_TICKS, 0), len(WINDOWS))
        if usable == 0:
            assert np.isnan(values[k]).all()
            continue
        where = context(
            motion.desired[k - 1], motion.desired[k - 2], motion.direction[k - 1], QUANTUM
        )
        expected = statistic(
            prediction.residual[k : k - 3 : -1],
            prediction.increment[k : k - 3 : -1],
            noise.whiten[int(where)],
            np.array(usable),
        ).value
        np.testing.assert_allclose(values[k], expected)


def test_thresholds_hold_the_rate_they_aim_at() -> None:
    rng = np.random.default_rng(4)
    calibration = Calibration.of([rng.exponential(size=(100_000, 2)) for _ in range(3)])
    rate = 1e-4
    score = calibration.score(rng.exponential(size=(400_000, 2)), rate)
    assert np.mean(score > 1.0) == pytest.approx(rate, rel=0.35)
    only = replace(calibration, channels=(1,))
    # Its share is the whole of the rate: a lower threshold.
    assert only.score(np.ones((1, 2)), rate) > calibration.score(np.ones((1, 2)), rate)
