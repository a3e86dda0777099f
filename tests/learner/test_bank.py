"""A bank of learners: known legs, strangers, and its bound."""

from __future__ import annotations

import dataclasses

from adaptive_contact import ServoSample
from adaptive_contact.bank import LearnerBank
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot, parse_robot

from .conftest import FakeLeg, samples


def test_a_leg_that_the_baseline_has_and_the_description_lacks_is_a_stranger(
    robot: Robot, baseline: Baseline
) -> None:
    both = dataclasses.replace(baseline, legs={**baseline.legs, "rr": baseline.legs["rf"]})
    bank = LearnerBank(robot, both)
    (sample,) = samples(*FakeLeg(seed=1).run(1)[:3])[:1]
    assert bank.update({"rf": sample, "rr": sample}) == []
    stranger = bank.learner("rr")
    assert stranger is not None
    assert stranger.status.status == "learning"


def test_a_stranger_gets_a_learner_and_a_bank_is_bounded(robot: Robot, baseline: Baseline) -> None:
    bank = LearnerBank(robot, baseline)
    sample = ServoSample(t_ns=1, seq=1, measured=[0.0, 0.1], desired=[0.0, 0.1], phase="swing")
    assert bank.update({"tail": sample}) == []
    stranger = bank.learner("tail")
    assert stranger is not None
    assert stranger.status.status == "learning"
    assert bank.learner("a*", 2) is None
    for n in range(100):
        bank.learner(f"leg{n}", 2)
    assert len(bank.legs) == 32


def test_every_leg_that_is_described_gets_a_learner_however_many_strangers_came() -> None:
    legs = "".join(f'[[leg]]\nid = "l{n}"\njoints = ["a", "b"]\n' for n in range(64))
    text = f'[robot]\nname = "centipede"\nperiod_s = 0.02\nquantum_rad = 0.005\n{legs}'
    bank = LearnerBank(parse_robot(text, source="test"))
    for n in range(40):
        bank.learner(f"stranger{n}", 2)
    assert len(bank.legs) == 32
    assert all(bank.learner(f"l{n}") is not None for n in range(64))
    assert bank.learner("one-more", 2) is None
    assert len(bank.legs) == 32 + 64
