"""Touches that the foot belies: a leg that only comes down differently is not called valid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact import ContactLearner
from adaptive_contact.adapt import Baseline
from adaptive_contact.adapt.belied import BEGIN, END, SWINGS, BeliedTouches
from adaptive_contact.adapt.swing import SwingWatch
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.robot.geometry import inverse
from adaptive_contact.wire import ServoSample

from .conftest import LENGTHS, TOML, FakeLeg, samples

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
    watch: SwingWatch, heights: Sequence[float], commanded: Sequence[float], onset: int | None
) -> bool | None:
    """Play a swing; a touch is told two ticks after its onset."""
    for k, sample in enumerate(stream(heights, commanded)):
        watch.follow(sample)
        if k == len(heights) + STANCE:
            break
        watch.observe(sample.measured)
        watch.command()
        if onset is not None and k == STANCE + onset + 2:
            watch.touched(2)
    return watch.touch_belied()


COMMANDED = [*RISE, *FALL]


def stopped(at: int) -> list[float]:
    """A free foot up to a tick, which then stays where it is."""
    free = delayed(COMMANDED)
    return [*free[: at + 1], *[free[at]] * (len(free) - at - 1)]


@pytest.mark.parametrize(
    ("heights", "onset", "expected"),
    [
        pytest.param(delayed(COMMANDED), None, False, id="no touch"),
        pytest.param(stopped(21), 21, False, id="stopped half way down"),
        pytest.param(delayed(COMMANDED), 18, True, id="went on half way down"),
        pytest.param(stopped(15), 15, True, id="stopped at its top"),
        pytest.param(delayed(COMMANDED), 15, True, id="went on at its top"),
        pytest.param(delayed(COMMANDED), 24, False, id="near the end, nothing was asked any more"),
        pytest.param([GROUND] * len(COMMANDED), 18, None, id="the foot never rose"),
    ],
)
def test_a_foot_belies_a_touch_at_its_top_or_one_it_goes_on_through(
    robot: Robot, heights: list[float], onset: int | None, expected: bool | None
) -> None:
    assert belied(SwingWatch(robot.leg("rf")), heights, COMMANDED, onset) is expected


@pytest.mark.parametrize("depth_mm", [0, 8, 14])
def test_ground_that_gives_is_a_touch(robot: Robot, depth_mm: int) -> None:
    """As deep as a robot sinks into the simulator's soft ground, at half of what is asked."""
    free, at = delayed(COMMANDED), 19
    deepest = free[at] - depth_mm / 1000
    sunk = [max(free[at] - (free[at] - h) / 2, deepest) for h in free]
    heights = [*free[:at], *sunk[at:]]
    assert belied(SwingWatch(robot.leg("rf")), heights, COMMANDED, at) is False


def test_a_touch_of_the_swing_before_says_nothing(robot: Robot) -> None:
    watch = SwingWatch(robot.leg("rf"))
    assert belied(watch, delayed(COMMANDED), COMMANDED, 15) is True
    assert belied(watch, delayed(COMMANDED), COMMANDED, None) is False


def test_without_geometry_nobody_can_tell() -> None:
    blind = parse_robot(
        "\n".join(line for line in TOML.splitlines() if "lengths" not in line), source="blind"
    )
    assert belied(SwingWatch(blind.leg("rf")), delayed(COMMANDED), COMMANDED, 15) is None


@given(st.lists(st.booleans(), max_size=120))
def test_the_doubt_begins_with_three_quarters_of_the_swings_and_ends_with_half(
    swings: list[bool],
) -> None:
    touches, told = BeliedTouches(), False
    for k, swing in enumerate(swings):
        began = touches.hear(swing)
        count = sum(swings[max(k + 1 - SWINGS, 0) : k + 1])
        now = count >= BEGIN or (told and count > END)
        assert (touches.told, began) == (now, now and not told)
        assert (touches.note is None) == (not now)
        told = now
    touches.forget()
    assert not touches.told
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
