"""Whether a robot stands or hangs, by the loads of all its legs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from adaptive_contact.core.bank import LearnerBank
from adaptive_contact.core.detect.leg_batch import LegPlace
from adaptive_contact.core.detect.standing import Standing
from adaptive_contact_sim import simulated_robot


class Legs:
    """Loads of a robot's legs, as stances end."""

    def __init__(self, count: int, **given: Any) -> None:
        scalars = {"has_lengths": True, "load": 0.0, "load_n": 0, "stands": 0, **given}
        self.legs = [SimpleNamespace(**scalars) for _ in range(count)]
        self.standing = Standing()
        for leg in self.legs:
            self.standing.track(cast(LegPlace, SimpleNamespace(leg=leg)))

    def stances(self, loads: list[float], times: int = 1) -> set[int]:
        """End so many stances of legs with these loads."""
        for _ in range(times):
            for leg, load in zip(self.legs, loads, strict=True):
                leg.load, leg.load_n = load, leg.load_n + 1
                self.standing.end_stance()
        return {leg.stands for leg in self.legs}


def test_a_stance_of_each_leg_is_enough_for_all_of_them() -> None:
    assert Legs(6).stances([4.0, 4.0, 4.0, 0.5, 1.0, 3.0]) == {1}


def test_that_a_robot_hangs_takes_five_stances_of_each() -> None:
    robot = Legs(6)
    loads = [0.5, -1.0, 0.0, 4.5, 1.0, -0.5]
    assert robot.stances(loads, 4) == {0}
    assert robot.stances(loads, 2) == {-1}
    assert robot.stances([1.2] * 6) == {0}


def test_loads_in_between_decide_nothing_and_change_nothing() -> None:
    assert Legs(4).stances([1.5] * 4, 20) == {0}
    robot = Legs(4)
    assert robot.stances([3.0] * 4) == robot.stances([1.9] * 4) == {1}


def test_one_that_stood_hangs_below_a_share_of_its_usual_load_until_that_has_fallen() -> None:
    robot = Legs(6)
    assert robot.stances([6.0] * 6, 40) == {1}
    assert robot.stances([4.0] * 6) == {1}  # such as on soft ground
    assert robot.stances([3.0] * 6) == {-1}
    assert robot.stances([3.0] * 6, 40) == {1}


def test_too_few_legs_decide_nothing() -> None:
    assert Legs(2).stances([9.0] * 2, 10) == {0}
    robot = Legs(6)
    for leg in robot.legs[:2]:
        leg.load, leg.load_n = 5.0, 9
    robot.standing.end_stance()
    assert {leg.stands for leg in robot.legs} == {0}  # a third of them
    assert Legs(6, has_lengths=False).stances([5.0] * 6) == {0}


def test_a_bank_asks_all_legs_of_its_robot() -> None:
    bank = LearnerBank(simulated_robot("hexapod").description)
    places = [bank.make(leg, 3).place for leg in (*bank.robot.leg_ids, "elsewhere")]
    for place in places:
        place.leg.load, place.leg.load_n = 3.0, 2
    bank._standing.end_stance()
    assert [place.leg.stands for place in places] == [1] * 6 + [0]
