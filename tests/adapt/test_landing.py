"""Feet that come late: judged on after the turn to stance, learned from never, counted, noted."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.adapt import Baseline, ContactLearner
from adaptive_contact.adapt.block import Block
from adaptive_contact.adapt.recent import AWAITED
from adaptive_contact.adapt.swing import (
    AFTER_TICKS,
    LANDINGS,
    QUIET_SCORE,
    STILL_TICKS,
    Landings,
    SwingWatch,
)
from adaptive_contact.adapt.team import Team
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.wire import ServoSample

from .conftest import TOML, FakeLeg, play, samples

TICKS = 28  # of a swing and its stance, as FakeLeg makes them
LEG = parse_robot(TOML, source="testbot").leg("rf")
TURN = 18  # where these gaits say "stance": ten ticks before the next swing


def stop_of(number: int) -> int | None:
    """Two swings in three touch two or three ticks after the turn, the third not at all."""
    return None if number % 3 == 2 else TURN + 1 + number % 2


def planned(leg: FakeLeg, swings: int) -> list[ServoSample]:
    """A gait that turns at a planned touch-down while its foot is on its way."""
    measured, desired, _, _ = leg.run(swings, touch=stop_of)
    swing = np.arange(len(measured)) % TICKS < TURN
    return samples(measured, desired, swing)


def test_touches_after_the_turn_are_found_and_no_tick_of_them_learned(
    robot: Robot, baseline: Baseline
) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    events = play(learner, planned(FakeLeg(seed=31), 120))
    touched = {event.seq // TICKS: event.seq % TICKS for event in events if event.contact}
    late = [number for number in range(120) if stop_of(number) is not None]
    assert len(touched) == sum(event.contact for event in events), "one to a swing at most"
    found = [n for n in late if n in touched and 0 < touched[n] - (stop_of(n) or 0) <= 4]
    assert len(found) >= 0.95 * len(late)
    assert set(touched) <= set(late), "an alarm where nothing touched"
    confirmed = [t_ns // 20_000_000 % TICKS for t_ns in learner.drain_confirmed()]
    assert len(confirmed) > 500
    assert max(confirmed) < TURN
    status = learner.status
    assert status.status == "valid"
    assert status.note is not None
    assert status.note.startswith("20 of the last 20 touches came after phase had turned to stance")


def test_a_turn_in_mid_air_causes_nothing(robot: Robot, baseline: Baseline) -> None:
    """The same free motion with its turn early, late or not at all: no event of any kind."""
    measured, desired, swing, _ = FakeLeg(seed=32).run(60)
    for turn in (14, TURN, 22):
        phase = swing & (np.arange(len(swing)) % TICKS < turn)
        assert play(ContactLearner(robot, "rf", baseline), samples(measured, desired, phase)) == []


def test_a_swing_that_only_the_next_one_ends_is_learned_in_the_second_half(
    robot: Robot, baseline: Baseline
) -> None:
    """Of a tick: an event of another leg would have waited for it."""
    learner = ContactLearner(robot, "rf", baseline)
    team = Team([learner])
    grown = 0
    # The stance of four ticks is shorter than the wait.
    for sample in samples(*FakeLeg(seed=33).run(30)[:3]):
        before = learner.status.buffer.descent_ticks
        team.judge([sample])
        if sample.seq % TICKS == 0:
            assert learner.status.buffer.descent_ticks == before
            team.finish()
            grown += learner.status.buffer.descent_ticks > before
        team.finish()
    assert grown >= 5


def test_after_the_turn_a_touch_pushes_the_foot_up(robot: Robot, baseline: Baseline) -> None:
    """The verdict against the formula, for pushes of any direction."""
    rng = np.random.default_rng(34)
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, samples(*FakeLeg(seed=34).run(4)[:3]))
    detector = learner.detector
    assert detector is not None
    block = Block([detector])
    tracker = detector.tracker
    told = {True: 0, False: 0}
    for _ in range(200):
        residual, gradient = rng.normal(0.0, 0.02, (3, 3)), rng.normal(0.0, 0.1, 3)
        tracker.residuals[:], tracker.increments[:] = residual, rng.normal(0.0, 0.02, (3, 3))
        tracker.usable = 3
        detector.place([0.0] * 3, [0.02] * 3, 1)
        detector.await_touch(gradient)
        (verdict,) = block.judge([0])
        for w in (1, 2, 3):
            whiten = detector.recent.whiten[detector.context][w - 1]
            z = whiten @ residual[:w].sum(axis=0)
            up = float(z @ whiten @ gradient) > 0.0
            expected = float(z @ z) / detector.recent.awaited[w - 1] if up else 0.0
            assert verdict.scores[w - 1] == pytest.approx(expected, rel=1e-9)
            told[up] += 1
        detector.place([0.0] * 3, [0.02] * 3, 1)  # the next tick is one of a swing
        assert detector.limits == detector.recent.limits
    assert min(told.values()) > 100


def test_awaited_touches_have_thresholds_of_their_own_aim(robot: Robot, baseline: Baseline) -> None:
    learner = ContactLearner(robot, "rf", baseline)
    assert learner.detector is not None
    recent = learner.detector.recent
    aim = robot.detector.false_alarms_per_hour
    assert recent.limits == pytest.approx(baseline.thresholds(aim))
    assert recent.awaited == pytest.approx(baseline.thresholds(AWAITED * aim))
    assert all(np.array(recent.awaited) < recent.limits)


Step = tuple[Literal["swing", "stance"], bool, bool]  # phase, in the air, the leg moves


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["swing", "stance"]), st.booleans(), st.booleans())))
def test_waiting_ends_with_a_touch_a_standstill_a_swing_or_16_ticks(steps: list[Step]) -> None:
    """Against the rules, spelled out for any course of phases."""
    watch = SwingWatch(LEG)
    at, still, awaiting, over, ended = 0, 0, None, True, 0
    for k, (phase, air, moves) in enumerate(steps):
        at += moves
        sample = ServoSample(t_ns=k, seq=k, measured=[0.1 * at] * 3, desired=[0.1] * 3, phase=phase)

        def end() -> None:
            nonlocal ended
            ended += 1

        ended = 0
        was = watch.after
        watch.follow(sample, air, end)
        if phase == "swing":
            assert ended == (was > 0)
            assert watch.after == 0 < watch.ticks
            still, awaiting, over = 0, 0, False
            continue
        still = 0 if moves or k == 0 else still + 1
        assert ended == 0
        if not over and awaiting is not None:
            goes_on = air and awaiting < AFTER_TICKS and still < STILL_TICKS
            assert watch.expired == (air and awaiting == AFTER_TICKS)
            awaiting, over = (awaiting + 1, False) if goes_on else (None, True)
        assert watch.after == (awaiting or 0)
        assert (watch.ticks > 0) == (not over)


class TestLandings:
    def test_only_a_whole_quiet_wait_is_no_touch(self) -> None:
        landings = Landings()
        cases = [
            (AFTER_TICKS, QUIET_SCORE / 2, True, True, True),
            (AFTER_TICKS - 1, QUIET_SCORE / 2, True, True, False),  # a tick was not judged
            (AFTER_TICKS, QUIET_SCORE, True, True, False),  # something pushed
            (AFTER_TICKS, QUIET_SCORE / 2, False, True, False),  # the model does not fit
            (AFTER_TICKS, QUIET_SCORE / 2, True, False, False),  # it ended otherwise
        ]
        for k, (ticks, score, sure, expired, counts) in enumerate(cases):
            before = landings.untouched
            for _ in range(ticks):
                landings.look(score, sure=sure)
            landings.end(k, expired=expired)
            assert landings.untouched - before == counts, cases[k]
        assert landings.untouched_ns == 0

    def test_touches_that_keep_coming_late_are_noted(self) -> None:
        landings = Landings()
        for _ in range(LANDINGS):
            landings.touched(-2)
        assert landings.note is None
        for k in range(LANDINGS // 2 + 1):
            assert landings.note is None
            landings.touched(3 + k % 3)
        assert landings.note is not None
        assert landings.note.startswith("11 of the last 20 touches came after phase")
        assert "by 4 ticks" in landings.note
        for _ in range(LANDINGS // 2):  # the nine from before the turn go first
            landings.touched(0)
        assert landings.note is None


def test_a_swing_without_ground_is_told_in_the_status(robot: Robot, baseline: Baseline) -> None:
    """A long stance in the air, under a command that goes on slowly down."""
    measured, desired, swing, _ = FakeLeg(seed=35, noise=0.0).run(3)
    stream = samples(measured, desired, swing)
    last = stream[-1]
    # What the model of free motion foretells, so that nothing pushes.
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, stream)
    assert learner.status.untouched == 0
    told = []
    for i in range(1, 40):
        tracker = learner.tracker
        assert tracker is not None
        free = tracker.measured[0] + (tracker.increment if tracker.predicted else 0.0)
        down = [last.desired[0], last.desired[1] - 0.004 * i, last.desired[2]]
        sample = msgspec.structs.replace(
            last,
            seq=last.seq + i,
            t_ns=last.t_ns + 20_000_000 * i,
            measured=free.tolist(),
            desired=down,
            phase="stance",
        )
        assert learner.update(sample) is None
        told.append(learner.status.untouched)
    assert told[-1] == 1
    # Four ticks of stance are FakeLeg's; the wait is over with the seventeenth.
    assert told.index(1) == AFTER_TICKS - 4
    assert learner.status.untouched_ns == last.t_ns + 20_000_000 * (AFTER_TICKS - 4 + 1)
