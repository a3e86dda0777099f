"""A push too weak for any window is a contact where it lasts, of a leg whose touches are known."""

from __future__ import annotations

import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot

from .conftest import FakeLeg, play, samples

SEEDS = 20
TOUCHED = 12  # swings before


def found(robot: Robot, baseline: Baseline, *, touches: bool, held_back: float) -> int:
    """Count the legs that report the last swing's descent, which loses a share of its pull."""
    legs = 0
    for seed in range(SEEDS):
        measured, desired, swing, _ = FakeLeg(seed=seed).run(
            TOUCHED + 2,
            touch=lambda n: 16 if touches and n < TOUCHED else None,
            falling=lambda n: 1.0 - held_back * (n == TOUCHED + 1),
        )
        events = play(ContactLearner(robot, "rf", baseline), samples(measured, desired, swing))
        legs += any(e.contact and e.seq >= 28 * (TOUCHED + 1) for e in events)
    return legs


@pytest.mark.parametrize(
    ("touches", "held_back", "least", "most"),
    [
        (True, 0.0, 0, 0),
        (True, 0.05, 12, SEEDS),
        (False, 0.05, 0, 4),  # such a leg may hang, in a motion that it does not know
        (False, 0.12, 16, SEEDS),
    ],
)
def test_a_weak_push_that_lasts(
    robot: Robot, baseline: Baseline, touches: bool, held_back: float, least: int, most: int
) -> None:
    assert least <= found(robot, baseline, touches=touches, held_back=held_back) <= most
