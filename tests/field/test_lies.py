"""A small price list: lies are named, honest legs are not doubted (`python -m field.lies`)."""

from __future__ import annotations

import numpy as np
import pytest

from .lies import KINDS, Stream, first_order, follow_honest, simulated, tell


@pytest.fixture(scope="module")
def walkers() -> list[Stream]:
    return list(simulated(24.0, 5, ["hexapod"]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_lie_is_named_silenced_and_over(walkers: list[Stream], kind: str) -> None:
    rng = np.random.default_rng([3, *kind.encode()])
    for fitted in (True, False):
        told = tell(walkers[int(rng.integers(6))], kind, rng, fitted=fitted)
        assert (told.named, told.contacts, told.right_again) == (True, 0, True), told


@pytest.mark.parametrize("fitted", [True, False])
def test_legs_that_walk_are_not_doubted(walkers: list[Stream], *, fitted: bool) -> None:
    assert not any(follow_honest(stream, fitted=fitted).doubted for stream in walkers[:3])


def test_servos_that_follow_closely_are_not_doubted() -> None:
    """Delays of 0 to 4 ticks, play up to 2 degrees, steps of 10 and 12 bits and none."""
    for stream in list(first_order(16.0, 2))[::4]:
        assert not follow_honest(stream, fitted=False).doubted
