"""Readings that are none: values that a failed read leaves behind, and angles a turn off."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot

from .conftest import FakeLeg, outcomes, play

SWINGS = 160
STOPS = [16 if n % 2 else None for n in range(SWINGS)]
LOWEST = math.radians(-150.0)  # raw step 0 of a servo of 300 degrees
TURN = 2.0 * math.pi


@pytest.fixture(scope="module")
def walk() -> list[ServoSample]:
    return FakeLeg(seed=31).stream(SWINGS, touch=lambda n: STOPS[n])


@pytest.fixture(scope="module")
def clean(robot: Robot, baseline: Baseline, walk: list[ServoSample]) -> list[str]:
    """What is found of the walk as it is; a foot that is stopped dead is refused nothing."""
    learner = ContactLearner(robot, "rf", baseline)
    found = told(learner, walk)
    assert found.count("hit") > 70
    assert not learner.status.rejects
    return found


def told(learner: ContactLearner, stream: list[ServoSample]) -> list[str]:
    return outcomes(play(learner, stream), range(SWINGS), STOPS)


def one_in(
    each: int, stream: list[ServoSample], bad: Callable[[float], float], *, whole: bool
) -> tuple[list[ServoSample], int]:
    """A stream with one bad reading in so many, of a joint or of the leg; and their number."""
    rng = np.random.default_rng(7)
    out, count = [], 0
    for s in stream:
        hit = np.full(3, rng.random() < 1.0 / each) if whole else rng.random(3) < 1.0 / each
        measured = [bad(x) if h else x for x, h in zip(s.measured, hit.tolist(), strict=True)]
        count += int(hit.sum())
        out.append(msgspec.structs.replace(s, measured=measured))
    return out, count


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("value", [LOWEST, 0.0, 0.3, -math.pi])
def test_a_failed_read_costs_no_touch_and_is_counted(
    robot: Robot,
    baseline: Baseline,
    walk: list[ServoSample],
    clean: list[str],
    value: float,
    *,
    whole: bool,
) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    stream, count = one_in(200, walk, lambda _: value, whole=whole)
    found = told(learner, stream)
    assert found.count("alarm") <= clean.count("alarm") + 1
    assert found.count("hit") >= clean.count("hit") - 1
    # This leg's readings scatter by a step of the encoder: one in a thousand is doubted beside 0.
    assert 0.5 * count < learner.status.rejects["implausible"] <= count + 0.001 * 3 * len(walk)


@pytest.mark.parametrize("turns", [-1, 1])
def test_a_reading_a_turn_off_is_the_same_reading(
    robot: Robot, baseline: Baseline, walk: list[ServoSample], clean: list[str], turns: int
) -> None:
    stream, _ = one_in(50, walk, lambda x: x + turns * TURN, whole=False)
    learner = ContactLearner(robot, "rf", baseline)
    assert told(learner, stream) == clean
    assert not learner.status.rejects


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_a_seam_in_the_travel_is_no_movement(
    robot: Robot, baseline: Baseline, walk: list[ServoSample], clean: list[str], joint: int
) -> None:
    """Readings and commands come in one turn that begins in the middle of the joint's travel."""
    middle = float(np.median([s.measured[joint] for s in walk]))

    def wrapped(angles: list[float]) -> list[float]:
        turned = list(angles)
        turned[joint] = middle + (angles[joint] - middle + walk_turn) % TURN - walk_turn
        return turned

    # The turn that holds the first command as the description counts it.
    walk_turn = 0.0 if walk[0].desired[joint] >= middle else TURN
    stream = [
        msgspec.structs.replace(s, measured=wrapped(s.measured), desired=wrapped(s.desired))
        for s in walk
    ]
    jumps = np.abs(np.diff([s.measured[joint] for s in stream])) > math.pi
    assert jumps.sum() > 50
    learner = ContactLearner(robot, "rf", baseline)
    assert told(learner, stream) == clean
    assert not learner.status.rejects
