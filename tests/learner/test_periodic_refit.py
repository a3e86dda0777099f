"""Refits: the slope that free rows ask for, and what it takes for it to be put in force."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from adaptive_contact import ContactLearner
from adaptive_contact.core.learn.periodic_refit import (
    REFIT_DUE_TICKS,
    PeriodicRefit,
    first_refit_after,
)
from adaptive_contact.core.learn.replay_buffer import ReplayBuffer
from adaptive_contact.fit import FitStatus
from adaptive_contact.fit.refit_job import LEAST_GAIN, RefitJob, RefitResult, refit
from adaptive_contact.model import LegBaseline, Library, leg_library, stack, with_changes
from adaptive_contact.model.leg_prior import leg_prior
from adaptive_contact.robot import Robot

from .conftest import FakeLeg, outcomes, play
from .ticks import Tick, rows_of

SLOPE = 0.164  # of the fake leg
QUANTUM = 0.005


def library_of(robot: Robot, factor: float = 1.0) -> Library:
    return dataclasses.replace(leg_library(robot, robot.leg("rf")), slope_rad=SLOPE * factor)


def free_rows(
    library: Library, swings: int = 60, seed: int = 1, noise: float = 0.003
) -> np.ndarray:
    """(n, p + J) of a leg that touches nothing, in swings."""
    measured, desired, swing, _ = FakeLeg(seed=seed, noise=noise).run(swings)
    cut = stack(measured, desired, library.window)
    theta = library.evaluate(cut.measured, cut.desired, cut.preview)
    return np.concatenate([theta, cut.increment], axis=1)[swing[cut.tick] & swing[cut.tick + 1]]


@pytest.mark.parametrize("described", [0.25, 0.4, 1.0, 2.5, 4.0])
def test_the_slope_that_the_rows_ask_for_is_found(robot: Robot, described: float) -> None:
    library = library_of(robot, described)
    found = refit(RefitJob("rf", 1, free_rows(library), library, QUANTUM))
    assert found.status is FitStatus.OK
    if found.start is None:
        assert described == 1.0
        assert found.gain < LEAST_GAIN
        return
    assert 0.6 < found.start.model.library.slope_rad / SLOPE < 1.7
    rows = free_rows(found.start.model.library, seed=2)
    off = rows[:, -3:] - rows[:, :-3] @ found.start.model.coefficients
    assert np.sqrt(np.square(off).mean()) < 1.2 * np.hypot(2**0.5 * 0.003, 2**0.5 * 0.005 / 12**0.5)


def test_the_gain_is_that_of_the_rows_probability_under_the_family(robot: Robot) -> None:
    """By the covariance of all rows at once, which takes n³."""
    library = library_of(robot, 4.0)
    values = free_rows(library, 30)[:120]
    found = refit(RefitJob("rf", 1, values, library, QUANTUM))
    window, target = library.window_of(values[:, :-3]), values[:, -3:]

    def of(slope: float, sigma: np.ndarray) -> float:
        known = leg_prior(dataclasses.replace(library, slope_rad=slope), QUANTUM)
        theta = known.model.library.evaluate_flat(window)
        total = 0.0
        for j in range(3):
            prior = theta @ known.spread[j].T
            covariance = prior @ prior.T + sigma[j] ** 2 * np.eye(len(theta))
            off = target[:, j] - theta @ known.model.coefficients[:, j]
            total += multivariate_normal.logpdf(off, np.zeros(len(off)), covariance)
        return total

    def rms(slope: float) -> np.ndarray:
        known = leg_prior(dataclasses.replace(library, slope_rad=slope), QUANTUM)
        theta = known.model.library.evaluate_flat(window)
        off = target - theta @ known.model.coefficients
        for j in range(3):
            prior, noise = theta @ known.spread[j].T, known.noise.rms[j]
            stacked = np.concatenate([prior / noise, np.eye(prior.shape[1])])
            aim = np.concatenate([off[:, j] / noise, np.zeros(prior.shape[1])])
            off[:, j] -= prior @ np.linalg.lstsq(stacked, aim, rcond=None)[0]
        return np.sqrt(np.square(off).mean(axis=0))

    grid = [library.slope_rad * f for f in (0.25, 0.4, 0.63, 1.0)]  # else beyond the family
    sigma = np.maximum(np.min([rms(slope) for slope in grid], axis=0), QUANTUM / 12**0.5)
    best = found.start.model.library.slope_rad
    assert found.gain == pytest.approx(of(best, sigma) - of(library.slope_rad, sigma), rel=1e-6)
    assert best == max(grid, key=lambda slope: of(slope, sigma))


@pytest.mark.parametrize("noise", [0.003, 0.02])
def test_a_leg_goes_on_with_its_own_noise_where_the_prior_s_is_too_small(
    robot: Robot, noise: float
) -> None:
    library = library_of(robot)
    prior_rms = leg_prior(library, QUANTUM).noise.rms
    values = free_rows(library, noise=noise)
    theta, target = values[:, :-3], values[:, -3:]
    off = target - theta @ np.linalg.lstsq(theta, target, rcond=None)[0]
    own = np.sqrt(np.square(off).mean(axis=0))
    found = refit(RefitJob("rf", 1, values, library, QUANTUM, prior_rms))
    assert found.gain < LEAST_GAIN
    assert found.level == pytest.approx(np.square(own / prior_rms).mean(), rel=0.25)
    assert refit(RefitJob("rf", 1, values, library, QUANTUM)).start is None  # has a baseline
    if noise == 0.003:
        assert found.start is None
        return
    assert found.start is not None
    assert found.start.model.library == library
    assert found.start.noise.rms == pytest.approx(own, rel=0.15)


def test_rows_that_are_not_finite_give_no_model(robot: Robot) -> None:
    library = library_of(robot)
    values = free_rows(library)
    values[3, 4] = np.nan
    assert refit(RefitJob("rf", 1, values, library, QUANTUM)).status is FitStatus.NOT_FINITE


# -- requested, and promoted or dropped ---------------------------------------------------------


@pytest.fixture
def start(robot: Robot) -> LegBaseline:
    """Of another slope."""
    return leg_prior(library_of(robot, 0.4), QUANTUM)


def buffered(library: Library, segments: int = 60) -> ReplayBuffer:
    """Lifts of a dozen free ticks, in three regions by turns; 60 are enough for a refit."""
    rng, buffer = np.random.default_rng(0), ReplayBuffer()
    for k in range(segments):
        # Behind the terms of a leg, those of changes.
        theta = np.pad(library.evaluate_flat(rng.uniform(-1.0, 1.0, (12, 24))), ((0, 0), (0, 12)))
        buffer.add(rows_of([Tick(row, rng.normal(size=3)) for row in theta]), k % 3, 0)
    return buffer


def swings(own: PeriodicRefit, buffer: ReplayBuffer, count: int = 0) -> None:
    """So many that have ended; as many as come before the first refit by default."""
    for _ in range(count or first_refit_after("rf")[0]):
        own.end_swing(buffer, 0, learned=True)


def answer(own: PeriodicRefit) -> LegBaseline | None:
    """The ticks until a result is due; what is promoted then."""
    assert not any(own.tick() for _ in range(REFIT_DUE_TICKS))
    return own.tick()


def of_leg(robot: Robot, result: RefitResult) -> tuple[PeriodicRefit, list[RefitJob]]:
    """Refits of a leg whose jobs are all answered so, and the jobs."""
    jobs: list[RefitJob] = []
    given = SimpleNamespace(submit=jobs.append, collect=lambda *_: result)
    plain = library_of(robot)
    library = with_changes(plain, np.zeros((plain.size, 3)))
    assert library.size == plain.size + 12
    return PeriodicRefit("rf", library, QUANTUM, given), jobs


def asked(robot: Robot, result: RefitResult) -> tuple[PeriodicRefit, list[RefitJob]]:
    """One that waits for its first result."""
    own, jobs = of_leg(robot, result)
    swings(own, buffered(library_of(robot)))
    assert len(jobs) == 1
    return own, jobs


@pytest.mark.parametrize(
    ("result", "why"),
    [
        (
            RefitResult(1, FitStatus.OK, 0.0656, 100.0),
            "promoted: a slope of 0.0656 rad fits better by 100 nats",
        ),
        (
            RefitResult(1, FitStatus.OK, 0.0656, 39.0, 16.0),
            "promoted: errors are 4.0 times those that were expected",
        ),
        (RefitResult(1, FitStatus.OK, SLOPE), "refused: no slope fits better than 0.164 rad"),
        (
            RefitResult(1, FitStatus.OK, 0.0656, 39.0),
            "refused: a slope of 0.0656 rad fits hardly better (39 nats)",
        ),
        (RefitResult(1, FitStatus.NOT_FINITE), "refused: the fit ended with 'not_finite'"),
    ],
)
def test_what_is_much_likelier_is_promoted_and_all_else_refused(
    robot: Robot, start: LegBaseline, result: RefitResult, why: str
) -> None:
    promoted = why.startswith("promoted")
    own, jobs = asked(robot, dataclasses.replace(result, start=start if promoted else None))
    assert len(jobs[0].values) == 720
    assert answer(own) is (start if promoted else None)
    assert (own.counts.promoted, own.counts.refused) == (promoted, not promoted)
    assert own.counts.last_reason == why


def test_a_leg_that_changes_drops_its_refit_and_asks_at_once(
    robot: Robot, start: LegBaseline
) -> None:
    own, jobs = asked(robot, RefitResult(1, FitStatus.OK, 0.0656, 100.0, start=start))
    own.leg_changed()
    assert answer(own) is None
    swings(own, buffered(library_of(robot), 10), 1)
    assert len(jobs) == 1
    needed = 4 * (library_of(robot).size + 12)
    assert own.counts.last_reason == (
        f"waiting: 120 free ticks of the leg as it is to fit to, {needed} are needed"
    )
    swings(own, buffered(library_of(robot)), 1)
    assert len(jobs) == 2
    assert answer(own) is start
    again, _ = of_leg(robot, RefitResult(1))
    again.restore({**own.snapshot(), "displaced": None})
    assert again.counts == own.counts


# -- a leg whose slope is described wrongly ------------------------------------------------------


@pytest.fixture(scope="module")
def misdescribed(robot: Robot) -> Robot:
    return msgspec.structs.replace(
        robot, servo=msgspec.structs.replace(robot.servo, slope_rad=4.0 * SLOPE)
    )


@pytest.mark.parametrize(("noise", "learned", "hits"), [(None, 150, 23), (0.02, 80, 20)])
def test_what_is_described_wrong_is_found_reported_and_outlives_a_restart(
    misdescribed: Robot, robot: Robot, noise: float | None, learned: int, hits: int
) -> None:
    """A slope off by four, and a leg noisier than any that is known."""
    described = misdescribed if noise is None else robot
    leg = FakeLeg(seed=3) if noise is None else FakeLeg(seed=3, noise=noise)
    stops: list[int | None] = [16 if n % 2 else None for n in range(200)]
    stream = leg.stream(200, touch=lambda n: stops[n])
    learner = ContactLearner(described, "rf")
    play(learner, stream[: 28 * learned])
    report, refits = learner.model_report, learner.status.refits
    if noise is None:
        assert refits.promoted >= 1
        assert 0.6 < report.slope_rad / SLOPE < 1.7
        assert report.origin == f"a refit, with slope_rad = {report.slope_rad:.3g}"
    else:
        assert "errors are" in str(refits.last_reason)
    again = ContactLearner(described, "rf")
    assert again.restore(learner.snapshot()) is None
    assert again.status.noise_floor == pytest.approx(learner.status.noise_floor, rel=1e-12)
    assert again.status.refits == refits
    assert again.model_report == msgspec.structs.replace(
        report, threshold=again.model_report and again.model_report.threshold
    )
    for of in (learner, again):
        told = outcomes(
            play(of, stream[28 * learned : 28 * (learned + 50)]),
            range(learned + 2, learned + 50),
            stops,
        )
        assert told.count("hit") >= hits
        assert told.count("alarm") <= 1
        assert of.status.status == "valid"


@pytest.fixture(scope="module")
def saved(misdescribed: Robot) -> dict[str, Any]:
    """Of a leg that goes on from a slope that was found."""
    learner = ContactLearner(misdescribed, "rf")
    play(learner, FakeLeg(seed=3).stream(150))
    return learner.snapshot()


@pytest.mark.parametrize(
    ("found", "line"),
    [
        *(({"noise_rad": noise}, "its noise is") for noise in ([], [0.01], "none")),
        *(({"noise_rad": [0.01, x, 0.01]}, "its noise is") for x in (-1.0, float("inf"))),
        *(({"slope_rad": x}, "its slope is") for x in (None, "0.1", float("nan"), 1e-6, 40.0)),
    ],
)
def test_a_saved_slope_or_noise_that_no_servo_has_is_refused(
    misdescribed: Robot, saved: dict[str, Any], found: dict[str, object], line: str
) -> None:
    again = ContactLearner(misdescribed, "rf")
    assert line in (again.restore({**saved, "found": {**saved["found"], **found}}) or "")
    assert again.status.model_version == 0
    known = {name: of for name, of in saved["found"].items() if name != "noise_rad"}
    assert again.restore({**saved, "found": known}) is None  # of a version that did not save it
