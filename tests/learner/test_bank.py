"""A bank of learners: known legs, strangers, and its bound."""

from __future__ import annotations

import dataclasses
import gc
from typing import Any

import numpy as np
import pytest

from adaptive_contact import ContactEvent, ContactLearner, ServoSample
from adaptive_contact.core.bank import LearnerBank, LegGroup
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot, parse_robot, shipped_robot

from .conftest import FakeLeg


def test_what_is_not_described_is_a_stranger(robot: Robot, baseline: Baseline) -> None:
    """Also where the baseline has it."""
    both = dataclasses.replace(baseline, legs={**baseline.legs, "rr": baseline.legs["rf"]})
    bank = LearnerBank(robot, both)
    sample = FakeLeg(seed=1).stream(1)[0]
    other = ServoSample(t_ns=1, seq=1, measured=[0.0, 0.1], desired=[0.0, 0.1], phase="swing")
    assert bank.update({"rf": sample, "rr": sample, "tail": other}) == []
    assert [bank.learner(leg).status.status for leg in ("rr", "tail")] == ["learning"] * 2
    assert bank.learner("a*", 2) is None


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


# -- Legs that go through time together, against the same legs one by one


def four_legs(seed: int) -> list[tuple[ServoSample, ...]]:
    """Ticks of four legs that touch in every other swing."""
    streams = [
        FakeLeg(seed=seed + n).stream(60, touch=lambda k: 16 if k % 2 else None) for n in range(4)
    ]
    return list(zip(*streams, strict=True))


def test_legs_whose_samples_are_lost_do_not_disturb_the_others(
    robot: Robot, baseline: Baseline
) -> None:
    """Gaps, a leg that starts cold beside known ones, one that is taken further on its own."""
    rng = np.random.default_rng(3)
    ticks = [[None if rng.random() < 0.03 else sample for sample in tick] for tick in four_legs(20)]

    def learners() -> list[ContactLearner]:
        known = [ContactLearner(robot, "rf", baseline) for _ in range(3)]
        return [*known, ContactLearner(robot, "rf", None)]

    one_by_one = learners()
    alone = [
        [learner.update(sample) for sample in own if sample is not None]
        for learner, own in zip(one_by_one, zip(*ticks, strict=True), strict=True)
    ]
    members = learners()
    group = LegGroup(members)
    together: list[list[ContactEvent | None]] = [[] for _ in members]
    for k, tick in enumerate(ticks):
        given = list(tick)
        if k % 100 == 0 and given[0] is not None:  # a service asks one leg by itself
            together[0].append(members[0].update(given[0]))
            given[0] = None
        for own, sample, event in zip(together, given, group.advance(given), strict=True):
            if sample is not None:
                own.append(event)
    for one, many in zip(alone, together, strict=True):
        assert [e and (e.seq, e.contact) for e in one] == [e and (e.seq, e.contact) for e in many]
    assert any(event is not None for event in together[0])
    for a, b in zip(one_by_one, members, strict=True):
        np.testing.assert_allclose(a.model.coefficients, b.model.coefficients, rtol=1e-6, atol=1e-9)


def test_events_before_learning_change_nothing(robot: Robot, baseline: Baseline) -> None:
    """A tick's samples in several rounds, learned from when somebody finds the time."""
    rng = np.random.default_rng(4)

    def learners() -> list[ContactLearner]:
        # One starts cold: it gets its place in the block while others are judged.
        return [ContactLearner(robot, "rf", baseline if n else None) for n in range(4)]

    whole, members = learners(), learners()
    at_once, in_halves = LegGroup(whole), LegGroup(members)
    heard = 0
    for tick in four_legs(30):
        expected = at_once.advance(tick)
        order = rng.permutation(4)
        cut = int(rng.integers(5))
        found: list[ContactEvent | None] = [None] * 4
        for part in (order[:cut], order[cut:]):
            given = [sample if i in part else None for i, sample in enumerate(tick)]
            for i, event in enumerate(in_halves.detect_contacts(given)):
                found[i] = event or found[i]
            if rng.random() < 0.3:
                in_halves.learn_from_tick()
        assert found == expected
        heard += sum(event is not None for event in found)
    in_halves.learn_from_tick()
    assert heard > 100
    for a, b in zip(whole, members, strict=True):
        assert a.status == b.status
        np.testing.assert_array_equal(a.model.coefficients, b.model.coefficients)


def test_learners_leave_no_garbage_to_collect(robot: Robot, baseline: Baseline) -> None:
    """The service collects it once a minute only."""
    streams = [
        FakeLeg(seed=60 + n).stream(15, touch=lambda k: 20 if k % 2 else None) for n in range(2)
    ]
    group = LegGroup([ContactLearner(robot, "rf", baseline) for _ in streams])
    ticks = list(zip(*streams, strict=True))
    group.advance(ticks[0])
    gc.collect()
    gc.disable()
    try:
        heard = [event for tick in ticks[1:] for event in group.advance(tick) if event is not None]
        assert len(heard) > 10
        assert gc.collect() == 0
    finally:
        gc.enable()


class Asked:
    """Keeps of each job the samples of its legs; makes none."""

    def __init__(self) -> None:
        self.samples: dict[str, list[int]] = {}

    def submit(self, job: Any) -> None:
        self.samples[job.leg] = [len(motion.t_ns) for motion in job.motions.values()]

    def collect(self, leg: str, number: int) -> None:
        return None


@pytest.mark.parametrize("at_once", [True, False])
def test_legs_fed_one_by_one_are_judged_after_as_many_ticks(at_once: bool) -> None:
    robot, asked = shipped_robot(), Asked()
    bank = LearnerBank(robot, refitter=asked)
    rng = np.random.default_rng(1)
    for k in range(600):
        tick = {
            leg: ServoSample(
                t_ns=k * 20_000_000, seq=k, measured=rng.normal(0.0, 0.01, 3).tolist(),
                desired=[0.0, 0.0, 0.0], phase="stance",
            )
            for leg in robot.leg_ids
        }  # fmt: skip
        for part in [tick] if at_once else [{leg: sample} for leg, sample in tick.items()]:
            bank.update(part)
    times = {name: max(of) for name, of in asked.samples.items()}
    assert times == {"*": 200, "*ids": 600}  # angles after 4 s, ids after 12 s
