"""Touches that come late, soon in the lift, or weakly."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.compiled import records
from adaptive_contact.core.detect import layout
from adaptive_contact.core.detect.contact import (
    assess_fit_before_contact,
    begin_labels,
    context_of,
    statistic,
    strikes,
)
from adaptive_contact.core.detect.layout import new_legs, scalars_of
from adaptive_contact.core.detect.swing import AFTER_TICKS
from adaptive_contact.core.detect.swing_judge import LANDINGS, Landings
from adaptive_contact.model import Baseline
from adaptive_contact.model.noise import AFTER, DESCENT
from adaptive_contact.robot import Robot

from .conftest import FakeLeg, play, samples

# -- Feet that come late: judged on after the turn to stance, learned from never, counted, noted

TICKS = 28  # of a swing and its stance, as FakeLeg makes them
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
    assert status.note.startswith(
        "20 of the last 20 contacts came after phase had turned to stance"
    )


def test_a_turn_in_mid_air_causes_nothing(robot: Robot, baseline: Baseline) -> None:
    """The same free motion with its turn early, late or not at all: no event of any kind."""
    measured, desired, swing, _ = FakeLeg(seed=32).run(60)
    for turn in (14, TURN, 22):
        phase = swing & (np.arange(len(swing)) % TICKS < turn)
        assert play(ContactLearner(robot, "rf", baseline), samples(measured, desired, phase)) == []


@pytest.mark.parametrize("upward", [False, True])
def test_a_touch_takes_predicted_motion_away_or_pushes_the_foot_up(
    robot: Robot, baseline: Baseline, upward: bool
) -> None:
    """The verdict against the formula, for residuals of any direction; a window that reaches back
    into the swing has the thresholds of swings."""
    rng = np.random.default_rng(34)
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, FakeLeg(seed=34).stream(4))
    leg, recent = learner.place.record, learner.lifecycle.noise_tracker
    told = {True: 0, False: 0}
    leg["descent"] = True
    leg["context"], leg["usable"] = context_of(leg, np.zeros(3), np.full(3, 0.02)), 3
    place = learner.place
    given = {**vars(place.batch), **place.batch.table._asdict()}
    noise = layout.Noise(
        *(
            given[name] if name in layout.SHARED else given[name][place.row]
            for name in layout.Noise._fields
        )
    )
    noise.shrink[:], scores = 1.0, noise.scores
    for trial in range(200):
        after = leg["after"] = trial % 5  # ticks since the turn to stance
        residual, motion = rng.normal(0.0, 0.02, (2, 3, 3))
        gradient = rng.normal(0.0, 0.1, 3)
        square = statistic(leg, noise, np.stack([residual, motion]), gradient, upward)
        for w in (1, 2, 3):
            whiten = recent.whiten[int(leg["context"])][w - 1]
            z, u = whiten @ residual[:w].sum(axis=0), whiten @ motion[:w].sum(axis=0)
            along = float(z @ u) / float(np.sqrt(u @ u))
            limit = recent.thresholds[AFTER if w < after else DESCENT, w - 1]
            up = float(z @ whiten @ gradient) / float(np.linalg.norm(whiten @ gradient))
            expected = max(-along, up if upward else 0.0, 0.0) ** 2 / limit
            assert scores[w - 1] == pytest.approx(expected, rel=1e-9)
            told[along < 0.0] += 1
            if w == 1:
                assert square == pytest.approx(float(z @ z))
                assert leg["opposed"] == pytest.approx(-along)
    assert min(told.values()) > 100


def test_touches_that_come_late_are_noted_while_they_are_more_than_half() -> None:
    landings, told = Landings(), []
    early, late = [-2] * LANDINGS, [3 + k % 3 for k in range(LANDINGS // 2 + 1)]
    for ticks in (*early, *late, *early[: LANDINGS // 2]):
        landings.touched(ticks)
        told.append(str(landings.note))
    at = len(early) + len(late) - 1
    assert told[at].startswith("11 of the last 20 contacts came after phase")
    assert "by 4 ticks" in told[at]
    # The nine from before the turn go first.
    assert [k for k, note in enumerate(told) if note != "None"] == list(range(at, at + 10))


def test_a_swing_without_ground_is_told_in_the_status(robot: Robot, baseline: Baseline) -> None:
    """A long stance in the air, under a command that goes on slowly down."""
    stream = FakeLeg(seed=35, noise=0.0).stream(3)
    last = stream[-1]
    # What the model of free motion predicts, so that nothing pushes.
    learner = ContactLearner(robot, "rf", baseline)
    play(learner, stream)
    assert learner.status.untouched == 0
    told = []
    for i in range(1, 40):
        batch, leg = learner.place.batch, learner.place.record
        free = learner.place.window[0] + (batch.increment[0] if leg["predicted"] else 0.0)
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


# -- A foot that strikes a step soon after it began to lift is reported, though it counts as held

PERIOD_NS = 20_000_000


@pytest.mark.parametrize(
    ("fitted", "misfits", "moved_m", "fits"),
    [
        (3, 0, 0.016, True),
        (3, 0, 0.014, False),  # not far enough for so few ticks
        (3, 2, 0.016, False),
        (5, 0, 0.004, True),
        (5, 2, 0.004, True),
        (5, 3, 0.004, False),  # a servo without strength, a foot on a leash: long off by now
        (4, 0, 0.004, False),
        (9, 0, 0.002, False),  # readings that are frozen
        (0, 0, 0.050, False),
    ],
)
def test_what_moved_as_predicted_and_then_met_something(
    fitted: int, misfits: int, moved_m: float, fits: bool
) -> None:
    """The contact begins a tick after the last that fits, or ``misfits`` later."""
    legs = new_legs(1)
    leg = scalars_of(legs, 0)
    leg.leg_size, leg.period_ns, leg.moved = 1.0, PERIOD_NS, moved_m
    leg.onset_ns = 100 * PERIOD_NS
    if misfits:
        leg.fit_n, leg.fit_before = 0, fitted
        leg.misfit_ns = leg.onset_ns - (misfits + 1) * PERIOD_NS
    else:
        leg.fit_n = fitted
    assess_fit_before_contact(records(legs)[0])
    assert bool(leg.fits) is fits


def test_a_leg_that_loses_its_way_in_the_same_tick_of_each_lift_strikes_nothing() -> None:
    """As one whose joint is read through a filter, until that is learned."""
    legs = new_legs(1)
    leg, record = scalars_of(legs, 0), records(legs)[0]
    leg.period_ns, leg.leg_size = PERIOD_NS, 1.0
    way = np.array([0.0, 0.03, 0.02])
    history = np.zeros((2, 3, 3))
    history[:, 0] = -0.5 * way, way  # half of it is lost

    def reported(tick: int) -> bool:
        begin_labels(record)
        leg.ticks, leg.fit_n, leg.at_ns = tick, 5, leg.at_ns + 70 * PERIOD_NS
        leg.misfit_ns = leg.at_ns - 20 * PERIOD_NS
        return strikes(record, history, 1.5)

    assert [reported(tick) for tick in (6, 6, 5, 6)] == [True, False, False, False]
    assert [reported(tick) for tick in (11, 11, 6)] == [True, False, True]


# -- A push too weak for any window is a contact where it lasts, of a leg whose touches are known

SEEDS = 20
TOUCHED = 12  # swings before


def found(robot: Robot, baseline: Baseline, *, touches: bool, held_back: float) -> int:
    """Count the legs that report the last swing's descent, which loses a share of its pull."""
    legs = 0
    for seed in range(SEEDS):
        measured, desired, swing, _ = FakeLeg(seed=seed).run(
            TOUCHED + 2,
            touch=lambda n: 16 if touches and n < TOUCHED else None,
            falling=lambda n: 1.0 - held_back * (n == TOUCHED + 1),
        )
        events = play(ContactLearner(robot, "rf", baseline), samples(measured, desired, swing))
        legs += any(e.contact and e.seq >= 28 * (TOUCHED + 1) for e in events)
    return legs


@pytest.mark.parametrize(
    ("touches", "held_back", "least", "most"),
    [
        (True, 0.0, 0, 0),
        (True, 0.05, 12, SEEDS),
        (False, 0.05, 0, 4),  # such a leg may hang, in a motion that it does not know
        (False, 0.12, 16, SEEDS),
    ],
)
def test_a_weak_push_that_lasts(
    robot: Robot, baseline: Baseline, touches: bool, held_back: float, least: int, most: int
) -> None:
    assert least <= found(robot, baseline, touches=touches, held_back=held_back) <= most
