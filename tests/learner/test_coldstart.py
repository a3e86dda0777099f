"""A start without a baseline: when a fit is tried, on what, and what is remembered."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.detect.source import RATE_STEPS
from adaptive_contact.fit.refit_job import Job
from adaptive_contact.learn import cold_start as coldstart
from adaptive_contact.learn.cold_start import (
    FIRST_TRY_SWINGS,
    TRY_EVERY,
    ColdJob,
    ColdResult,
    ColdStart,
)
from adaptive_contact.model import leg_library
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.wire import ServoSample

from .conftest import FakeLeg

SWING, REST = 24, 4  # ticks


class Refusing:
    """Keeps jobs, and refuses those it is told to answer."""

    def __init__(self) -> None:
        self.jobs: list[ColdJob] = []
        self.answered = True

    def submit(self, job: Job) -> None:
        """Keep it."""
        assert isinstance(job, ColdJob)
        self.jobs.append(job)

    def collect(self, leg: str, number: int) -> ColdResult | None:
        """A refusal, once it may be."""
        assert number == self.jobs[-1].number
        return ColdResult(number, None, "not good enough yet") if self.answered else None


@pytest.fixture
def cold(robot: Robot) -> ColdStart:
    leg = robot.leg("rf")
    return ColdStart(leg, leg_library(robot, leg), robot.quantum("rf"))


def add(cold: ColdStart, ticks: int, *, swing: bool, value: float = 0.0) -> None:
    for _ in range(ticks):
        cold.add([value] * 3, [value] * 3, swing=swing, sound=True)


def swings(cold: ColdStart, count: int) -> None:
    for _ in range(count):
        add(cold, SWING, swing=True)
        add(cold, REST, swing=False)


def test_a_try_after_twenty_swings_and_then_with_every_ten(cold: ColdStart) -> None:
    refitter = Refusing()
    tried = []
    for n in range(1, 61):
        add(cold, SWING, swing=True)
        assert cold.poll(refitter) is None, "a swing counts when it is over"
        add(cold, REST, swing=False)
        before = len(refitter.jobs)
        cold.poll(refitter)
        if len(refitter.jobs) > before:
            tried.append(n)
            assert cold.poll(refitter) == ColdResult(len(tried), None, "not good enough yet")
            assert cold.poll(refitter) is None, "a result is given once"
    assert cold.swings == 60
    assert tried == [FIRST_TRY_SWINGS + k * TRY_EVERY for k in range(5)]
    assert tried[:3] == [20, 30, 40]
    assert [job.number for job in refitter.jobs] == [1, 2, 3, 4, 5]


def test_what_was_refused_goes_on_collecting(cold: ColdStart) -> None:
    refitter = Refusing()
    for n in range(60):
        swings(cold, 1)
        cold.poll(refitter)
        assert cold.samples == (n + 1) * (SWING + REST)
    held = [sum(len(s.measured) for s in job.stretches) for job in refitter.jobs]
    assert len(held) > 2
    assert np.diff(held).min() >= TRY_EVERY * (SWING + REST)


def test_a_try_that_is_not_answered_holds_up_the_next_and_nothing_else(cold: ColdStart) -> None:
    refitter = Refusing()
    refitter.answered = False
    for _ in range(50):
        swings(cold, 1)
        assert cold.poll(refitter) is None
    assert len(refitter.jobs) == 1
    assert cold.samples == 50 * (SWING + REST)
    refitter.answered = True
    assert cold.poll(refitter) is not None
    assert cold.poll(refitter) is None
    assert len(refitter.jobs) == 2, "it is long due"


@pytest.mark.parametrize("every", [None, 7, 90])
def test_only_so_many_samples_are_remembered_the_newest(
    cold: ColdStart, monkeypatch: pytest.MonkeyPatch, every: int | None
) -> None:
    """Whether the stream holds or breaks off again and again."""
    monkeypatch.setattr(coldstart, "MAX_SAMPLES", 1000)
    for k in range(5000):
        if every and k % every == 0:
            cold.interrupt()
        cold.add([float(k)] * 3, [0.0] * 3, swing=k % 28 < SWING, sound=True)
        assert cold.samples <= 1000
    assert cold.samples > 850
    assert len(cold._starts) <= 1000
    job = cold.job()
    assert job is not None
    if every != 7:  # too short to learn from
        seen = np.concatenate([s.measured[:, 0] for s in job.stretches])
        assert seen[-1] == 4999.0
        assert (np.diff(seen) == 1.0).all()


def test_the_bound_itself(cold: ColdStart) -> None:
    """Ten minutes at 50 Hz, and a tenth of it goes at a time."""
    assert coldstart.MAX_SAMPLES == 10 * 60 * 50
    add(cold, coldstart.MAX_SAMPLES, swing=False)
    assert cold.samples == coldstart.MAX_SAMPLES
    add(cold, 1, swing=False)
    assert cold.samples == coldstart.MAX_SAMPLES * 9 // 10 + 1


def test_an_interruption_ends_a_stretch(cold: ColdStart) -> None:
    cold.interrupt()  # at the very beginning there is nothing to end
    swings(cold, 10)
    add(cold, 6, swing=True, value=1.0)
    cold.interrupt()
    cold.interrupt()
    add(cold, 3, swing=True, value=2.0)  # too little to learn from
    cold.interrupt()
    add(cold, REST, swing=False, value=3.0)
    assert cold.swings == 10, "nobody saw the end of the swing it broke off in"
    swings(cold, 10)
    job = cold.job()
    assert job is not None
    lengths = [len(stretch.measured) for stretch in job.stretches]
    assert lengths == [10 * (SWING + REST) + 6, REST + 10 * (SWING + REST)]
    first, second = job.stretches
    assert first.measured[-1, 0] == 1.0
    assert second.measured[0, 0] == 3.0
    for stretch in job.stretches:
        assert not stretch.free[~stretch.swing].any()
        # Neither the ticks of a foot that is still pressed nor those of a touch that ends a swing.
        assert 0 < stretch.free.sum() < stretch.swing.sum()


def test_motion_that_nothing_explains_is_refused_with_its_figure(
    robot: Robot, cold: ColdStart
) -> None:
    measured, desired, swing, _ = FakeLeg(seed=41).run(30)
    rng = np.random.default_rng(2)
    wild = measured + rng.normal(scale=0.1, size=measured.shape)
    for m, d, s in zip(wild.tolist(), desired.tolist(), swing.tolist(), strict=True):
        cold.add(m, d, swing=s, sound=True)
    job = cold.job()
    assert job is not None
    result = job.run()
    assert result.known is None
    assert result.reason.startswith("not good enough yet: held-out error 0.")
    assert result.reason.endswith("of the motion after 30 swings")


@pytest.mark.parametrize("joints", [1, 2, 4])
def test_a_leg_of_any_build_is_learned_from_nothing(joints: int) -> None:
    """Of so many joints, and lengths of its own, through the learner; then a stop is an alarm."""
    names = [f"j{i}" for i in range(joints)]
    axes = ["yaw", "pitch", "pitch", "pitch"][:joints] if joints > 1 else ["pitch"]
    robot = parse_robot(
        '[robot]\nname = "other"\nperiod_s = 0.02\nquantum_rad = 0.005\n'
        f'[[leg]]\nid = "a"\njoints = {names}\naxes = {axes}\n'
        f"lengths_m = {[0.31, 0.2, 0.15, 0.4][:joints]}\n",
        source="test",
    )
    rng = np.random.default_rng(joints)
    swings, swing_ticks, stance_ticks = 120, 24, 6
    q = command = np.zeros(joints)
    learner = ContactLearner(robot, "a")
    alarms: list[int] = []
    valid_from = None
    for n in range(swings):
        aim = rng.uniform(0.25, 0.5, joints) * (1 if n % 2 else -1)  # far enough to be stopped
        stopped = n >= 100 and n % 2 == 0
        for tick in range(swing_ticks + stance_ticks):
            k = n * (swing_ticks + stance_ticks) + tick
            if tick < swing_ticks:
                command = command + (aim - command) / (swing_ticks - tick)
            reading = np.round((q + 0.002 * rng.normal(size=joints)) / 0.005) * 0.005
            sample = ServoSample(
                t_ns=k * 20_000_000,
                seq=k,
                measured=reading.tolist(),
                desired=command.tolist(),
                phase="swing" if tick < swing_ticks else "stance",
            )
            event = learner.update(sample)
            if event is not None and event.contact:
                alarms.append(n)
            if not (stopped and 12 <= tick < swing_ticks):
                q = q + 0.4 * (command - q)
        if valid_from is None and learner.status.status == "valid":
            valid_from = n
    assert valid_from is not None
    assert valid_from <= 60
    found = {n for n in alarms if n >= 100}
    assert len(found & set(range(100, 120, 2))) >= 8
    assert sum(n < 100 for n in alarms) + len(found - set(range(100, 120, 2))) <= 2


def test_ticks_of_another_length_are_no_part_of_a_first_model(cold: ColdStart) -> None:
    add(cold, 30, swing=True, value=1.0)
    add(cold, RATE_STEPS, swing=True, value=2.0)
    cold.drop_newest(RATE_STEPS)
    swings(cold, FIRST_TRY_SWINGS)
    job = cold.job()
    assert job is not None
    assert len(job.stretches[0].measured) == 30
    assert not any((stretch.measured == 2.0).any() for stretch in job.stretches)
    cold.interrupt()
    add(cold, 3, swing=True, value=2.0)
    cold.drop_newest(RATE_STEPS)  # what was before the break stays
    assert cold.samples == 30 + FIRST_TRY_SWINGS * (SWING + REST)


def test_a_leg_that_starts_cold_at_another_rate_collects_what_is_at_its_own(robot: Robot) -> None:
    learner = ContactLearner(robot, "rf")
    measured, desired, swing, _ = FakeLeg(seed=3).run(8)
    late_ns = 0
    for k in range(len(measured)):
        late_ns += 4_000_000 if k >= 100 else 0
        learner.update(
            ServoSample(
                t_ns=20_000_000 * k + late_ns,
                seq=k,
                measured=measured[k].tolist(),
                desired=desired[k].tolist(),
                phase="swing" if swing[k] else "stance",
            )
        )
    cold = learner._lifecycle.cold
    assert cold is not None
    assert "24.0 ms apart" in (learner.status.note or "")
    assert 80 <= cold.samples <= 100
