"""Gaps, wrong rates and previews that lack: bridged, or counted and not learned."""

from __future__ import annotations

import copy
import dataclasses

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.core.detect.swing import RECENT_TICKS
from adaptive_contact.model import Baseline, LegModel, Window, leg_library
from adaptive_contact.robot import Robot

from .conftest import FakeLeg, play


@pytest.mark.parametrize("back", [0, 2, 4])
def test_after_a_long_gap_a_foot_on_the_ground_is_not_taken_for_free(
    robot: Robot, baseline: Baseline, back: int
) -> None:
    """From one swing into the next one's lift, with a foot that lets go in its seventh tick."""
    held = FakeLeg(seed=13).stream(42, pressed=7)
    learner = ContactLearner(robot, "rf", baseline)
    told = play(learner, held[: 28 * 20])
    for swing in range(20, 40):
        part = held[28 * swing : 28 * (swing + 2)]
        gone = range(28 * swing + 14, 28 * (swing + 1) + back)
        told += play(copy.deepcopy(learner), [s for s in part if s.seq not in gone])
        told += play(learner, part[:28])
    assert not [event for event in told if event.contact]


def test_a_preview_that_lacks_is_told_of_while_it_does(robot: Robot, baseline: Baseline) -> None:
    """One sample without is no lack for good, nor does a restart of the service make it one."""
    library = leg_library(robot, robot.leg("rf"), "servo", Window(preview=2))
    model = LegModel(library, np.zeros((library.size, 3)))
    known = dataclasses.replace(
        baseline.legs["rf"], model=model, scale=np.ones(library.size), domain=None
    )
    ahead = dataclasses.replace(baseline, legs={"rf": known})
    stream = FakeLeg(seed=3).stream(8)
    learner = ContactLearner(robot, "rf", ahead)
    first, count = 20, RECENT_TICKS + 1
    for k, sample in enumerate(stream[: first + count]):
        rows = None if k == first else [s.desired for s in stream[k + 1 : k + 3]]
        learner.update(msgspec.structs.replace(sample, preview=rows))
        if k == first:
            assert "needs a preview" in str(learner.status.note)
            again = ContactLearner(robot, "rf", ahead)
            again.restore(learner.snapshot())
            assert again.status.note is None
    assert learner.status.note is None
