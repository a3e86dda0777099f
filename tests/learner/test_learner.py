"""The learner of one leg, on a synthetic leg whose contacts and changes are known."""

from __future__ import annotations

import dataclasses
import re

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner, LearnerBank
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.errors import BaselineError, ConfigurationError
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.wire import DriftLevel

from .conftest import PERIOD, FakeLeg, followed, outcomes, play, samples, trained


def test_a_command_that_freezes_is_no_contact(robot: Robot, baseline: Baseline) -> None:
    stream = FakeLeg(seed=5).stream(30)
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, stream[: 28 * 20 + 13])
    held = stream[28 * 20 + 12]
    frozen = [
        msgspec.structs.replace(held, seq=held.seq + i, t_ns=held.t_ns + i * PERIOD, phase="stance")
        for i in range(1, 50)
    ]
    assert not [e for e in play(learner, frozen) if e.contact]


def test_a_leg_whose_lifts_are_never_heard_says_so(robot: Robot, baseline: Baseline) -> None:
    """A controller whose swings begin past the top."""
    measured, desired, _, _ = FakeLeg(seed=5).run(40)
    tick = np.arange(len(measured)) % 28
    late = samples(measured, desired, (tick >= 12) & (tick < 24))
    _, told, _ = followed(ContactLearner(robot, "rf", baseline), late)
    assert told[14] is None
    assert "no lift could be used in" in str(told[-1])
    assert "changes of the leg are not followed" in str(told[-1])
    heard = ContactLearner(robot, "rf", baseline)
    play(heard, FakeLeg(seed=5).stream(40))
    assert heard.status.note is None


# -- following the leg ---------------------------------------------------------------------------


def changed(n: int) -> float:
    return 0.7 if n >= 60 else 1.0


Changed = tuple[DriftLevel, list[str]]
STOPS: list[int | None] = [16 if n % 2 else None for n in range(160)]


@pytest.fixture(scope="module")
def changing(robot: Robot, baseline: Baseline) -> list[Changed]:
    """Nine legs that change at their 60th swing: what is told of it, and of each swing."""
    found = []
    for seed in range(7, 16):
        run = FakeLeg(seed=seed).run(160, touch=lambda n: STOPS[n], change=changed)
        stream, learner = samples(*run[:3]), ContactLearner(robot, "rf", baseline)
        events = play(learner, stream[: 28 * 100])
        again, drift = ContactLearner(robot, "rf", baseline), learner.status.drift
        assert again.restore(learner.snapshot() or {}) is None
        assert again.status.drift.kind == drift.kind
        events += play(learner, stream[28 * 100 :])
        found.append((drift, outcomes(events, range(160), STOPS)))
    return found


def errors(told: list[str]) -> int:
    return sum(word in ("miss", "alarm") for word in told)


def test_a_changed_leg_is_followed(
    robot: Robot, baseline: Baseline, changing: list[Changed]
) -> None:
    run = FakeLeg(seed=7).run(160, touch=lambda n: STOPS[n], change=changed)
    learner = ContactLearner(robot, "rf", baseline, mode=LearnerMode.FROZEN)
    frozen = outcomes(play(learner, samples(*run[:3])), range(160), STOPS)
    assert errors(frozen[:60]) <= 1
    assert errors(frozen[80:]) > 30, "the change must matter for the test to mean anything"
    # One leg in ten goes astray once more on its way.
    assert max(errors(told[:60]) for _, told in changing) <= 2
    assert np.median([errors(told[80:]) for _, told in changing]) <= 2
    assert sum(errors(told[80:]) for _, told in changing) <= 3 * len(changing)
    # A lift is heard before its swing alarms.
    assert np.median([told[60:80].count("alarm") for _, told in changing]) <= 2


def test_what_a_leg_has_changed_in_and_when_is_told(changing: list[Changed]) -> None:
    """Touches of every other swing are none of it."""
    # One leg in ten changes once more on its way, and tells of that.
    swing_ns = 28 * PERIOD
    soon = [of for of, _ in changing if 60 <= (of.since_ns or 0) / swing_ns < 68]
    assert len(soon) >= 8
    assert all(drift.kind == "drive" for drift in soon)


def test_a_stream_of_contacts_neither_blinds_it_nor_keeps_it_from_following(
    robot: Robot, baseline: Baseline
) -> None:
    run = FakeLeg(seed=8).run(500, touch=lambda _: 16, change=changed)
    learner = ContactLearner(robot, "rf", baseline)
    told = outcomes(play(learner, samples(*run[:3])), range(500), [16] * 500)
    assert errors(told[85:160]) <= 3
    assert errors(told[-200:]) <= 2
    confirmed = np.array(learner.drain_confirmed()) // PERIOD
    assert len(confirmed) > 1000
    assert run[3][confirmed].mean() <= 0.001


def test_the_report_says_what_its_terms_of_changes_speak_of(
    robot: Robot, baseline: Baseline
) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    known = baseline.legs["rf"].model
    fresh = learner.model_report
    assert fresh.first == []
    play(learner, FakeLeg(seed=12).stream(12))
    report = learner.model_report
    assert report.model_version >= 1
    named = {term.name for joint in report.terms for term in joint}
    assert {"tanh(δ_coxa/1)", "δ_tibia(2s)-δ_tibia"} <= named
    for joint, first in enumerate(report.first):
        assert {t.name: t.coefficient for t in first} == dict(known.terms(joint))


# -- no baseline ----------------------------------------------------------------------------------


def test_without_a_baseline_it_learns(robot: Robot) -> None:
    learner = ContactLearner(robot, "rf")
    assert learner.status.status == "learning"
    assert learner.model_report.origin == "what is known of any leg"
    stream = FakeLeg(seed=11).stream(160, touch=lambda n: 16 if n % 2 and n > 70 else None)
    play(learner, stream[: 28 * 5])
    assert "of 10 swings" in str(learner.status.note)
    play(learner, stream[28 * 5 :])
    assert (learner.status.status, learner.status.note) == ("valid", None)


def test_a_baseline_of_another_leg_is_thrown_and_stays_so_over_a_restart(
    robot: Robot, baseline: Baseline
) -> None:
    known = baseline.legs["rf"]
    model = known.model.moved(0.0 * known.model.coefficients, 0)  # of one that never moves
    of_another = dataclasses.replace(baseline, legs={"rf": dataclasses.replace(known, model=model)})
    stream = FakeLeg(seed=11).stream(100)
    for swings in (0, 1, 2, 10):  # before the third lift has told, and after
        before, learner = (ContactLearner(robot, "rf", of_another) for _ in range(2))
        play(before, stream[: 28 * swings])
        assert learner.restore(before.snapshot()) is None
        play(learner, stream[28 * swings : 28 * 10])
        assert learner.status.status == "learning"
        note = r"the baseline does not fit this leg: learning a new model \(\d of 10 swings\)"
        assert re.fullmatch(note, learner.status.note)
    play(learner, stream[28 * 10 :])
    assert (learner.status.status, learner.status.note) == ("valid", None)


def test_a_frozen_learner_without_a_baseline_stays_silent(robot: Robot) -> None:
    stream = FakeLeg(seed=12).stream(60)
    learner = ContactLearner(robot, "rf", mode=LearnerMode.FROZEN)
    assert play(learner, stream) == []
    assert learner.status.status == "learning"


def test_a_baseline_of_another_robot_is_refused(robot: Robot, baseline: Baseline) -> None:
    other = dataclasses.replace(baseline, robot="otherbot")
    with pytest.raises(BaselineError, match="is of robot 'otherbot'"):
        ContactLearner(robot, "rf", other)
    with pytest.raises(ConfigurationError, match="has no leg 'xx'"):
        ContactLearner(robot, "xx")


@pytest.mark.parametrize("gain", [0.25, 0.15])
def test_servos_that_are_far_behind_their_commands_are_not_taken_for_a_held_foot(
    robot: Robot, gain: float
) -> None:
    """By four and by seven ticks: the foot never gets to where its command was."""
    known = trained(robot, FakeLeg(seed=1, gain=gain).run(500))
    # Free, then caught for thirty swings, then free.
    caught = range(40, 70)
    stream = FakeLeg(seed=3, gain=gain).stream(110, touch=lambda n: 0 if n in caught else None)
    told, _, confirmed = followed(ContactLearner(robot, "rf", known), stream)
    assert told[5:40].count("valid") == 35
    assert sum(map(len, confirmed[:40])) > 200
    assert told[46:70].count("ambiguous") == 24
    assert not any(confirmed[41:70])
    assert told[76:].count("valid") >= 30
    assert sum(map(len, confirmed[76:])) > 150


def test_contacts_never_loosen_a_threshold(robot: Robot, baseline: Baseline) -> None:
    """Two hundred swings that all end in a touch, early or late, against the same leg without."""
    limits, levels = [], []
    for touch in (None, 15, 21):
        run = FakeLeg(seed=8).run(240, touch=lambda n, t=touch: t if n >= 20 else None)
        learner = ContactLearner(robot, "rf", baseline)
        play(learner, samples(*run[:3]))
        recent, adapter = learner.lifecycle.noise_tracker, learner.lifecycle.adapter
        limits.append(recent.thresholds)
        levels.append(adapter.variance_in_force)
    for after in (1, 2):
        np.testing.assert_array_less(limits[after], 1.05 * limits[0])
        assert levels[after] <= 1.05 * levels[0]


@pytest.mark.parametrize("wrong", [{"v": 1, "t_ns": 0, "seq": 0}, b"payload", None, [0.1, 0.2]])
def test_what_is_no_sample_is_refused_in_a_line_that_says_what_to_pass(wrong: object) -> None:
    learner = ContactLearner(shipped_robot(), "rf")
    bank = LearnerBank(shipped_robot())
    for update in (lambda: learner.update(wrong), lambda: bank.update({"rf": wrong})):  # type: ignore[arg-type,dict-item]
        with pytest.raises(TypeError, match="expected a ServoSample, found") as caught:
            update()
        assert "pass ServoSample(t_ns=" in str(caught.value)
        assert "\n" not in str(caught.value)
    assert learner.status.ticks == 0
