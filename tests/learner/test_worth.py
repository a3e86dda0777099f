"""What a baseline is worth, by stops put into swings that it was not learned from."""

from __future__ import annotations

import numpy as np

from adaptive_contact.fit.train import Stretch
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.service.worth import part, worth

from .conftest import FakeLeg


def stretch(certain: bool = True, swings: int = 90, **run: object) -> Stretch:
    measured, desired, swing, _ = FakeLeg(seed=9).run(swings, **run)
    return Stretch(measured, desired, swing, swing, np.ones(len(swing), bool), certain=certain)


def test_stops_are_found_and_free_swings_give_no_contact(robot: Robot, baseline: Baseline) -> None:
    # Of ten such legs 91 % are found: enough swings that a tenth less shows.
    found = worth(robot, baseline, {"rf": [stretch(swings=360)]})["rf"]
    for reported, total in found.stops.values():
        assert 60 < total < 180
        assert reported >= 0.87 * total
    assert 60 < found.free_swings < 180
    assert found.false == 0
    assert found.good


def test_contacts_where_nothing_touched_are_counted(robot: Robot, baseline: Baseline) -> None:
    """Of a leg that comes down more slowly than its model says."""
    held_out = stretch(falling=lambda _: 0.2)
    found = worth(robot, baseline, {"rf": [held_out]})["rf"]
    assert found.false > 5
    assert not found.good
    assert f"{found.false} false in {found.free_swings} swings" in str(found)


def test_where_touches_are_not_known_none_is_called_false(robot: Robot, baseline: Baseline) -> None:
    found = worth(robot, baseline, {"rf": [stretch(certain=False, falling=lambda _: 0.2)]})["rf"]
    assert (found.false, found.free_swings) == (0, 0)
    assert "false" not in str(found)


def test_legs_that_were_not_tried_are_left_out(robot: Robot, baseline: Baseline) -> None:
    whole = stretch()
    stands = part(whole, 24, 28)
    assert worth(robot, baseline, {"rf": [stands], "lf": [whole]}) == {}
