"""Where a leg is in its swing: off the ground, and not held."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from adaptive_contact.adapt.swing import CLEARANCE_M, SwingWatch
from adaptive_contact.robot import Robot
from adaptive_contact.robot.geometry import inverse
from adaptive_contact.wire import ServoSample
from tests.adapt.conftest import LENGTHS

LOW, HIGH = np.array([0.16, 0.0, -0.10]), np.array([0.16, 0.02, -0.04])


def swing(watch: SwingWatch, follow: float, lag: int = 3) -> list[tuple[float, bool]]:
    """A lift of ten ticks; the foot goes the given share of the way. Its rise, and if cleared."""
    way = [np.zeros(3)] * 5 + [(HIGH - LOW) * i / 10 for i in range(1, 11)] + [HIGH - LOW] * lag
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
        watch.follow(sample)
        watch.observe(sample.measured)
        watch.command()
        told.append((float(foot[2] - LOW[2]), watch.cleared))
    return told


def test_a_foot_is_clear_the_tick_after_it_has_risen_enough(robot: Robot) -> None:
    told = swing(SwingWatch(robot.leg("rf")), follow=1.0)
    assert told[-1][1]
    for (before, _), (_, cleared) in itertools.pairwise(told):
        assert cleared == (before > CLEARANCE_M)


@pytest.mark.parametrize(("follow", "held"), [(1.0, False), (0.9, False), (0.5, True), (0, True)])
def test_a_foot_that_does_not_come_along_is_held(robot: Robot, follow: float, held: bool) -> None:
    watch = SwingWatch(robot.leg("rf"))
    swing(watch, follow)
    assert watch.judge_lift() is held


def test_a_held_foot_has_to_come_further_to_be_free_again(robot: Robot) -> None:
    watch = SwingWatch(robot.leg("rf"))
    for follow, held in ((0.8, False), (0.3, True), (0.8, True), (1.0, False), (0.8, False)):
        swing(watch, follow)
        assert watch.judge_lift() is held


def test_a_command_that_goes_nowhere_says_nothing(robot: Robot) -> None:
    watch = SwingWatch(robot.leg("rf"))
    assert watch.judge_lift() is None
