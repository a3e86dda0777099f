"""What must not be learned, and what must not stop: bad readings, held feet, faults of our own."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner, LearnerBank, ServoSample
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot

from .conftest import PERIOD, FakeLeg, play, samples, taken

TICKS = 28  # of a swing and its stance


def without_femur(sample: ServoSample) -> ServoSample:
    """As from a bus on which one servo did not answer, and said so."""
    measured = [sample.measured[0], -np.pi, sample.measured[2]]
    return msgspec.structs.replace(sample, valid=[True, False, True], measured=measured)


@pytest.mark.parametrize("stop", [6, 7])
def test_what_stops_a_lift_again_and_again_is_reported(
    robot: Robot, baseline: Baseline, stop: int
) -> None:
    """As a strike, or where the foot counts as held: it has moved as the model says until then."""
    start, swings = 60, 100
    learner = ContactLearner(robot, "rf", baseline)
    told = 0
    for sample in FakeLeg(seed=2).stream(swings, touch=lambda k: stop if k >= start else None):
        event = learner.update(sample)
        if event is not None and event.contact:
            assert sample.seq > TICKS * start + stop
            told += 1
    assert told >= 0.8 * (swings - start)


def test_no_prediction_is_learned_as_if_it_had_been_read(robot: Robot, baseline: Baseline) -> None:
    measured, desired, swing, _ = FakeLeg(seed=3).run(120)
    bad = np.random.default_rng(0).random(len(measured)) < 0.05
    learner = ContactLearner(robot, "rf", baseline)
    rows_taken = taken(learner)
    for k, sample in enumerate(samples(measured, desired, swing)):
        learner.update(without_femur(sample) if bad[k] else sample)
    times = np.concatenate([rows.t_ns for rows in rows_taken])
    assert len(times) > 500
    assert not bad[times // PERIOD].any()


def test_a_fault_while_restoring_leaves_the_leg_as_new(
    robot: Robot, baseline: Baseline, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    tree = learner.snapshot() or {}
    fresh = ContactLearner(robot, "rf", baseline)

    def fail(*_: object) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr("adaptive_contact.core.learn.noise_tracker.NoiseTracker.refresh", fail)
    why = fresh.restore(tree)
    assert why == "snapshot of leg 'rf' not used: LinAlgError: not positive definite"
    monkeypatch.undo()
    assert msgspec.msgpack.encode(fresh.snapshot()) == msgspec.msgpack.encode(tree)


@pytest.mark.parametrize("where", ["admit_sample", "event_of", "learn_from_tick", "adopt_model"])
def test_a_fault_in_a_shared_block_takes_its_own_row_only(
    two_legs: Robot, baseline: Baseline, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Two legs with models of one library; what the sound one tells is what it tells alone."""
    stream, other = (
        FakeLeg(seed=seed).stream(12, touch=lambda k: 16 if k % 2 else None) for seed in (6, 7)
    )
    both = dataclasses.replace(baseline, legs=dict.fromkeys(("rf", "lf"), baseline.legs["rf"]))
    alone = ContactLearner(two_legs, "lf", both)
    wanted = [(e.seq, e.contact) for sample in stream if (e := alone.update(sample)) is not None]
    assert len(wanted) > 6

    faults: list[tuple[str, str]] = []
    bank = LearnerBank(two_legs, both, on_fault=lambda leg, why: faults.append((leg, str(why))))
    told = []
    for k, sample in enumerate(stream):
        learner = bank.learner("rf")
        if k in (100, 101, 180):  # in the midst of a swing

            def fail(*_: object) -> None:
                raise ZeroDivisionError("division by zero")

            if where == "event_of":
                learner.request_release()
            if where == "adopt_model":  # called where another model takes over
                monkeypatch.setattr(learner, "learn_from_tick", lambda _: True)
            monkeypatch.setattr(learner, where, fail)
        told += bank.update({"rf": other[k], "lf": sample})
        monkeypatch.undo()
    assert [(event.seq, event.contact) for event in told if event.leg == "lf"] == wanted
    faulty = bank.learner("rf")
    assert faults == 3 * [("rf", "division by zero")]
    assert faulty.status.note == (
        "3 faults in learning, restarted each time; last ZeroDivisionError: division by zero"
    )
    assert any(event.leg == "rf" and event.seq > 200 for event in told), "it goes on"


def test_where_nobody_is_told_of_faults_they_are_raised(
    two_legs: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    bank = LearnerBank(two_legs)
    monkeypatch.setattr("adaptive_contact.core.leg_learner.ContactLearner.learn_from_tick", None)
    with pytest.raises(TypeError):
        bank.update({"rf": FakeLeg(seed=6).stream(1)[0]})


@pytest.fixture
def two_legs(robot: Robot) -> Robot:
    other = msgspec.structs.replace(robot.legs[0], id="lf")
    return msgspec.structs.replace(robot, legs=(*robot.legs, other))


@pytest.mark.parametrize("restarted", [False, True])
def test_a_fault_costs_what_was_learned_since_the_last_save_and_the_next_one_the_rest(
    robot: Robot, baseline: Baseline, restarted: bool
) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, FakeLeg(seed=6).stream(12))
    assert learner.status.buffer.lift_ticks > 0
    held, saved = learner.status.buffer, learner.snapshot()
    if restarted:
        learner = ContactLearner(robot, "rf", baseline)
        assert learner.restore(saved or {}) is None
    learner.reset_after_fault(ZeroDivisionError("division by zero"))
    assert learner.status.buffer == held
    learner.reset_after_fault(ZeroDivisionError("division by zero"))
    assert learner.status.buffer.lift_ticks == 0


def test_a_fault_is_one_line_however_long_its_words(robot: Robot) -> None:
    learner = ContactLearner(robot, "rf")
    learner.reset_after_fault(ValueError("first\nsecond " + "x" * 5000))
    note = str(learner.status.note)
    assert "ValueError: first second x" in note
    assert len(note) < 250


def test_whoever_may_have_heard_of_a_touch_is_told_that_it_is_over(robot: Robot) -> None:
    """With the first sample, once; also without a model."""
    stream = FakeLeg(seed=6).stream(1)
    learner = ContactLearner(robot, "rf")
    learner.request_release()
    event = learner.update(stream[0])
    assert (event.contact, event.t_ns) == (False, stream[0].t_ns)
    assert [learner.update(sample) for sample in stream[1:]] == [None] * (len(stream) - 1)


def test_a_contact_whose_samples_have_stopped_is_withdrawn_until_the_next_touch(
    robot: Robot, baseline: Baseline
) -> None:
    stream = FakeLeg(seed=6).stream(12, touch=lambda _: 16)
    learner = ContactLearner(robot, "rf", baseline)
    assert learner.withdraw() is None, "there was no sample"
    last = next(k for k, s in enumerate(stream) if (e := learner.update(s)) and e.contact)
    before = learner.status
    gone = learner.withdraw()
    assert (gone.contact, gone.withheld, gone.status) == (False, True, "silent")
    assert (gone.t_ns, gone.onset_ns, gone.score) == (stream[last].t_ns, stream[last].t_ns, 0.0)
    after = learner.status
    assert (before.contact, after.contact) == (True, False)
    assert (before.contacts, before.withheld) == (after.contacts, after.withheld)
    events = [e for s in stream[last + 50 :] if (e := learner.update(s)) is not None]
    assert events[0].contact, "the end of what was withdrawn is no news"
