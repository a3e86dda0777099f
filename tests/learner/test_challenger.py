"""Candidates against the model in force: on new free ticks, and on stored contacts."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.fit import FitStatus
from adaptive_contact.fit.refit_job import RefitResult
from adaptive_contact.learn.candidate import (
    DOMAIN_ROWS,
    PRIOR_ROWS,
    PROBATION_ROWS,
    Candidate,
)
from adaptive_contact.learn.replay_buffer import ReplayBuffer
from adaptive_contact.model import Baseline, Domain, Factor, LegModel
from adaptive_contact.model.labelled_swing import Touch

from .trials import NOISE, Given, answer, ask, compared, fill, row, stopped, swing_done, tried


def test_a_candidate_that_fits_better_and_sees_as_well_is_promoted(model: LegModel) -> None:
    candidate = model.coefficients * 1.2
    trial, after = tried(model, candidate, contacts=20)
    assert after.version == 1
    np.testing.assert_array_equal(after.coefficients, candidate)
    assert trial.counts.promoted == 1
    assert "noise variances better" in (trial.counts.last_reason or "")


def test_a_candidate_that_explains_contacts_away_is_refused(model: LegModel) -> None:
    candidate = model.coefficients * 1.2
    candidate[1] = -2.0 * candidate[0]  # so that a leg on the ground is expected to stand
    trial, after = tried(model, candidate, contacts=20)
    assert after is model
    assert trial.counts.refused == 1
    assert "misses 20 of 20 stored contacts" in (trial.counts.last_reason or "")


@pytest.mark.parametrize("wild", [np.nan, np.inf, 1e6])
def test_a_candidate_that_no_servo_can_be_is_refused_untried(model: LegModel, wild: float) -> None:
    candidate = model.coefficients.copy()
    candidate[3, 1] = wild
    trial = Candidate("rf", NOISE, np.ones(model.library.size), Given(candidate), most_rad=1.0)
    buffer = ReplayBuffer()
    fill(buffer, np.random.default_rng(0), model.library.size)
    ask(trial, model, buffer)
    answer(trial)
    assert not trial.trying
    assert trial.counts.refused == 1
    assert trial.counts.last_reason == ("refused: a coefficient is not finite, or implausible")


def test_a_lost_refit_of_a_changed_leg_is_asked_for_once_more(model: LegModel) -> None:
    given = Given(model.coefficients)
    trial = Candidate("rf", NOISE, np.ones(model.library.size), given)
    buffer = ReplayBuffer()
    fill(buffer, np.random.default_rng(0), model.library.size)
    lost = RefitResult(1, FitStatus.LOST, np.zeros_like(model.coefficients), 0.0, float("nan"))
    given.collect = lambda leg, number: lost  # type: ignore[method-assign]
    trial.withdraw()
    for asked in (1, 2, 2):
        swing_done(trial, model, buffer)
        assert given.asked == asked
        answer(trial)
    assert trial.counts.refused == 2


def test_who_cannot_be_compared_is_not_promoted(model: LegModel) -> None:
    given = Given(np.zeros_like(model.coefficients))
    trial = Candidate("rf", NOISE, np.ones(model.library.size), given)
    rng = np.random.default_rng(0)
    buffer = ReplayBuffer()
    fill(buffer, rng, model.library.size)
    ask(trial, model, buffer)
    answer(trial)
    assert trial.trying
    while trial.trying:
        asked = trial.deciding
        new = row(rng, model.library.size, truth=0.06)
        assert trial.compare(new, [float("nan")] * 3, model) is None
    assert asked, "for the model as it is, in the row that decides"
    assert trial.counts.refused == 1


def test_an_alarm_that_came_too_early_does_not_refuse_the_model_that_knows_better(
    model: LegModel,
) -> None:
    """It is followed by the touch itself, which the better model reports."""
    candidate = model.coefficients * 0.5
    early = stopped(model)
    early = early._replace(target=early.theta @ candidate)
    trial = Candidate("rf", NOISE, np.ones(model.library.size), Given(candidate))
    trial.contacts.add(early)
    assert trial.contacts.found(model.coefficients).tolist() == [True]
    assert trial.contacts.found(candidate).tolist() == [False]
    trial.contacts.clear()
    both = map(np.concatenate, zip(early, stopped(model), strict=True))
    trial.contacts.add(Touch(*both))
    trial.contacts.add(early)
    assert trial.contacts.found(candidate).tolist() == [True, False]


@pytest.mark.parametrize("restarted", [False, True])
def test_a_promoted_model_that_does_worse_is_rolled_back(model: LegModel, restarted: bool) -> None:
    """Also where the service was killed right after the promotion, when all is saved."""
    trial, promoted = tried(model, model.coefficients * 1.2, contacts=20)
    assert promoted.version == 1
    if restarted:
        saved = trial.snapshot()
        trial = Candidate("rf", NOISE, np.ones(model.library.size), Given(model.coefficients))
        trial.restore(saved)
    rng = np.random.default_rng(1)
    back = None
    for _ in range(PROBATION_ROWS):  # the leg is again what it was
        back = compared(trial, row(rng, model.library.size, truth=0.05), promoted)
    assert back is not None
    np.testing.assert_array_equal(back.coefficients, model.coefficients)
    assert back.version == 2
    assert trial.counts.rolled_back == 1
    assert "rolled back: the model before is" in (trial.counts.last_reason or "")
    assert not trial.trying


def test_what_a_refit_holds_on_to_does_not_shift_its_threshold(
    baseline: Baseline, model: LegModel
) -> None:
    """λ is per root mean square of a column: many rows told in few must not make that greater."""
    scale = np.linspace(0.5, 2.0, model.library.size)
    scale[0] = 1.0  # the constant
    rng = np.random.default_rng(0)
    seen = Factor(model.library.size, 3)
    theta = rng.normal(size=(3000, len(scale))) * scale
    theta[:, 0] = 1.0
    seen.add(theta, np.zeros((3000, 3)))
    domain = Domain.of(seen, scale)
    for known, rows in ((None, PRIOR_ROWS), (domain, PRIOR_ROWS + DOMAIN_ROWS)):
        given = Given(model.coefficients)
        trial, buffer = Candidate("rf", NOISE, scale, given, known), ReplayBuffer()
        fill(buffer, rng, model.library.size)
        ask(trial, model, buffer)
        prior = given.jobs[0].prior
        assert prior is not None
        assert prior.rows == pytest.approx(rows)
        np.testing.assert_allclose(prior.scale()[1:], scale[1:], rtol=0.05)
        np.testing.assert_allclose(prior.rms(model.coefficients), 0.0, atol=1e-12)
