"""The learner of one leg, on a synthetic leg whose contacts and changes are known."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.adapt import Baseline, LearnerBank, LearnerMode
from adaptive_contact.adapt.follower import Follower
from adaptive_contact.errors import BaselineError, ConfigurationError
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ContactEvent, Reject

from .conftest import FakeLeg, samples

PERIOD = 20_000_000


def play(learner: ContactLearner, stream: list[ServoSample]) -> list[ContactEvent]:
    return [event for s in stream if (event := learner.update(s)) is not None]


def outcome(events: list[ContactEvent], first: int, stop: int | None) -> str:
    """Of the swing whose first sample is ``first``: hit, miss, alarm or clean."""
    inside = [e.seq - first for e in events if e.contact and first <= e.seq < first + 24]
    if stop is None:
        return "alarm" if inside else "clean"
    early = [tick for tick in inside if tick <= stop]
    return "alarm" if early else "hit" if inside else "miss"


def outcomes(events: list[ContactEvent], swings: range, stops: list[int | None]) -> list[str]:
    return [outcome(events, 28 * n, stops[n]) for n in swings]


def test_contacts_are_found_and_nothing_else(robot: Robot, baseline: Baseline) -> None:
    stops = [16 if n % 2 else None for n in range(200)]
    measured, desired, swing, _ = FakeLeg(seed=2).run(200, touch=lambda n: stops[n])
    events = play(ContactLearner(robot, "rf", baseline), samples(measured, desired, swing))
    told = outcomes(events, range(200), stops)
    assert told.count("alarm") == 0
    assert told.count("miss") <= 1
    late = [e.seq % 28 - 16 for e in events if e.contact]
    assert np.median(late) <= 2
    onset_error = [(e.onset_ns / PERIOD) % 28 - 16 for e in events if e.contact]
    assert np.median(np.abs(onset_error)) < 1.5
    assert all(e.onset_ns <= e.t_ns for e in events)


def test_every_contact_is_released_in_the_next_swing(robot: Robot, baseline: Baseline) -> None:
    measured, desired, swing, _ = FakeLeg(seed=3).run(
        40, touch=lambda n: 16 if n % 3 == 0 else None
    )
    events = play(ContactLearner(robot, "rf", baseline), samples(measured, desired, swing))
    states = [e.contact for e in events]
    assert states == [i % 2 == 0 for i in range(len(states))]


@pytest.mark.parametrize("run", [2, None])
def test_a_restart_of_the_source_ends_a_contact(
    robot: Robot, baseline: Baseline, run: int | None
) -> None:
    """With a new run at once, without one when the source's clock is believed; never silently."""
    measured, desired, swing, _ = FakeLeg(seed=3).run(40, touch=lambda n: 16)
    stream = samples(measured, desired, swing)
    learner = ContactLearner(robot, "rf", baseline)
    last: ContactEvent | None = None
    first = [
        msgspec.structs.replace(s, run=1 if run else None, t_ns=s.t_ns + 10**15) for s in stream
    ]
    for s in first[: 28 * 20 + 24]:
        last = learner.update(s) or last
    assert last is not None
    assert last.contact
    assert learner.contact
    again = play(learner, [msgspec.structs.replace(s, run=run) for s in stream[:12]])
    assert [(e.contact, e.seq, e.score) for e in again] == [(False, 0 if run else 9, 0.0)]
    assert again[0].onset_ns == again[0].t_ns
    assert not learner.status.contact


def test_no_event_is_decided_outside_a_swing(robot: Robot, baseline: Baseline) -> None:
    measured, desired, swing, _ = FakeLeg(seed=4).run(60, touch=lambda _: 16)
    events = play(ContactLearner(robot, "rf", baseline), samples(measured, desired, swing))
    assert events
    assert all(swing[e.seq] for e in events)


def test_a_command_that_freezes_is_no_contact(robot: Robot, baseline: Baseline) -> None:
    measured, desired, swing, _ = FakeLeg(seed=5).run(30)
    stream = samples(measured, desired, swing)
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, stream[: 28 * 20 + 13])
    held = stream[28 * 20 + 12]
    frozen = [
        msgspec.structs.replace(held, seq=held.seq + i, t_ns=held.t_ns + i * PERIOD, phase="stance")
        for i in range(1, 50)
    ]
    assert not [e for e in play(learner, frozen) if e.contact]


def test_the_same_samples_give_the_same_events(robot: Robot, baseline: Baseline) -> None:
    stream = samples(*FakeLeg(seed=6).run(100, touch=lambda n: 16 if n % 2 else None)[:3])
    first = play(ContactLearner(robot, "rf", baseline), stream)
    assert first == play(ContactLearner(robot, "rf", baseline), stream)


# -- following the leg ---------------------------------------------------------------------------


def changed(n: int) -> float:
    return 0.7 if n >= 60 else 1.0


def run_changed(
    mode: LearnerMode, robot: Robot, baseline: Baseline, *, always: bool = False
) -> list[str]:
    stops = [16 if always or n % 2 else None for n in range(160)]
    measured, desired, swing, _ = FakeLeg(seed=7).run(160, touch=lambda n: stops[n], change=changed)
    learner = ContactLearner(robot, "rf", baseline, mode=mode)
    events = play(learner, samples(measured, desired, swing))
    return outcomes(events, range(160), stops)


def errors(told: list[str]) -> int:
    return sum(word in ("miss", "alarm") for word in told)


def test_a_changed_leg_is_followed(robot: Robot, baseline: Baseline) -> None:
    frozen = run_changed(LearnerMode.FROZEN, robot, baseline)
    full = run_changed(LearnerMode.FULL, robot, baseline)
    assert errors(frozen[:60]) <= 1
    assert errors(frozen[80:]) > 30, "the change must matter for the test to mean anything"
    assert errors(full[:60]) <= 1
    assert errors(full[80:]) <= 2
    assert full[60:80].count("alarm") <= 2, "a lift is heard before its swing alarms"


def test_it_is_followed_even_when_every_swing_ends_in_contact(
    robot: Robot, baseline: Baseline
) -> None:
    full = run_changed(LearnerMode.FULL, robot, baseline, always=True)
    assert errors(full[85:]) <= 3


def test_then_it_is_learned_to_the_end_of_its_descents(
    robot: Robot, baseline: Baseline, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a leg that has changed, and but for what touches; before, the guard is kept."""
    *arrays, touching = FakeLeg(seed=7).run(160, touch=lambda _: 16, change=changed)

    def learned() -> tuple[np.ndarray, np.ndarray]:
        learner = ContactLearner(robot, "rf", baseline)
        play(learner, samples(*arrays))
        ticks = np.array(learner.drain_confirmed()) // PERIOD
        assert not touching[ticks].any()
        late = ticks[(ticks % 28 == 15) | (ticks % 28 == 16)]  # the foot is stopped in the 17th
        return late[late < 60 * 28], late[late >= 60 * 28]

    before, after = learned()
    monkeypatch.setattr(Follower, "changed", False)
    guarded_before, guarded_after = learned()
    assert len(before) == len(guarded_before) <= 2
    assert len(after) > 2 * len(guarded_after) > 0


def test_a_stream_of_contacts_does_not_blind_it(robot: Robot, baseline: Baseline) -> None:
    measured, desired, swing, touching = FakeLeg(seed=8).run(500, touch=lambda _: 16)
    learner = ContactLearner(robot, "rf", baseline)
    events = play(learner, samples(measured, desired, swing))
    told = outcomes(events, range(500), [16] * 500)
    assert errors(told[-200:]) <= 2
    confirmed = np.array(learner.drain_confirmed()) // PERIOD
    assert len(confirmed) > 1000
    assert touching[confirmed].mean() <= 0.001


def test_standing_changes_nothing(robot: Robot, baseline: Baseline) -> None:
    stream = samples(*FakeLeg(seed=9).run(30)[:3])
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, stream)
    model = learner.model
    assert model is not None
    before = model.coefficients.copy()
    last = stream[-1]
    still = [
        msgspec.structs.replace(last, seq=last.seq + i, t_ns=last.t_ns + i * PERIOD, phase="stance")
        for i in range(1, 5000)
    ]
    assert play(learner, still) == []
    # What the last swing confirmed is still drained in the first ticks of standing.
    after = learner.model
    assert after is not None
    assert np.abs(after.coefficients - before).max() < 0.02
    assert learner.status.status == "valid"


# -- cold start ----------------------------------------------------------------------------------


def test_without_a_baseline_it_learns(robot: Robot) -> None:
    stops = [16 if n % 2 and n > 70 else None for n in range(160)]
    measured, desired, swing, _ = FakeLeg(seed=11).run(160, touch=lambda n: stops[n])
    learner = ContactLearner(robot, "rf")
    assert learner.status.status == "learning"
    assert learner.model_report is None
    events = play(learner, samples(measured, desired, swing))
    assert learner.status.status == "valid"
    assert learner.status.model_version >= 1
    report = learner.model_report
    assert report is not None
    assert len(report.equations) == 3
    told = outcomes(events, range(75, 160), stops)
    assert errors(told) <= 4


def test_a_frozen_learner_without_a_baseline_stays_silent(robot: Robot) -> None:
    stream = samples(*FakeLeg(seed=12).run(60)[:3])
    learner = ContactLearner(robot, "rf", mode=LearnerMode.FROZEN)
    assert play(learner, stream) == []
    assert learner.status.status == "learning"


def test_a_baseline_of_another_robot_is_refused(robot: Robot, baseline: Baseline) -> None:
    other = dataclasses.replace(baseline, robot="otherbot")
    with pytest.raises(BaselineError, match="is of robot 'otherbot'"):
        ContactLearner(robot, "rf", other)
    with pytest.raises(ConfigurationError, match="has no leg 'xx'"):
        ContactLearner(robot, "xx")


# -- bad input -----------------------------------------------------------------------------------


def test_gaps_and_missing_readings_are_bridged(robot: Robot, baseline: Baseline) -> None:
    rng = np.random.default_rng(0)
    stops = [16 if n % 2 else None for n in range(200)]
    stream = samples(*FakeLeg(seed=13).run(200, touch=lambda n: stops[n])[:3])
    lost = rng.random(len(stream)) < 0.01
    invalid = rng.random(len(stream)) < 0.02
    damaged = [
        msgspec.structs.replace(
            s, valid=[True, False, True], measured=[s.measured[0], -3.14, s.measured[2]]
        )
        if bad
        else s
        for s, bad, gone in zip(stream, invalid, lost, strict=True)
        if not gone
    ]
    learner = ContactLearner(robot, "rf", baseline)
    told = outcomes(play(learner, damaged), range(200), stops)
    assert told.count("alarm") <= 2
    assert told.count("miss") <= 6
    kept = np.flatnonzero(~lost)
    assert learner.status.missed == lost[kept[0] : kept[-1]].sum()


@pytest.mark.parametrize("back", [0, 2, 4])
def test_after_a_long_gap_a_foot_on_the_ground_is_not_taken_for_free(
    robot: Robot, baseline: Baseline, back: int
) -> None:
    """From one swing into the next one's lift, with a foot that lets go in its seventh tick."""
    held = samples(*FakeLeg(seed=13).run(60, pressed=7)[:3])
    whole = play(ContactLearner(robot, "rf", baseline), held)
    assert not [event for event in whole if event.contact]
    for swing in range(20, 40):
        learner = ContactLearner(robot, "rf", baseline)
        gone = range(28 * swing + 14, 28 * (swing + 1) + back)
        told = play(learner, [s for s in held[: 28 * (swing + 2)] if s.seq not in gone])
        assert not [event for event in told if event.contact], swing


def test_after_a_long_gap_nothing_is_said_until_the_window_is_full(
    robot: Robot, baseline: Baseline
) -> None:
    stream = samples(*FakeLeg(seed=14).run(60, touch=lambda _: 16)[:3])
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, stream[:280])
    resumed = play(learner, stream[280 + 12 : 280 + 12 + 5])
    assert resumed == []
    assert learner.status.missed == 12


def slowed(stream: list[ServoSample], first: int, stop: int, factor: float) -> list[ServoSample]:
    """The same samples, those of a stretch so many times as far apart."""
    out, late = [], 0
    for s in stream:
        late += round((factor - 1.0) * PERIOD) if first <= s.seq < stop else 0
        out.append(msgspec.structs.replace(s, t_ns=s.t_ns + late))
    return out


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_rate_off_by_a_fifth_is_said_and_not_learned(
    robot: Robot, baseline: Baseline, factor: float
) -> None:
    first, stop = 100, 160  # swings
    stops = [16 if n % 2 else None for n in range(260)]
    # Slower ticks are longer ones: the leg moves further in each.
    measured, desired, swing, _ = FakeLeg(seed=21).run(
        260, touch=lambda n: stops[n], change=lambda n: factor if first <= n < stop else 1.0
    )
    stream = slowed(samples(measured, desired, swing), 28 * first, 28 * stop, factor)
    learner = ContactLearner(robot, "rf", baseline)
    assert "alarm" not in outcomes(play(learner, stream[: 28 * first]), range(first), stops)
    before, confirmed = learner.status, learner.drain_confirmed()
    assert confirmed
    during = play(learner, stream[28 * first : 28 * stop])
    assert [e for e in during if e.contact] == []
    assert learner.drain_confirmed() == []
    assert learner.status.buffer == before.buffer
    assert learner.status.status == "valid"
    assert learner.status.note == (
        f"samples are {20 * factor:.1f} ms apart, robot.toml says 20.0 ms: "
        "nothing is judged or learned until they agree"
    )
    after = outcomes(play(learner, stream[28 * stop :]), range(stop, 260), stops)
    assert "alarm" not in after
    assert after[1:].count("miss") <= 1
    assert learner.status.note is None
    assert learner.drain_confirmed()


@pytest.mark.parametrize("counted", [True, False])
def test_a_stream_that_stops_in_a_swing_teaches_nothing_of_it(
    robot: Robot, baseline: Baseline, *, counted: bool
) -> None:
    """For a minute, and then goes on in another swing, whether its numbers tell of it or not."""
    stream = samples(*FakeLeg(seed=22).run(80)[:3])
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, stream[: 28 * 40 + 15])
    learner.drain_confirmed()
    resumed = [
        msgspec.structs.replace(
            s,
            t_ns=s.t_ns + 60 * 50 * PERIOD,
            seq=s.seq + (60 * 50 if counted else -28),
        )
        for s in stream[28 * 41 + 15 :]
    ]
    events = play(learner, resumed[:28])
    assert [e for e in events if e.contact] == []
    # Of the swing it stopped in and of that it came back in, nothing is confirmed.
    bounds = stream[28 * 40].t_ns, resumed[9].t_ns
    assert not [t for t in learner.drain_confirmed() if bounds[0] <= t <= bounds[1]]
    play(learner, resumed[28:])
    assert learner.drain_confirmed()
    assert learner.status.status == "valid"


bad_values = st.sampled_from([float("nan"), float("inf"), -float("inf"), 1e9, 0.0, -3.14])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 119), bad_values), max_size=25))
def test_bad_samples_are_counted_and_change_nothing_else(
    robot: Robot, baseline: Baseline, plan: list[tuple[int, int, float]]
) -> None:
    """A stream with junk between its samples gives the events of the stream without."""
    stream = samples(*FakeLeg(seed=15).run(5, touch=lambda n: 16 if n % 2 else None)[:3])
    clean = play(ContactLearner(robot, "rf", baseline), stream)
    learner = ContactLearner(robot, "rf", baseline)
    events = []
    for k, sample in enumerate(stream):
        for kind, where, value in plan:
            if where == k:
                events += play(learner, [_junk(kind, sample, value)])
        events += play(learner, [sample])
    assert [(e.seq, e.contact) for e in events] == [(e.seq, e.contact) for e in clean]
    assert learner.status.ticks == len(stream)


def _junk(kind: int, sample: ServoSample, value: float) -> ServoSample:
    replace = msgspec.structs.replace
    if kind == 0:
        return replace(sample, measured=[float("nan"), value, 0.0])
    if kind == 1:
        return replace(sample, measured=[0.0] * 2)
    if kind == 2:
        return replace(sample, desired=[0.0, float("inf"), value])
    if kind == 3:
        return replace(sample, t_ns=-1)
    if kind == 4:
        return replace(sample, preview=[[0.0]])
    if kind == 5:
        return replace(sample, valid=[True])
    return replace(sample, desired=[1e9, 0.0, 0.0])


def test_rejects_are_told_by_reason(robot: Robot, baseline: Baseline) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    stream = samples(*FakeLeg(seed=16).run(2)[:3])
    play(learner, stream)
    learner.count(Reject.MALFORMED, 3)
    learner.update(stream[5])
    learner.update(msgspec.structs.replace(stream[-1], t_ns=2**62, seq=2**40, measured=[0.0]))
    assert learner.status.rejects == {"malformed": 3, "time_backwards": 1, "wrong_joints": 1}


def test_a_leg_that_the_baseline_has_and_the_description_lacks_is_a_stranger(
    robot: Robot, baseline: Baseline
) -> None:
    both = dataclasses.replace(baseline, legs={**baseline.legs, "rr": baseline.legs["rf"]})
    bank = LearnerBank(robot, both, shielded=True)
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
