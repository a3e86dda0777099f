"""The model in force: followed, replaced when it goes wrong, followed without geometry too."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from adaptive_contact import ContactLearner
from adaptive_contact.core.learn.adapter import (
    Adapter,
)
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.core.learn.noise_tracker import NoiseTracker
from adaptive_contact.fit.refit_job import InlineRefitter
from adaptive_contact.model import Baseline
from adaptive_contact.model.labelled_swing import Label, LabelledSwing, Rows
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.wire import DriftLevel

from .conftest import TOML, FakeLeg, outcomes, play, samples
from .ticks import Tick, rows_of

Array = NDArray[np.float64]


@pytest.fixture
def adapter(baseline: Baseline) -> Adapter:
    known = baseline.legs["rf"]
    recent = NoiseTracker(known.noise, baseline.tails, 1.0)
    return Adapter("rf", known, recent, LearnerMode.FULL, InlineRefitter(), 0.005)


@pytest.fixture
def scale(baseline: Baseline) -> Array:
    return baseline.legs["rf"].scale


def lift_of(theta: Array, target: Array, *, level: float = 1.0, t_ns: int = 0) -> Rows:
    """Free ticks of a lift, one after the other."""
    return rows_of(
        [
            Tick(t, moved, level, t_ns=t_ns + k)
            for k, (t, moved) in enumerate(zip(theta, target, strict=True))
        ]
    )


def swing(adapter: Adapter, rows: Rows, number: int) -> None:
    """One that has a lift alone, and the stance that follows."""
    adapter.monitor.begin_swing()
    adapter.keep(number)
    adapter.learn(LabelledSwing(Label.LIFT, rows, 0, number))
    for _ in range(28):
        adapter.tick(3)
    adapter.learn(LabelledSwing(Label.END))


def lifts(adapter: Adapter, scale: Array, swings: int) -> None:
    """Swings of a leg that does what the model says."""
    rng = np.random.default_rng(swings)
    model = adapter.model
    for number in range(swings):
        theta = rng.normal(size=(8, model.library.size)) * scale
        target = theta @ model.coefficients + 1e-3 * rng.normal(size=(8, 3))
        swing(adapter, lift_of(theta, target), number)


def go_wild(adapter: Adapter, wild: float) -> None:
    """Have the recursion at a coefficient that no servo has, and learn from there."""
    coefficients = adapter.model.coefficients.copy()
    coefficients[np.abs(coefficients[:, 0]).argmax(), 0] = wild
    adapter.active.recursion.reseed(coefficients)
    theta = np.zeros((1, len(coefficients)))
    adapter.learn(LabelledSwing(Label.DESCENT, lift_of(theta, np.zeros((1, 3)))))
    adapter.tick(1)


@pytest.mark.parametrize("wild", [np.nan, np.inf, 1e3])
def test_a_model_that_went_wild_gives_way_to_the_baseline(
    adapter: Adapter, scale: Array, wild: float
) -> None:
    before = adapter.model.coefficients
    lifts(adapter, scale, 10)
    go_wild(adapter, wild)
    np.testing.assert_array_equal(adapter.model.coefficients, before)
    assert adapter.refits.rolled_back == 1
    assert adapter.refits.last_reason == (
        "rolled back: a coefficient was not finite, or implausible: the baseline again"
    )
    lifts(adapter, scale, 5)  # and it goes on from there
    assert adapter.refits.rolled_back == 1
    assert np.isfinite(adapter.model.coefficients).all()


def without_lengths() -> Robot:
    text = "\n".join(line for line in TOML.splitlines() if not line.startswith("lengths_m"))
    return parse_robot(text, source="testbot")


def test_a_leg_of_unknown_lengths_is_followed_by_its_phase(baseline: Baseline) -> None:
    """A drive that has lost three tenths of its strength; half of the swings end in contact."""
    robot = without_lengths()
    stops = [18 if n % 2 else None for n in range(240)]
    stream = FakeLeg(seed=5).stream(
        240, touch=lambda n: stops[n], change=lambda n: 0.7 if n >= 100 else 1.0
    )
    learner = ContactLearner(robot, "rf", baseline)
    assert learner.leg.lengths_m is None
    events = play(learner, stream)
    before = outcomes(events, range(40, 100), stops)
    after = outcomes(events, range(140, 240), stops)
    assert before.count("alarm") <= 1
    assert before.count("hit") >= 28
    assert after.count("alarm") <= 3
    assert after.count("hit") >= 47
    frozen = play(ContactLearner(robot, "rf", baseline, mode=LearnerMode.FROZEN), stream)
    assert outcomes(frozen, range(140, 240), stops).count("alarm") > 20, "it was worth following"


def test_a_baseline_that_holds_again_is_taken_up_and_the_status_says_why(
    adapter: Adapter, baseline: Baseline
) -> None:
    """Mud that is washed off: more than the recursion follows at once."""
    known = baseline.legs["rf"]
    rng = np.random.default_rng(1)
    clean = known.model.coefficients
    # Each of the terms that count has come to count for less.
    for number, coefficients in enumerate([0.6 * clean] * 40 + [clean] * 6):
        if number == 40:
            assert np.abs(adapter.model.coefficients - clean).max() > 0.03 * np.abs(clean).max()
            assert adapter.monitor.drift.since_ns is not None
        theta = rng.normal(size=(8, len(clean))) * known.scale[:, None].T
        target = theta @ coefficients
        off = (target - theta @ adapter.model.coefficients) / known.noise.rms
        level = 1.0 + float(np.square(off).mean())
        target += known.noise.rms * rng.normal(size=(8, 3))
        swing(adapter, lift_of(theta, target, level=level), number)
    assert adapter.refits.rolled_back >= 1
    assert "rolled back: the baseline fits 3 lifts better" in (adapter.refits.last_reason or "")
    assert adapter.monitor.drift == DriftLevel(level=adapter.monitor.variance_scale), (
        "no change any more"
    )


def test_where_swings_are_too_short_for_that_it_is_said(baseline: Baseline) -> None:
    learner = ContactLearner(without_lengths(), "rf", baseline)
    measured, desired, swing, _ = FakeLeg(seed=6).run(20)
    short = swing.copy()
    short[np.arange(len(short)) % 28 >= 14] = False
    play(learner, samples(measured, desired, short))
    assert learner.status.note == (
        "robot.toml has no lengths_m, and swings are shorter than 0.4 s: changes of the leg are "
        "not followed; give the lengths of its links"
    )


def test_a_joint_that_reads_more_coarsely_raises_no_alarms(
    robot: Robot, baseline: Baseline
) -> None:
    """The covariance follows, so that the other joints stay as sharp as they were."""
    stops = [16 if n % 2 else None for n in range(400)]
    measured, desired, swing, _ = FakeLeg(seed=7).run(400, touch=lambda n: stops[n])
    rng = np.random.default_rng(0)
    measured[28 * 60 :, 1] += 0.012 * rng.normal(size=len(measured) - 28 * 60)
    learner = ContactLearner(robot, "rf", baseline)
    told = outcomes(play(learner, samples(measured, desired, swing)), range(120, 400), stops)
    assert told.count("alarm") <= 1
    assert told.count("hit") >= 0.97 * 140
    recent = learner.lifecycle.noise_tracker
    now, then = recent.whiten[4, 0], baseline.legs["rf"].noise.whiten[4, 0]
    coxa, femur = (np.diag(now) / np.diag(then))[:2]
    assert femur < 0.8 * coxa, "the femur has grown noisier, the coxa has not"
