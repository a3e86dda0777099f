"""Loops that slip, in walks; more sources by ``python -m field.sources``."""

from __future__ import annotations

import pytest

from adaptive_contact.robot import shipped_robot

from . import sources as s

SECONDS = 45.0  # the first seconds, in which nothing is known of a source, are a share of it


@pytest.mark.parametrize(
    ("loop", "seed"),
    [
        ("one in 4 slips 0.25", 5),
        pytest.param("late 0 to 0.25", 5, marks=pytest.mark.slow),
        pytest.param("all slip 0 to 0.15", 6, marks=pytest.mark.slow),
    ],
)
def test_a_loop_that_is_late_finds_its_touches(loop: str, seed: int) -> None:
    """Where delays add up it is 6 to 8 % slower in the mean, and in some moments by more."""
    played = s.late_loop(*s.walk_of(seed, SECONDS), s.LOOPS[loop])
    total = s.play(played, shipped_robot()).total
    assert total.counted.touches > 90
    assert total.counted.recall >= 0.95
    assert total.false_alarms <= 3
