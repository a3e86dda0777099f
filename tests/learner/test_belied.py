"""Touches that the foot belies: a leg that only comes down differently is not called valid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from adaptive_contact import ContactLearner
from adaptive_contact.core.learn.drift import EARLY_BEGIN, EARLY_END, EARLY_SWINGS, EarlyContacts
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot

from .conftest import FakeLeg, followed, samples

SHARES = st.floats(0.3, 1.0).flatmap(
    lambda share: st.lists(st.floats(0.0, 1.0).map(lambda x: x < share), max_size=120)
)


@given(SHARES)
@example([True] * EARLY_BEGIN + [False] * 10 + [True] * 3 + [False] * EARLY_SWINGS)
def test_the_doubt_begins_with_three_quarters_of_the_swings_and_ends_with_half(
    swings: list[bool],
) -> None:
    touches, told = EarlyContacts(), False
    for k, swing in enumerate(swings):
        began = touches.count_swing(swing)
        count = sum(swings[max(k + 1 - EARLY_SWINGS, 0) : k + 1])
        now = count >= EARLY_BEGIN or (told and count > EARLY_END)
        assert (touches.reported, began) == (now, now and not told)
        assert (touches.note is None) == (not now)
        told = now
        again = EarlyContacts()
        again.restore(touches.snapshot())
        assert (again.reported, again.note) == (touches.reported, touches.note)
    touches.forget()
    assert not touches.reported
    assert touches.note is None


@pytest.mark.parametrize("tick", [16, 18, 20])
def test_swings_that_all_end_in_a_touch_are_no_such_change(
    robot: Robot, baseline: Baseline, tick: int
) -> None:
    run = FakeLeg(seed=6).run(150, touch=lambda n: tick if n >= 20 else None)
    status, _, confirmed = followed(ContactLearner(robot, "rf", baseline), samples(*run[:3]))
    assert set(status) == {"valid"}
    assert sum(map(len, confirmed[100:])) > 100


@pytest.mark.parametrize("saved", [None, 3, {"lately": 4}, {"lately": [1] * 5, "told": True}])
def test_a_snapshot_that_knows_nothing_of_it_is_no_reason_for_doubt(saved: object) -> None:
    touches = EarlyContacts()
    touches.restore(saved)
    assert not touches.reported


def test_a_change_that_is_known_ends_the_doubt(robot: Robot, baseline: Baseline) -> None:
    """The lifts show it, too: it is followed, and what was heard before was of another leg."""
    run = FakeLeg(seed=5).run(
        150,
        change=lambda n: 0.7 if n >= 110 else 1.0,
        falling=lambda n: 0.4 if 60 <= n < 110 else 1.0,
    )
    status, notes, _ = followed(ContactLearner(robot, "rf", baseline), samples(*run[:3]))
    assert set(status[95:109]) == {"ambiguous"}
    assert "adapting" in status[110:116]
    assert status[-1] == "valid"
    assert notes[-1] is None


@pytest.mark.parametrize("came_down", [EARLY_BEGIN - 1, EARLY_BEGIN])
def test_touches_are_refuted_where_the_foot_came_down_as_often_as_is_too_many(
    came_down: int,
) -> None:
    touches = EarlyContacts()
    for k in range(EARLY_SWINGS):
        touches.count_swing(True, refuted=k < came_down)
    assert touches.refuted == (came_down == EARLY_BEGIN)


def sticking(measured: np.ndarray, since: int) -> np.ndarray:
    """From a swing on, feet that stay two ticks behind at the top, and come down all the same."""
    k = np.arange(len(measured))
    tick = k % 28
    late = (k // 28 >= since) & (tick >= 12) & (tick < 24)
    at = k - np.where(late, 2.0 * np.sin(np.pi * (tick - 12) / 12), 0.0)
    read = np.stack([np.interp(at, k, joint) for joint in measured.T], axis=1)
    return np.round(read / 0.005) * 0.005


def test_a_leg_from_nothing_whose_feet_refute_its_touches_begins_again(robot: Robot) -> None:
    """Else it would report nothing until its owner fits a baseline: for hours."""
    measured, desired, swing, _ = FakeLeg(seed=6, gain=0.6, noise=0.001).run(260)
    learner = ContactLearner(robot, "rf")
    stream = samples(sticking(measured, 80), desired, swing)
    told = [learner.update(sample) for sample in stream[: 28 * 140]]
    assert sum(event is not None and event.contact for event in told) > EARLY_BEGIN
    told = [learner.update(sample) for sample in stream[28 * 140 :]]
    assert learner.status.status == "valid"
    assert not any(event is not None and event.contact for event in told[-28 * 40 :])
