"""Gaps, wrong rates and previews that lack: bridged, or counted and not learned."""

from __future__ import annotations

import copy
import dataclasses

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.core.detect.swing import RECENT_TICKS
from adaptive_contact.model import Baseline, LegModel, Window, leg_library, shipped_baseline
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_sim import SimulationSettings, record_arrays
from adaptive_contact_sim.arrays import Run

from .conftest import PERIOD, FakeLeg, outcomes, play, samples


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


@pytest.fixture(scope="module")
def walked() -> Run:
    return record_arrays(SimulationSettings.of("hexapod", "walk"), 30.0)


@pytest.mark.parametrize("lost", [1, 2, 3, 4, 8])
def test_after_a_gap_nothing_that_was_read_is_refused(walked: Run, lost: int) -> None:
    """A foot that came to the ground in the gap is where no prediction has it."""
    robot = shipped_robot()
    for leg, of in walked.legs.items():
        stream = samples(of.measured, of.desired, of.swing)
        down = np.flatnonzero(of.contact[1:] & ~of.contact[:-1])[4:] + 1
        gone = {k for at in down.tolist() for k in range(at - lost // 2, at - lost // 2 + lost)}
        learner = ContactLearner(robot, leg, shipped_baseline(robot.name))
        play(learner, [s for s in stream if s.seq not in gone])
        assert learner.status.missed > 15
        assert learner.status.rejects == {}


def slowed(stream: list[ServoSample], first: int, stop: int, factor: float) -> list[ServoSample]:
    """The same samples, those of a stretch so many times as far apart."""
    out, late = [], 0
    for s in stream:
        late += round((factor - 1.0) * PERIOD) if first <= s.seq < stop else 0
        out.append(msgspec.structs.replace(s, t_ns=s.t_ns + late))
    return out


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_rate_off_by_a_fifth_is_said_and_not_learned(
    robot: Robot, baseline: Baseline, factor: float
) -> None:
    first, stop = 100, 160  # swings
    stops = [16 if n % 2 else None for n in range(260)]
    # Slower ticks are longer ones: the leg moves further in each.
    stream = slowed(
        FakeLeg(seed=21).stream(
            260, touch=lambda n: stops[n], change=lambda n: factor if first <= n < stop else 1.0
        ),
        28 * first,
        28 * stop,
        factor,
    )
    learner = ContactLearner(robot, "rf", baseline)
    assert "alarm" not in outcomes(play(learner, stream[: 28 * first]), range(first), stops)
    before, confirmed = learner.status, learner.drain_confirmed()
    assert confirmed
    during = play(learner, stream[28 * first : 28 * stop])
    assert [e for e in during if e.contact] == []
    assert learner.drain_confirmed() == []
    assert learner.status.buffer == before.buffer
    assert (learner.status.status, learner.status.doubt) == ("ambiguous", "unjudged")
    assert learner.status.note == (
        f"samples are {20 * factor:.1f} ms apart, robot.toml says 20.0 ms: "
        "nothing is judged or learned until they agree"
    )
    after = outcomes(play(learner, stream[28 * stop :]), range(stop, 260), stops)
    assert "alarm" not in after
    assert after[1:].count("miss") <= 1
    assert (learner.status.status, learner.status.note) == ("valid", None)
    assert learner.drain_confirmed()


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
