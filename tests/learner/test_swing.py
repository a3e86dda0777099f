"""Where a leg is in its swing: off the ground, and not held."""

from __future__ import annotations

import itertools
from typing import Literal

import msgspec
import numpy as np
import pytest

from adaptive_contact.detect.layout import PATH_TICKS
from adaptive_contact.detect.swing import CLEARANCE_M, RECENT_TICKS
from adaptive_contact.detect.swing_judge import FORGET_SWINGS
from adaptive_contact.robot import Robot
from adaptive_contact.robot.kinematics import inverse
from adaptive_contact.wire import ServoSample

from .conftest import LENGTHS
from .drivers import Swings

LOW, HIGH = np.array([0.16, 0.0, -0.10]), np.array([0.16, 0.02, -0.04])


def swing(
    watch: Swings, follow: float, lag: int = 3, *, height: float = 0.06
) -> list[tuple[float, bool]]:
    """A lift of ten ticks; the foot goes the given share of the way. Its rise, and if cleared."""
    up = (HIGH - LOW) * height / (HIGH - LOW)[2]
    way = [np.zeros(3)] * 5 + [up * i / 10 for i in range(1, 11)] + [up] * lag
    told = []
    for k, command in enumerate(way):
        foot = LOW + follow * way[max(k - lag, 0)]
        sample = ServoSample(
            t_ns=k,
            seq=k,
            measured=inverse(foot, LENGTHS).tolist(),
            desired=inverse(LOW + command, LENGTHS).tolist(),
            phase="swing" if k >= 5 else "stance",
        )
        watch.take(sample)
        told.append((float(foot[2] - LOW[2]), watch.cleared))
    return told


def test_a_foot_is_clear_the_tick_after_it_has_risen_enough(robot: Robot) -> None:
    told = swing(Swings(robot), follow=1.0)
    assert told[-1][1]
    for (before, _), (_, cleared) in itertools.pairwise(told):
        assert cleared == (before > CLEARANCE_M)


@pytest.mark.parametrize(("follow", "held"), [(1.0, False), (0.9, False), (0.5, True), (0, True)])
def test_a_foot_that_does_not_come_along_is_held(robot: Robot, follow: float, held: bool) -> None:
    watch = Swings(robot)
    swing(watch, follow)
    assert watch.judge.judge_travel() is held


@pytest.mark.parametrize("turned", [False, True])
def test_a_foot_that_drops_onto_its_command_is_free_and_turned_readings_are_not(
    robot: Robot, turned: bool
) -> None:
    """An obstacle held it 6 cm up and is gone; it comes down to the command and goes along."""
    watch = Swings(robot)
    rise = [0.0] * 5 + [0.006 * k for k in range(1, 11)] + [0.06, 0.05, 0.04]
    height = 0.06
    for k, asked in enumerate(rise):
        behind = max(k - 3, 0)
        if turned:
            height = 0.06 - rise[behind]
        elif k >= 5:
            height = max(height - 0.015, rise[behind])
        sample = ServoSample(
            t_ns=k,
            seq=k,
            measured=inverse(LOW + np.array([0, 0.006 * behind, height]), LENGTHS).tolist(),
            desired=inverse(LOW + np.array([0, 0.006 * k, asked]), LENGTHS).tolist(),
            phase="swing" if k >= 5 else "stance",
        )
        watch.take(sample)
    assert watch.judge.judge_travel() is turned


def test_a_held_foot_has_to_come_further_to_be_free_again(robot: Robot) -> None:
    watch = Swings(robot)
    for follow, held in ((0.8, False), (0.3, True), (0.8, True), (1.0, False), (0.8, False)):
        swing(watch, follow)
        assert watch.judge.judge_travel() is held


def test_a_hold_of_which_nothing_can_be_told_any_more_is_forgotten(robot: Robot) -> None:
    """The foot came free, and the gait takes steps too small to tell."""
    watch = Swings(robot)
    told = []
    for height in (0.06, *[0.01] * (FORGET_SWINGS + 1)):
        swing(watch, 0.2, height=height)
        watch.judge.judge_travel()
        told.append(watch.judge.obstructed)
    assert told == [True] * FORGET_SWINGS + [False] * 2
    swing(watch, 0.2)
    assert watch.judge.judge_travel()
    watch.place.restart_swing()
    assert not watch.judge.obstructed


def test_samples_without_phase_are_told_of_while_they_come(robot: Robot) -> None:
    unknown = msgspec.structs.replace(robot.leg("rf"), lengths_m=None)
    watch = Swings(robot, unknown)

    def feed(count: int, phase: Literal["swing"] | None) -> None:
        for k in range(count):
            watch.follow(ServoSample(t_ns=k, seq=k, measured=[0.0], desired=[0.0], phase=phase))

    feed(1, None)
    assert "swings cannot be found" in str(watch.judge.phase_unknown_note)
    feed(RECENT_TICKS, "swing")
    assert watch.judge.phase_unknown_note is None


def test_a_command_that_goes_nowhere_says_nothing(robot: Robot) -> None:
    watch = Swings(robot)
    assert watch.judge.judge_travel() is None


def lowered(watch: Swings, depth: float, *, told_at: float) -> None:
    """A descent and a stance; a touch is told 1 tick after its onset, the foot rests deeper."""
    heights = [HIGH[2] - 0.008 * k for k in range(8)]  # down to -0.096, by 8 mm a tick
    onset = min(range(8), key=lambda k: abs(heights[k] - told_at))
    for k, height in enumerate([*heights, *[told_at - depth] * 6]):
        place = np.array([LOW[0], LOW[1], height])
        sample = ServoSample(
            t_ns=k,
            seq=k,
            measured=inverse(place, LENGTHS).tolist(),
            desired=inverse(place, LENGTHS).tolist(),
            phase="swing" if k < 10 else "stance",
        )
        watch.take(sample)
        if k == onset + 1:
            watch.judge.touched(1)


@pytest.mark.parametrize(("depth", "soft"), [(0.004, False), (0.012, True)])
def test_a_foot_is_out_of_ground_that_gave_when_it_is_above_it(
    robot: Robot, depth: float, soft: bool
) -> None:
    """The same lift: after hard ground by the way it came, after soft by where the ground was."""
    watch = Swings(robot)
    swing(watch, follow=1.0)
    lowered(watch, depth, told_at=LOW[2] + depth)
    told = swing(watch, follow=1.0)[5:]  # in stance nobody asks
    first = next(rise for rise, cleared in told if cleared)
    above_onset = first - depth
    assert above_onset > (0.016 if soft else CLEARANCE_M - depth)
    assert soft or above_onset < 0.024
    # And the next one starts from where nothing was touched.
    assert next(rise for rise, cleared in swing(watch, 1.0)[5:] if cleared) < 0.024


def test_a_swing_without_end_takes_no_more_memory(robot: Robot) -> None:
    """A leg held up for an hour: it is followed, but no longer foretold."""
    watch = Swings(robot)
    swing(watch, follow=0.5)
    at = inverse(HIGH, LENGTHS).tolist()
    for k in range(100, 3 * PATH_TICKS):
        sample = ServoSample(t_ns=k, seq=k, measured=at, desired=at, phase="swing")
        watch.take(sample)
    assert watch.place.record["path_n"] == PATH_TICKS
    asked: list[object] = []
    watch.place.record["obstructed"], watch.place.record["moved"] = False, 0.01
    assert watch.judge.judge_travel(lambda path: asked.append(path) or []) is True  # type: ignore[func-returns-value]
    assert not asked
