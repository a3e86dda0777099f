"""Touches that the foot belies: a leg that only comes down differently is not called valid."""

from __future__ import annotations

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
        began = touches.take(swing)
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


@pytest.mark.parametrize("share", [0.2, 0.4, 0.8])
def test_a_leg_that_only_comes_down_differently_is_ambiguous(
    robot: Robot, baseline: Baseline, share: float
) -> None:
    """No lift shows it, each descent looks like a touch, and its owner has to be told."""
    changed = range(60, 130)
    run = FakeLeg(seed=5).run(170, falling=lambda n: share if n in changed else 1.0)
    status, notes, _ = followed(ContactLearner(robot, "rf", baseline), samples(*run[:3]))
    assert set(status[:80]) == {"valid"}
    assert set(status[92:129]) == {"ambiguous"}
    assert notes[100] is not None
    assert "a change that only descents show" in notes[100]
    assert set(status[150:]) == {"valid"}
    assert notes[-1] is None


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
