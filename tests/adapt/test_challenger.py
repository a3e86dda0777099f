"""Candidates against the model in force: on new free ticks, and on stored contacts."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.adapt import Baseline
from adaptive_contact.adapt.buffer import SlidingBuffer
from adaptive_contact.adapt.challenger import (
    DOMAIN_ROWS,
    LOOK_AGAIN_ROWS,
    PRIOR_ROWS,
    PROBATION_ROWS,
    REFIT_DUE_TICKS,
    REFIT_EVERY_S,
    REFIT_EVERY_SWINGS,
    TRIAL_CONTACTS,
    TRIAL_ROWS,
    Challenger,
)
from adaptive_contact.adapt.coldstart import ColdJob
from adaptive_contact.adapt.contacts import MOST, StoredContacts, Touch
from adaptive_contact.adapt.refit import InlineRefitter, RefitResult
from adaptive_contact.adapt.segments import Row
from adaptive_contact.identify import Domain, Factor, FitStatus, LegModel

NOISE = np.array([0.01, 0.01, 0.01])


class Given:
    """Answers every job with the same candidate."""

    def __init__(self, coefficients: np.ndarray) -> None:
        self.coefficients = coefficients
        self.asked = 0

    def submit(self, job: object) -> None:
        """Count it."""
        self.asked += 1

    def collect(self, leg: str, number: int) -> RefitResult:
        """The candidate."""
        return RefitResult(number, FitStatus.OK, self.coefficients, 0.1, 1.0)


@pytest.fixture
def model(baseline: Baseline) -> LegModel:
    """The first term alone, for every joint."""
    of = baseline.legs["rf"].model
    coefficients = np.zeros_like(of.coefficients)
    coefficients[0] = 0.05
    return of.moved(coefficients, 0)


def row(rng: np.random.Generator, p: int, *, truth: float) -> Row:
    """A free tick, in which only the first term is excited."""
    theta = np.zeros(p)
    theta[0] = rng.normal() + 2.0
    target = theta[0] * truth + rng.normal(size=3) * NOISE
    return Row(theta, target, 1.0, 1.0, 0, 0, lift=True, calm=True, cleared=True)


def fill(
    buffer: SlidingBuffer,
    rng: np.random.Generator,
    p: int,
    segments: int = 60,
    *,
    truth: float = 0.05,
) -> None:
    """Lifts of a dozen free ticks, in three regions by turns; 60 are enough for a refit."""
    for k in range(segments):
        buffer.add([row(rng, p, truth=truth) for _ in range(12)], k % 3, 0)


def stopped(model: LegModel) -> Touch:
    """A leg that should move by 0.1 rad and stands; the second term is excited there only."""
    theta = np.zeros((3, model.library.size))
    theta[:, 0], theta[:, 1] = 2.0, 1.0
    whiten = np.broadcast_to(np.eye(3) / NOISE, (3, 3, 3))
    return Touch.of(theta, np.zeros((3, 3)), whiten, np.full(3, 30.0), 1)


def tried(model: LegModel, candidate: np.ndarray, contacts: int) -> tuple[Challenger, LegModel]:
    """After a whole trial on ticks that the candidate fits."""
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), Given(candidate))
    buffer = SlidingBuffer()
    rng = np.random.default_rng(0)
    p = model.library.size
    fill(buffer, rng, p, truth=0.06)
    for _ in range(contacts):
        challenger.contacts.add([stopped(model)])
    for _ in range(REFIT_EVERY_SWINGS):
        challenger.swing_done(model, buffer, 0)
    for _ in range(REFIT_DUE_TICKS + 1):
        challenger.tick()
    assert challenger.trying
    promoted = None
    for _ in range(2 * TRIAL_ROWS):
        promoted = compared(challenger, row(rng, p, truth=0.06), model)
        if promoted is not None or not challenger.trying:
            break
    return challenger, promoted or model


def compared(
    challenger: Challenger, new: Row, model: LegModel, *, known: bool = True
) -> LegModel | None:
    """A row of the trial, as the follower lets it be tried."""
    off = (new.target - new.theta @ model.coefficients) / NOISE
    return challenger.compare(new, off.tolist(), model, known=known)


def looked_at(
    challenger: Challenger, model: LegModel, *, known: bool = True, truth: float = 0.06
) -> LegModel | None:
    """The rows within which a candidate that waits is looked at again; what came of it."""
    rng = np.random.default_rng(2)
    for _ in range(LOOK_AGAIN_ROWS):
        new = row(rng, model.library.size, truth=truth)
        won = compared(challenger, new, model, known=known)
        if won is not None or not challenger.trying:
            return won
    return None


def test_a_candidate_that_fits_better_and_sees_as_well_is_promoted(model: LegModel) -> None:
    candidate = model.coefficients * 1.2
    challenger, after = tried(model, candidate, contacts=20)
    assert after.version == 1
    np.testing.assert_array_equal(after.coefficients, candidate)
    assert challenger.counts.promoted == 1
    assert "noise variances better" in (challenger.counts.last_reason or "")


def test_a_candidate_that_explains_contacts_away_is_refused(model: LegModel) -> None:
    candidate = model.coefficients * 1.2
    candidate[1] = -2.0 * candidate[0]  # so that a leg on the ground is expected to stand
    challenger, after = tried(model, candidate, contacts=20)
    assert after is model
    assert challenger.counts.refused == 1
    assert "misses 20 of 20 stored contacts" in (challenger.counts.last_reason or "")


def test_a_better_candidate_waits_for_contacts_to_be_tried_on(model: LegModel) -> None:
    blind = model.coefficients * 1.2
    blind[1] = -2.0 * blind[0]
    challenger, after = tried(model, blind, contacts=TRIAL_CONTACTS - 1)
    assert after is model
    assert challenger.trying, "on free ticks alone it has won"
    counts = challenger.counts
    assert (counts.promoted, counts.refused) == (0, 0)
    assert counts.last_reason is not None
    assert counts.last_reason.startswith("waiting: a candidate is +")
    assert "there are 2 contacts to try it on, 3 are needed" in counts.last_reason
    challenger.contacts.add([stopped(model)])
    assert looked_at(challenger, model) is None
    assert "misses 3 of 3 stored contacts" in (challenger.counts.last_reason or "")
    assert "waiting" not in (challenger.counts.last_reason or "")


def test_a_candidate_that_waits_is_looked_at_now_and_then_only(model: LegModel) -> None:
    challenger, _ = tried(model, model.coefficients * 1.2, contacts=0)
    rng, deciding = np.random.default_rng(3), 0
    for _ in range(10 * LOOK_AGAIN_ROWS):
        deciding += challenger.deciding
        compared(challenger, row(rng, model.library.size, truth=0.06), model)
    assert challenger.trying
    assert deciding == 10


def test_a_newer_refit_takes_the_place_of_a_candidate_that_waits(model: LegModel) -> None:
    """A leg that touches nothing is refitted as often as any; the newest refit waits."""
    given = Given(model.coefficients * 1.2)
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), given)
    buffer, rng, p = SlidingBuffer(), np.random.default_rng(0), model.library.size
    fill(buffer, rng, p, truth=0.06)
    for turn in range(3):
        for _ in range(REFIT_EVERY_SWINGS):
            challenger.swing_done(model, buffer, 0)
        assert given.asked == turn + 1
        for _ in range(REFIT_DUE_TICKS + 1):
            challenger.tick()
        challenger.swing_done(model, buffer, 0)
        assert given.asked == turn + 1, "one that is being tried is not replaced"
        for _ in range(2 * TRIAL_ROWS):
            assert compared(challenger, row(rng, p, truth=0.06), model) is None
        assert "waiting: a candidate" in (challenger.counts.last_reason or "")
    newest = given.coefficients = model.coefficients * 1.21
    for _ in range(REFIT_EVERY_SWINGS):
        challenger.swing_done(model, buffer, 0)
    assert "waiting: a candidate" in (challenger.counts.last_reason or "")
    for _ in range(REFIT_DUE_TICKS + 1):
        challenger.tick()
    for _ in range(TRIAL_CONTACTS):
        challenger.contacts.add([stopped(model)])
    for _ in range(TRIAL_ROWS):
        won = compared(challenger, row(rng, p, truth=0.06), model)
    assert won is not None
    np.testing.assert_array_equal(won.coefficients, newest)


def test_a_refit_under_way_does_not_disturb_the_probation_of_another(model: LegModel) -> None:
    given = Given(model.coefficients * 1.2)
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), given)
    buffer, rng, p = SlidingBuffer(), np.random.default_rng(0), model.library.size
    fill(buffer, rng, p, truth=0.06)
    for _ in range(REFIT_EVERY_SWINGS):
        challenger.swing_done(model, buffer, 0)
    for _ in range(REFIT_DUE_TICKS + 1):
        challenger.tick()
    for _ in range(TRIAL_ROWS):
        compared(challenger, row(rng, p, truth=0.06), model)
    for _ in range(REFIT_EVERY_SWINGS):
        challenger.swing_done(model, buffer, 0)
    assert given.asked == 2
    for _ in range(TRIAL_CONTACTS):
        challenger.contacts.add([stopped(model)])
    won = looked_at(challenger, model)
    assert won is not None
    for _ in range(2 * REFIT_DUE_TICKS):
        challenger.tick()
    for _ in range(PROBATION_ROWS):
        assert compared(challenger, row(rng, p, truth=0.06), won) is None
    assert not challenger.trying
    assert challenger.counts.promoted == 1


@pytest.mark.parametrize("wild", [np.nan, np.inf, 1e6])
def test_a_candidate_that_no_servo_can_be_is_refused_untried(model: LegModel, wild: float) -> None:
    candidate = model.coefficients.copy()
    candidate[3, 1] = wild
    challenger = Challenger(
        "rf", NOISE, np.ones(model.library.size), Given(candidate), plausible=_below_a_radian
    )
    buffer = SlidingBuffer()
    fill(buffer, np.random.default_rng(0), model.library.size)
    for _ in range(REFIT_EVERY_SWINGS):
        challenger.swing_done(model, buffer, 0)
    for _ in range(REFIT_DUE_TICKS + 1):
        challenger.tick()
    assert not challenger.trying
    assert challenger.counts.refused == 1
    assert challenger.counts.last_reason == ("refused: a coefficient is not finite, or implausible")


def _below_a_radian(coefficients: np.ndarray) -> bool:
    return bool(np.abs(coefficients).max() <= 1.0)


def test_a_leg_that_is_not_known_does_not_wait_for_contacts_that_nobody_stores(
    model: LegModel,
) -> None:
    challenger, _ = tried(model, model.coefficients * 1.2, contacts=0)
    assert looked_at(challenger, model, known=False) is not None
    assert challenger.counts.promoted == 1


def test_a_candidate_that_waits_for_contacts_is_tried_on_the_newest_ticks(model: LegModel) -> None:
    challenger, _ = tried(model, model.coefficients * 1.2, contacts=0)
    assert challenger.trying
    rng = np.random.default_rng(2)
    for _ in range(TRIAL_ROWS):  # the leg is again what it was
        compared(challenger, row(rng, model.library.size, truth=0.05), model)
    assert not challenger.trying
    assert challenger.counts.refused == 1


def test_a_lost_refit_of_a_changed_leg_is_asked_for_once_more(model: LegModel) -> None:
    given = Given(model.coefficients)
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), given)
    buffer = SlidingBuffer()
    fill(buffer, np.random.default_rng(0), model.library.size)
    lost = RefitResult(1, FitStatus.LOST, np.zeros_like(model.coefficients), 0.0, float("nan"))
    given.collect = lambda leg, number: lost  # type: ignore[method-assign]
    challenger.withdraw()
    for asked in (1, 2, 2):
        challenger.swing_done(model, buffer, 0)
        assert given.asked == asked
        for _ in range(REFIT_DUE_TICKS + 1):
            challenger.tick()
    assert challenger.counts.refused == 2


def test_who_cannot_be_compared_is_not_promoted(model: LegModel) -> None:
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), Given(model.coefficients))
    challenger._candidate = np.zeros_like(model.coefficients)
    rng = np.random.default_rng(0)
    while challenger.trying:
        asked = challenger.deciding
        new = row(rng, model.library.size, truth=0.06)
        assert challenger.compare(new, [float("nan")] * 3, model) is None
    assert asked, "for the model as it is, in the row that decides"
    assert challenger.counts.refused == 1


def test_in_line_one_job_of_a_leg_waits() -> None:
    refitter = InlineRefitter()
    for number in range(5):
        refitter.submit(ColdJob("rf", number, [], None, None, 0.0))  # type: ignore[arg-type]
    refitter.submit(ColdJob("lf", 0, [], None, None, 0.0))  # type: ignore[arg-type]
    assert {leg: job.number for leg, job in refitter._jobs.items()} == {"rf": 4, "lf": 0}
    assert refitter.collect("rf", 3) is None


def test_a_candidate_that_fits_no_better_is_refused(model: LegModel) -> None:
    challenger, after = tried(model, model.coefficients * 0.8, contacts=0)
    assert after is model
    assert challenger.counts.refused == 1


def test_an_alarm_that_came_too_early_does_not_refuse_the_model_that_knows_better(
    model: LegModel,
) -> None:
    """It is followed by the touch itself, which the better model reports."""
    candidate = model.coefficients * 0.5
    early = stopped(model)
    early = early._replace(target=np.array([early.theta[k] @ candidate for k in range(3)]))
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), Given(candidate))
    challenger.contacts.add([early])
    assert challenger.contacts.found(model.coefficients).tolist() == [True]
    assert challenger.contacts.found(candidate).tolist() == [False]
    challenger.contacts.clear()
    challenger.contacts.add([early, stopped(model)])
    challenger.contacts.add([early])
    assert challenger.contacts.found(candidate).tolist() == [True, False]


def test_a_promoted_model_that_does_worse_is_rolled_back(model: LegModel) -> None:
    challenger, promoted = tried(model, model.coefficients * 1.2, contacts=20)
    assert promoted.version == 1
    rng = np.random.default_rng(1)
    back = None
    for _ in range(PROBATION_ROWS):  # the leg is again what it was
        back = compared(challenger, row(rng, model.library.size, truth=0.05), promoted)
    assert back is not None
    np.testing.assert_array_equal(back.coefficients, model.coefficients)
    assert back.version == 2
    assert challenger.counts.rolled_back == 1
    assert "rolled back: the model before is" in (challenger.counts.last_reason or "")
    assert not challenger.trying


def test_a_promoted_model_that_goes_on_well_stays(model: LegModel) -> None:
    challenger, promoted = tried(model, model.coefficients * 1.2, contacts=20)
    assert promoted.version == 1
    rng = np.random.default_rng(1)
    for _ in range(PROBATION_ROWS):
        assert compared(challenger, row(rng, model.library.size, truth=0.06), promoted) is None
    assert challenger.counts.rolled_back == 0
    assert not challenger.trying


def test_only_swings_of_which_something_was_learned_count(model: LegModel) -> None:
    given = Given(model.coefficients)
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), given)
    buffer = SlidingBuffer()
    fill(buffer, np.random.default_rng(0), model.library.size)
    for _ in range(3 * REFIT_EVERY_SWINGS):
        challenger.swing_done(model, buffer, 0, learned=False)
    assert given.asked == 0


def test_a_refit_that_waits_for_rows_says_so(model: LegModel) -> None:
    given = Given(model.coefficients)
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), given)
    for _ in range(REFIT_EVERY_SWINGS):
        challenger.swing_done(model, SlidingBuffer(), 0)
    assert given.asked == 0
    assert challenger.counts.last_reason == (
        f"waiting: 0 free ticks of the leg as it is to fit to, {4 * model.library.size} are needed"
    )


def test_a_refit_is_asked_for_after_swings_or_time_and_at_once_after_a_change(
    model: LegModel,
) -> None:
    given = Given(model.coefficients)
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), given)
    rng = np.random.default_rng(0)
    p = model.library.size
    few, enough = SlidingBuffer(), SlidingBuffer()
    for buffer, segments in ((few, 3), (enough, 60)):
        fill(buffer, rng, p, segments)

    def swing(buffer: SlidingBuffer, ticks: int) -> int:
        for _ in range(ticks):
            challenger.tick()
        challenger.swing_done(model, buffer, 0)
        challenger._pending = None  # the result does not matter here
        return given.asked

    assert [swing(enough, 20) for _ in range(REFIT_EVERY_SWINGS)][-2:] == [0, 1]
    slow = round(REFIT_EVERY_S / model.library.period_s / 4) + 1
    assert [swing(enough, slow) for _ in range(4)] == [1, 1, 1, 2]
    challenger.withdraw()
    assert swing(few, 20) == 2, "there is too little of the changed leg"
    assert swing(enough, 20) == 3, "as soon as there is enough"
    assert swing(enough, 20) == 3


def test_a_change_of_the_leg_forgets_its_contacts(model: LegModel) -> None:
    challenger = Challenger("rf", NOISE, np.ones(model.library.size), Given(model.coefficients))
    challenger.contacts.add(stopped(model))
    challenger.withdraw()
    assert len(challenger.contacts) == 0


def test_the_newest_contacts_are_kept(model: LegModel) -> None:
    stored = StoredContacts()
    assert stored.found(model.coefficients).shape == (0,)
    for _ in range(MOST + 5):
        stored.add([stopped(model)])
    assert len(stored) == MOST
    assert stored.found(model.coefficients).all()
    assert not stored.found(np.zeros_like(model.coefficients)).any(), "who expects no motion"


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
        challenger = Challenger("rf", NOISE, scale, Given(model.coefficients), known)
        prior = challenger._prior(model)
        assert prior.rows == pytest.approx(rows)
        np.testing.assert_allclose(prior.scale()[1:], scale[1:], rtol=0.05)
        np.testing.assert_allclose(prior.rms(model.coefficients), 0.0, atol=1e-12)
