"""A leg's first swings from what is known of any leg: what is judged, and what is learned."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.core.learn.lifecycle import Lifecycle
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.fit.refit_job import InlineRefitter
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact_sim import SimulationSettings, parse_drift, record_arrays, simulated_robot
from adaptive_contact_studies.evaluate import play as play_run
from adaptive_contact_studies.evaluate import score_run

from .conftest import PERIOD, FakeLeg

EACH, TURN = 28, 24  # ticks from swing to swing, and to the turn


def test_what_is_shown_is_what_was_judged(robot: Robot) -> None:
    """Thresholds of a leg from a prior are as wide as its coefficients are uncertain."""
    learner = ContactLearner(robot, "rf", None)
    compared = 0
    for k, sample in enumerate(FakeLeg(seed=5).stream(4)):
        learner.update(sample)
        judged, place = learner.judged(), learner.place
        if judged is None or place.record["after"] or not 12 < k % EACH < TURN:
            continue
        compiled = place.batch.scores[place.row]
        at = np.isfinite(compiled) & (compiled > 0.0)
        np.testing.assert_allclose(judged.scores[at], compiled[at], rtol=1e-9)
        compared += int(at[1:].sum())
    assert compared > 20
    assert (learner.place.batch.unit[learner.place.row] > 1.0).all()


@pytest.mark.parametrize("stop", [20, TURN + 1])
def test_what_is_learned_ends_well_before_a_touch(
    robot: Robot, baseline: Baseline, stop: int
) -> None:
    """A leg that is known from a prior alone learns as much of a swing as any other."""
    stream = FakeLeg(seed=5).stream(6, touch=lambda n: stop if n > 3 else None)
    for known in (None, baseline):
        found = gaps(ContactLearner(robot, "rf", known), stream)
        assert len(found) == 2  # both touches are found
        # After the turn, also what a push that added up may have made is left out.
        assert min(found) >= 3
        assert max(found) <= (5 if stop < TURN else 8)


@pytest.mark.slow
def test_joints_that_stick_at_the_top_of_a_swing_are_learned() -> None:
    settings = SimulationSettings.from_robot("hexapod", "walk")
    rough = dataclasses.replace(settings.terrain, kind="rough")
    drift = (parse_drift("friction:value=4,at_s=20"),)
    run = record_arrays(dataclasses.replace(settings, terrain=rough, drift=drift, seed=16), 60.0)
    robot = simulated_robot("hexapod").description
    outcomes = score_run(run, robot, play_run(run, robot, None).events)
    assert sum(len(outcome.alarms_ns) for outcome in outcomes) <= 4
    found = [outcome.touches.found[outcome.touches.counted].mean() for outcome in outcomes]
    assert np.mean(found) > 0.9


def gaps(learner: ContactLearner, stream: list[ServoSample]) -> list[int]:
    """Ticks from the last one learned to each touch."""
    found = []
    for sample in stream:
        event = learner.update(sample)
        # Stances of four ticks do not show that the leg carries.
        learner.place.leg.carried = sample.seq > 4 * EACH
        if event is not None and event.contact:
            learned = [t for t in learner.drain_confirmed() if t < event.t_ns]
            found.append((event.onset_ns - max(learned)) // PERIOD)
    return found


def started(robot: Robot, baseline: Baseline | None = None) -> Lifecycle:
    return Lifecycle(robot, robot.leg("rf"), baseline, LearnerMode.FULL, InlineRefitter())


def spread_of(life: Lifecycle) -> np.ndarray:
    """(J, p) deviations of the coefficients, as far as they may move."""
    adapter = life.adapter
    covariance = adapter.free_motion().covariance
    return np.sqrt(np.square(covariance.root).sum(axis=2))


def test_a_leg_that_no_prior_fits_gets_a_wider_one(robot: Robot) -> None:
    life = started(robot)
    variances = [np.square(spread_of(life))]
    for times in (3, 9, 9):  # and no wider
        life.forget()
        variances.append(np.square(spread_of(life)))
        assert f"the prior is {times} times wider (0 of 10 swings)" in life.note_now
    # Each is the prior's with its factor squared, and what any recursion begins with besides.
    one, three, nine, last = variances
    np.testing.assert_allclose(nine - one, (three - one) * 10.0, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(last, nine)


@pytest.mark.parametrize("widening", ["3", None, -1.0, float("nan"), 1e9, [3.0]])
def test_a_widening_that_is_none_leaves_a_leg_that_works(robot: Robot, widening: object) -> None:
    life = started(robot)
    saved = life.snapshot() | {"widening": widening}
    life.restore(saved)
    assert np.isfinite(spread_of(life)).all()
    assert (spread_of(life) <= 9.0 * spread_of(started(robot)) * (1 + 1e-9)).all()
