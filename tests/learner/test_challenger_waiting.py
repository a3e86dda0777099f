"""A better candidate that waits for contacts to be tried on."""

from __future__ import annotations

import numpy as np

from adaptive_contact.learn.candidate import (
    LOOK_AGAIN_ROWS,
    PROBATION_ROWS,
    REFIT_DUE_TICKS,
    TRIAL_CONTACTS,
    TRIAL_ROWS,
    Candidate,
)
from adaptive_contact.learn.replay_buffer import ReplayBuffer
from adaptive_contact.model import LegModel

from .trials import (
    NOISE,
    Given,
    answer,
    ask,
    compared,
    fill,
    looked_at,
    row,
    stopped,
    swing_done,
    tried,
)


def test_a_better_candidate_waits_for_contacts_to_be_tried_on(model: LegModel) -> None:
    blind = model.coefficients * 1.2
    blind[1] = -2.0 * blind[0]
    trial, after = tried(model, blind, contacts=TRIAL_CONTACTS - 1)
    assert after is model
    assert trial.trying, "on free ticks alone it has won"
    counts = trial.counts
    assert (counts.promoted, counts.refused) == (0, 0)
    assert counts.last_reason is not None
    assert counts.last_reason.startswith("waiting: a candidate is +")
    assert "there are 2 contacts to try it on, 3 are needed" in counts.last_reason
    trial.contacts.add(stopped(model))
    assert looked_at(trial, model) is None
    assert "misses 3 of 3 stored contacts" in (trial.counts.last_reason or "")
    assert "waiting" not in (trial.counts.last_reason or "")


def test_a_candidate_that_waits_is_looked_at_now_and_then_only(model: LegModel) -> None:
    trial, _ = tried(model, model.coefficients * 1.2, contacts=0)
    rng, deciding = np.random.default_rng(3), 0
    for _ in range(10 * LOOK_AGAIN_ROWS):
        deciding += trial.deciding
        compared(trial, row(rng, model.library.size, truth=0.06), model)
    assert trial.trying
    assert deciding == 10


def test_a_newer_refit_takes_the_place_of_a_candidate_that_waits(model: LegModel) -> None:
    """A leg that touches nothing is refitted as often as any; the newest refit waits."""
    given = Given(model.coefficients * 1.2)
    trial = Candidate("rf", NOISE, np.ones(model.library.size), given)
    buffer, rng, p = ReplayBuffer(), np.random.default_rng(0), model.library.size
    fill(buffer, rng, p, truth=0.06)
    for turn in range(3):
        ask(trial, model, buffer)
        assert given.asked == turn + 1
        answer(trial)
        swing_done(trial, model, buffer)
        assert given.asked == turn + 1, "one that is being tried is not replaced"
        for _ in range(2 * TRIAL_ROWS):
            assert compared(trial, row(rng, p, truth=0.06), model) is None
        assert "waiting: a candidate" in (trial.counts.last_reason or "")
    newest = given.coefficients = model.coefficients * 1.21
    ask(trial, model, buffer)
    assert "waiting: a candidate" in (trial.counts.last_reason or "")
    answer(trial)
    for _ in range(TRIAL_CONTACTS):
        trial.contacts.add(stopped(model))
    for _ in range(TRIAL_ROWS):
        won = compared(trial, row(rng, p, truth=0.06), model)
    assert won is not None
    np.testing.assert_array_equal(won.coefficients, newest)


def test_a_refit_under_way_does_not_disturb_the_probation_of_another(model: LegModel) -> None:
    given = Given(model.coefficients * 1.2)
    trial = Candidate("rf", NOISE, np.ones(model.library.size), given)
    buffer, rng, p = ReplayBuffer(), np.random.default_rng(0), model.library.size
    fill(buffer, rng, p, truth=0.06)
    ask(trial, model, buffer)
    answer(trial)
    for _ in range(TRIAL_ROWS):
        compared(trial, row(rng, p, truth=0.06), model)
    ask(trial, model, buffer)
    assert given.asked == 2
    for _ in range(TRIAL_CONTACTS):
        trial.contacts.add(stopped(model))
    won = looked_at(trial, model)
    assert won is not None
    for _ in range(2 * REFIT_DUE_TICKS):
        trial.tick()
    for _ in range(PROBATION_ROWS):
        assert compared(trial, row(rng, p, truth=0.06), won) is None
    assert not trial.trying
    assert trial.counts.promoted == 1


def test_a_leg_whose_lifts_do_not_fit_does_not_wait_for_contacts_that_nobody_stores(
    model: LegModel,
) -> None:
    trial, _ = tried(model, model.coefficients * 1.2, contacts=0)
    assert looked_at(trial, model, valid=False) is not None
    assert trial.counts.promoted == 1


def test_a_candidate_that_waits_for_contacts_is_tried_on_the_newest_ticks(model: LegModel) -> None:
    trial, _ = tried(model, model.coefficients * 1.2, contacts=0)
    assert trial.trying
    rng = np.random.default_rng(2)
    for _ in range(TRIAL_ROWS):  # the leg is again what it was
        compared(trial, row(rng, model.library.size, truth=0.05), model)
    assert not trial.trying
    assert trial.counts.refused == 1
