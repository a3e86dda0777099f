"""A leg's first swings from what is known of any leg: what is judged, and what is learned."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.detect.swing_labels import CAUTIOUS_TICKS
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ServoSample

from .conftest import PERIOD, FakeLeg, samples

EACH, TURN = 28, 24  # ticks from swing to swing, and to the turn


def test_what_is_shown_is_what_was_judged(robot: Robot) -> None:
    """Windows of two and three ticks are as wide as errors of coefficients add up."""
    measured, desired, swing, _ = FakeLeg(seed=5).run(4)
    learner = ContactLearner(robot, "rf", None)
    compared = 0
    for k, sample in enumerate(samples(measured, desired, swing)):
        learner.update(sample)
        judged, place = learner.judged(), learner.place
        if judged is None or place.leg["after"] or not 12 < k % EACH < TURN:
            continue
        compiled = place.batch.scores[place.row]
        at = np.isfinite(compiled) & (compiled > 0.0)
        np.testing.assert_allclose(judged.scores[at], compiled[at], rtol=1e-9)
        compared += int(at[1:].sum())
    assert compared > 20
    assert (learner.place.units[1:] > learner.place.units[:1]).all()


@pytest.mark.parametrize(("stop", "cautious"), [(20, False), (TURN + 1, True)])
def test_ticks_before_a_touch_after_the_turn_are_not_learned(
    robot: Robot, baseline: Baseline, stop: int, cautious: bool
) -> None:
    """There a touch may have begun unseen, where the leg is known from a prior alone."""
    measured, desired, swing, _ = FakeLeg(seed=5).run(6, touch=lambda n: stop if n > 3 else None)
    stream = samples(measured, desired, swing)
    ours, theirs = (gaps(ContactLearner(robot, "rf", known), stream) for known in (None, baseline))
    assert len(ours) == len(theirs) == 2  # both touches are found
    assert max(theirs) < CAUTIOUS_TICKS
    assert min(ours) > CAUTIOUS_TICKS if cautious else max(ours) < CAUTIOUS_TICKS


def gaps(learner: ContactLearner, stream: list[ServoSample]) -> list[int]:
    """Ticks from the last one learned to each touch."""
    found = []
    for sample in stream:
        event = learner.update(sample)
        if event is not None and event.contact:
            learned = [t for t in learner.drain_confirmed() if t < event.t_ns]
            found.append((event.onset_ns - max(learned)) // PERIOD)
    return found
