"""Touches that the foot belies: a leg that only comes down differently is not called valid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from adaptive_contact import ContactLearner
from adaptive_contact.learn.drift import EARLY_BEGIN, EARLY_END, EARLY_SWINGS, EarlyContacts
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.robot.kinematics import inverse
from adaptive_contact.wire import ServoSample

from .conftest import LENGTHS, TOML, FakeLeg, samples
from .drivers import Swings

TOP, GROUND = -0.04, -0.10
RISE = [GROUND + (TOP - GROUND) * k / 10 for k in range(11)]
FALL = [TOP + (GROUND - TOP) * k / 14 for k in range(1, 15)]
STANCE = 4


def stream(heights: Sequence[float], commanded: Sequence[float]) -> list[ServoSample]:
    """A swing after a stance, the foot's height and its command's given; then the next stance.

    Args:
        heights: of the foot, of the swing's samples, m.
        commanded: of its command.
    """
    foot = [GROUND] * STANCE + [*heights, heights[-1]]
    goal = [GROUND] * STANCE + [*commanded, commanded[-1]]
    return [
        ServoSample(
            t_ns=k,
            seq=k,
            measured=inverse(np.array([0.16, 0.0, foot[k]]), LENGTHS).tolist(),
            desired=inverse(np.array([0.16, 0.0, goal[k]]), LENGTHS).tolist(),
            phase="swing" if STANCE <= k < len(foot) - 1 else "stance",
        )
        for k in range(len(foot))
    ]


def delayed(commanded: Sequence[float], lag: int = 3) -> list[float]:
    """Where a free foot is."""
    return [GROUND] * lag + list(commanded[: len(commanded) - lag])


def belied(
    watch: Swings, heights: Sequence[float], commanded: Sequence[float], onset: int | None
) -> bool | None:
    """Play a swing; a touch is told two ticks after its onset."""
    told = whole = False
    for k, sample in enumerate(stream(heights, commanded)):
        watch.follow(sample)
        if k == len(heights) + STANCE:
            break
        whole = bool(watch.place.record["whole"])
        watch.observe(sample.measured)
        if onset is not None and k == STANCE + onset + 2:
            watch.judge.touched(2)
            told = True
    assert told == (onset is not None)
    return belied_of(watch, whole=whole)


def belied_of(watch: Swings, *, whole: bool) -> bool | None:
    """What the swing in hand shows where it ends."""
    leg = watch.place.record
    leg["resolved_whole"], leg["resolved_rise"] = whole, leg["rise"]
    leg["resolved_fallen"] = leg["fallen"]
    return watch.judge.touched_early()


COMMANDED = [*RISE, *FALL]


def stopped(at: int) -> list[float]:
    """A free foot up to a tick, which then stays where it is."""
    free = delayed(COMMANDED)
    return [*free[: at + 1], *[free[at]] * (len(free) - at - 1)]


@pytest.mark.parametrize(
    ("heights", "onset", "expected"),
    [
        pytest.param(delayed(COMMANDED), None, False, id="no touch"),
        pytest.param(stopped(19), 19, False, id="stopped, having come down by 40 % of its rise"),
        pytest.param(stopped(21), 21, False, id="stopped half way down"),
        pytest.param(delayed(COMMANDED), 18, False, id="just beyond a third"),
        pytest.param(delayed(COMMANDED), 17, True, id="just before it"),
        pytest.param(stopped(15), 15, True, id="stopped at its top"),
        pytest.param(stopped(10), 10, True, id="stopped on its way up"),
        pytest.param([GROUND] * len(COMMANDED), 18, None, id="the foot never rose"),
    ],
)
def test_a_foot_belies_a_touch_where_it_has_hardly_begun_to_come_down(
    robot: Robot, heights: list[float], onset: int | None, expected: bool | None
) -> None:
    assert belied(Swings(robot), heights, COMMANDED, onset) is expected


def test_the_first_touch_of_a_swing_counts(robot: Robot) -> None:
    watch = Swings(robot)
    for k, sample in enumerate(stream(delayed(COMMANDED), COMMANDED)):
        watch.follow(sample)
        if sample.phase == "swing" or k < STANCE:
            watch.observe(sample.measured)
        if k in (STANCE + 17, STANCE + 23):
            watch.judge.touched(2)
    assert belied_of(watch, whole=True) is True


def test_a_touch_of_the_swing_before_says_nothing(robot: Robot) -> None:
    watch = Swings(robot)
    assert belied(watch, delayed(COMMANDED), COMMANDED, 15) is True
    assert belied(watch, delayed(COMMANDED), COMMANDED, None) is False


def test_without_geometry_nobody_can_tell() -> None:
    blind = parse_robot(
        "\n".join(line for line in TOML.splitlines() if "lengths" not in line), source="blind"
    )
    assert belied(Swings(blind), delayed(COMMANDED), COMMANDED, 15) is None


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


def followed(
    robot: Robot, baseline: Baseline, run: tuple[np.ndarray, ...]
) -> tuple[list[str], list[str | None], list[int]]:
    """Status, note and confirmed ticks after each swing."""
    learner = ContactLearner(robot, "rf", baseline)
    status: list[str] = []
    notes: list[str | None] = []
    confirmed: list[int] = []
    for k, sample in enumerate(samples(*run[:3])):
        learner.update(sample)
        if k % 28 == 27:
            status.append(learner.status.status)
            notes.append(learner.status.note)
            confirmed.append(len(learner.drain_confirmed()))
    return status, notes, confirmed


@pytest.mark.parametrize("share", [0.2, 0.4, 0.8])
def test_a_leg_that_only_comes_down_differently_is_ambiguous(
    robot: Robot, baseline: Baseline, share: float
) -> None:
    """No lift shows it, each descent looks like a touch, and its owner has to be told."""
    changed = range(60, 130)
    run = FakeLeg(seed=5).run(170, falling=lambda n: share if n in changed else 1.0)
    status, notes, _ = followed(robot, baseline, run)
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
    status, _, confirmed = followed(robot, baseline, run)
    assert set(status) == {"valid"}
    assert sum(confirmed[100:]) > 100


def test_what_was_heard_outlives_a_restart_and_is_kept_from_refits(
    robot: Robot, baseline: Baseline
) -> None:
    run = FakeLeg(seed=5).run(120, falling=lambda n: 0.4 if n >= 60 else 1.0)
    stream, learner = samples(*run[:3]), ContactLearner(robot, "rf", baseline)
    for sample in stream[: 28 * 100]:
        learner.update(sample)
    assert learner.status.status == "ambiguous"
    adapter = learner.lifecycle.adapter
    assert adapter is not None
    assert len(adapter.candidate.contacts) == 0
    again = ContactLearner(robot, "rf", baseline)
    assert again.restore(learner.snapshot()) is None
    assert (again.status.status, again.status.note) == ("ambiguous", learner.status.note)
    for sample in stream[28 * 100 :]:
        again.update(sample)
    assert again.status.status == "ambiguous"


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
    status, notes, _ = followed(robot, baseline, run)
    assert set(status[95:109]) == {"ambiguous"}
    assert "adapting" in status[110:116]
    assert status[-1] == "valid"
    assert notes[-1] is None
