"""Readings that are missing, or repeat the last one."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot

from .drivers import Readings

STEP = np.array([0.05, -0.04, 0.03])  # what the model expects of every tick, in the tests


@pytest.fixture
def tracker(robot: Robot, baseline: Baseline) -> Readings:
    """A leg in full motion: every joint is believed to move, and has."""
    readings = Readings(robot, baseline, STEP)
    for k in range(6):
        readings.move(k * STEP)
    return readings


def move(tracker: Readings, reading: np.ndarray, valid: list[bool] | None = None) -> np.ndarray:
    """One tick; the residual it left."""
    return tracker.move(reading, valid)


def test_a_repeated_joint_waits_two_ticks_while_the_others_move(tracker: Readings) -> None:
    at = 5 * STEP
    for tick in (1, 2):
        stuck = at + tick * STEP
        stuck[1] = at[1]
        np.testing.assert_allclose(move(tracker, stuck), 0.0, atol=1e-12)
    stuck = at + 3 * STEP
    stuck[1] = at[1]
    assert move(tracker, stuck)[1] == pytest.approx(-3 * STEP[1]), "and is believed in the third"


def test_a_reading_known_to_be_bad_uses_up_no_doubt(tracker: Readings) -> None:
    at = 5 * STEP
    for tick, valid in ((1, [True, False, True]), (2, None), (3, None)):
        stuck = at + tick * STEP
        stuck[1] = at[1]
        np.testing.assert_allclose(move(tracker, stuck, valid), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("leverage", "replaced"), [(0.5, True), (1.0, True), (6.5, True), (8.0, False)]
)
def test_a_joint_that_stands_is_judged_where_the_model_errs_by_more_than_it_expects(
    tracker: Readings, leverage: float, replaced: bool
) -> None:
    """It expects 8 steps; 3 make a repeated reading stale, times the root of the leverage."""
    tracker.leave_range(leverage)
    at = 5 * STEP
    stands = at + STEP
    stands[1] = at[1]
    residual = move(tracker, stands)
    assert tracker.substituted is replaced
    assert tracker.unlearned is not replaced, "but not learned: a foot may be held fast"
    assert residual[1] == pytest.approx(0.0 if replaced else -STEP[1], abs=1e-12)
    move(tracker, at + 2 * STEP)
    assert not tracker.unlearned


def test_a_leg_that_stops_as_a_whole_waits_one_tick(tracker: Readings) -> None:
    at = 5 * STEP
    move(tracker, at)
    np.testing.assert_allclose(move(tracker, at), -2 * STEP, atol=1e-12)


def test_a_joint_that_stops_while_another_is_held_back_waits_one_tick(tracker: Readings) -> None:
    at = 5 * STEP
    for tick in (1, 2):
        stopped = at + tick * STEP
        stopped[1] = at[1]
        stopped[2] -= 0.02 * tick  # four steps short, again and again: this is ground
        residual = move(tracker, stopped)
    assert abs(residual[1]) > 1.5 * abs(STEP[1])


FAULT = -np.pi  # what some buses say for "no answer"


def test_an_impossible_reading_that_lasts_is_bad_for_three_ticks_and_then_a_new_truth(
    tracker: Readings,
) -> None:
    """As long as it is bad, it is measured against where the joint was, not against itself."""
    at = 5 * STEP
    for tick in (1, 2, 3):
        wild = at + tick * STEP
        wild[1] = FAULT
        np.testing.assert_allclose(move(tracker, wild), 0.0, atol=1e-12)
        assert tracker.substituted
        assert tracker.usable > 0
    wild = at + 4 * STEP
    wild[1] = FAULT
    tracker.observe(wild)
    assert tracker.usable == 0, "begun anew: nothing is judged by it before the window is full"
    assert not tracker.full


def test_a_horn_that_slips_is_begun_anew_from(tracker: Readings) -> None:
    at = 5 * STEP
    slipped = np.array([0.0, 0.6, 0.0])
    for tick in (1, 2, 3):
        np.testing.assert_allclose(move(tracker, at + tick * STEP + slipped), 0.0, atol=1e-12)
    tracker.observe(at + 4 * STEP + slipped)
    assert tracker.usable == 0


def test_a_good_reading_after_one_known_to_be_bad_is_good(tracker: Readings) -> None:
    """However far from it; every other one may be bad for ever."""
    at = 5 * STEP
    for tick in range(1, 21):
        reading = at + tick * STEP
        valid = None
        if tick % 2:
            reading[1], valid = FAULT, [True, False, True]
        np.testing.assert_allclose(move(tracker, reading, valid), 0.0, atol=1e-12)
        assert tracker.substituted is bool(tick % 2)
        assert tracker.usable > 0


def test_a_joint_that_is_elsewhere_is_believed_beside_readings_known_to_be_bad(
    tracker: Readings,
) -> None:
    """Every third of its readings is flagged; the others say the same, again and again."""
    at = 5 * STEP
    slipped = np.array([0.0, 0.8, 0.0])
    begun_anew = []
    for tick in range(1, 10):
        valid = [True, False, True] if tick % 3 == 0 else None
        move(tracker, at + tick * STEP + slipped, valid)
        if not tracker.full:
            begun_anew.append(tick)
    assert begun_anew
    assert begun_anew[0] == 5, "the fourth reading that says so"
