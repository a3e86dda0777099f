"""A model left to itself: where it takes the leg, and when it runs away."""

from __future__ import annotations

import warnings

import numpy as np

from adaptive_contact.model import Baseline, LegModel, leg_library
from adaptive_contact.model.leg_model import rollout
from adaptive_contact.robot import Robot, foot
from adaptive_contact.wire import MAX_ANGLE_RAD

from .conftest import FakeLeg
from .drivers import Swings


def test_a_good_model_takes_the_leg_where_it_goes(robot: Robot, baseline: Baseline) -> None:
    measured, desired, _, _ = FakeLeg(seed=4, noise=0.0).run(3)
    model = baseline.legs["rf"].model
    window, at = model.library.window, 28
    past = measured[at - window.past_measured : at + 1][::-1]
    commands = desired[at - window.past_desired : at + 1][::-1]
    flat = np.concatenate((past.ravel(), commands.ravel()))
    places = rollout(model, flat, desired[at + 1 : at + 11].tolist())
    assert len(places) == 10
    assert np.abs(np.array(places) - measured[at + 1 : at + 11]).max() < 0.03


def test_a_model_that_runs_away_is_not_followed(robot: Robot) -> None:
    """A square of itself, tick after tick: a few of them are beyond any number."""
    library = leg_library(robot, robot.leg("rf"), "paper")
    square = next(i for i, term in enumerate(library.names) if term == "θ_coxa θ_coxa")
    coefficients = np.zeros((library.size, 3))
    coefficients[square] = 5.0
    window = library.window
    size = 3 * (window.past_measured + 1 + window.past_desired + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        places = rollout(LegModel(library, coefficients), np.full(size, 0.5), [[0.0] * 3] * 40)
    assert 0 < len(places) < 40
    assert np.abs(places).max() <= MAX_ANGLE_RAD


def test_a_way_that_is_not_foretold_to_its_end_counts_for_nothing(robot: Robot) -> None:
    watch = Swings(robot)
    leg, batch = watch.place.record, watch.place.batch
    batch.asked[0] = 0.06
    leg["asked_n"], leg["path_n"], leg["path_last"], leg["moved"] = 8, 8, 7, 0.03
    at = robot.leg("rf")
    assert at.lengths_m is not None
    batch.start[0] = foot([0.0, 0.3, -0.9], at.lengths_m, at.joint_axes)
    near = np.array([0.0, 0.45, -0.9])
    assert watch.judge.judge_travel(lambda path: [near] * len(path)) is False
    assert watch.judge.judge_travel(lambda path: [near] * (len(path) - 1)) is True
