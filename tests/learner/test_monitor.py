"""What a leg's lifts say of it: change, creep, settling, and what cannot be told."""

from __future__ import annotations

import copy
from collections.abc import Iterable

import numpy as np
import pytest

from adaptive_contact.core.learn.drift import (
    OBSTRUCTED_SWINGS,
    PATIENCE_SWINGS,
    RELEASE_SWINGS,
    SETTLED_SWINGS,
    UNFIT_LIFTS,
    WORN_LEVEL,
    DriftMonitor,
    LiftAssessment,
)

from .ticks import Tick, rows_of

SWING_NS = 1_000_000_000


class Leg:
    """A leg's monitor, which has seen so many swings as they should be."""

    def __init__(self, calm: int = 30) -> None:
        self.monitor, self.swing = DriftMonitor(3), 0
        assert not any(lift.changed for lift in self.lifts([1.0] * calm))

    def lifts(
        self,
        levels: Iterable[float],
        *,
        held: bool | None = None,
        refuted: bool = False,
        rng: np.random.Generator | None = None,
        way_rad: float = 0.0,
    ) -> list[LiftAssessment]:
        """Lifts whose residuals are so many times as large, squared, as they should be.

        Args:
            levels: how many times, lift by lift.
            held: whether the foot came short of its command's way; None where it is not known.
            refuted: whether a stance refuted the contact before.
            rng: of residuals that scatter.
            way_rad: how far each of three joints moves in every tick.
        """
        assessed = []
        for level in levels:
            self.monitor.begin_swing(refuted=refuted)
            if held is not None:
                self.monitor.record_travel(obstructed=held, travel_ratio=0.5 if held else 1.0)
            of = [level] * 6 if rng is None else (level * rng.chisquare(3, 6) / 3).tolist()
            way = np.full(3, way_rad)
            ticks = [Tick(np.zeros(1), way, at, 3 * at, t_ns=k) for k, at in enumerate(of)]
            assessed.append(self.monitor.assess_lift(rows_of(ticks), self.swing * SWING_NS))
            self.swing += 1
        return assessed


def test_a_good_model_is_hardly_ever_doubted() -> None:
    leg = Leg(calm=0)
    assert not any(x.changed for x in leg.lifts([1.0] * 5000, rng=np.random.default_rng(0)))
    assert leg.monitor.status == "valid"
    assert leg.monitor.variance_scale == pytest.approx(1.0, abs=0.35)


def test_a_lasting_level_is_never_called_valid() -> None:
    """A level that stays is followed and doubted no more; it is no good model's all the same."""
    leg = Leg()
    leg.lifts([30.0] * 200)
    assert leg.monitor.status == "ambiguous"
    assert leg.monitor.drift.since_ns == 30 * SWING_NS
    leg.lifts([1.0] * SETTLED_SWINGS)
    assert (leg.monitor.status, leg.monitor.note) == ("valid", None)


def test_what_creeps_up_lift_by_lift_is_a_change_too() -> None:
    leg, level, assessed = Leg(), 1.0, []
    while not assessed or not assessed[-1].changed:
        level *= 1.02
        assessed += leg.lifts([level])
    assert assessed[-1].first
    assert leg.monitor.status == "adapting"
    assert level < 2.0 * WORN_LEVEL
    assert all(lift.rows for lift in assessed), "nothing stood out on the way"


def test_a_foot_that_does_not_rise_is_ambiguous_until_it_does() -> None:
    leg = Leg()
    for _ in range(OBSTRUCTED_SWINGS):
        leg.monitor.record_travel(obstructed=True, travel_ratio=0.4)
    assert leg.monitor.status == "ambiguous"
    assert leg.monitor.note == (
        "the foot came 40 % of its command's way, 2 swings in a row: caught, no strength, or it "
        "strikes or stands on something"
    )
    for _ in range(RELEASE_SWINGS):
        assert leg.monitor.obstructed
        assert leg.lifts([1.0], held=False)[0].rows, "what is predicted is learned"
    assert (leg.monitor.status, leg.monitor.note) == ("valid", None)


def test_a_foot_on_a_leash_is_ambiguous_and_nothing_of_it_is_learned() -> None:
    """It comes with its command, and is pulled as no drift pulls it; now and then it is not."""
    leg = Leg()
    pulled = [120.0 if k % 4 < 2 else 20.0 for k in range(2 * PATIENCE_SWINGS + 2)]
    assert not any(lift.rows or lift.changed for lift in leg.lifts(pulled, held=False))
    assert leg.monitor.status == "ambiguous"
    assert "caught, no strength" in (leg.monitor.note or "")
    assert all(lift.rows for lift in leg.lifts([1.0] * RELEASE_SWINGS, held=False))
    assert leg.monitor.status == "valid"
    assert leg.monitor.variance_scale < 2.0, "what was not learned has not raised the level"


@pytest.mark.parametrize(
    ("level", "learned"), [(1.0, True), (2.0, True), (5.0, False), (50.0, False)]
)
@pytest.mark.parametrize("held", [True, False])
def test_of_a_leg_that_is_doubted_what_its_model_predicts_is_learned(
    level: float, *, learned: bool, held: bool
) -> None:
    """Whether its foot comes short of its way in every swing, or has done so before."""
    leg = Leg()
    for k in range(12):
        (assessed,) = leg.lifts([level], held=held or k < OBSTRUCTED_SWINGS)
        if leg.monitor.obstructed and k >= OBSTRUCTED_SWINGS:
            assert bool(assessed.rows) is learned
            # Nothing of a descent that something may have met.
            assert leg.monitor.trusted is (learned and not held)
        assert not assessed.changed or not leg.monitor.obstructed
    assert (leg.monitor.status == "ambiguous") is held


def test_a_leg_that_stays_as_far_off_is_followed_in_the_end() -> None:
    """A horn that slipped: ambiguous as long as a foot may be caught, not for ever."""
    leg = Leg()
    *before, last = leg.lifts([200.0] * PATIENCE_SWINGS, held=False)
    assert not any(lift.changed for lift in before)
    assert last.changed
    assert last.rows
    assert leg.monitor.trusted


def test_a_baseline_that_never_fitted_is_unfit_and_one_that_did_is_not() -> None:
    """One that fitted by chance is: nothing that is learned brings it any nearer."""
    never, once = Leg(calm=0), Leg(calm=1)
    never.lifts([100.0] * (UNFIT_LIFTS - 1))
    assert not never.monitor.unfit
    never.lifts([100.0])
    assert never.monitor.unfit
    once.lifts([100.0] * 10)
    assert not once.monitor.unfit, "the leg may have changed"
    for _ in range(PATIENCE_SWINGS - 11):
        assert not once.monitor.unfit
        once.lifts([30.0])
    assert once.monitor.unfit


def test_a_foot_on_a_leash_from_the_start_says_nothing_of_the_baseline() -> None:
    """Its lifts are as far off as another leg's: none is thrown."""
    leashed = Leg(calm=0)
    for k in range(PATIENCE_SWINGS - 1):
        leashed.lifts([120.0])
        assert not leashed.monitor.unfit
        assert k < 1 or leashed.monitor.status == "ambiguous"
    another = copy.deepcopy(leashed)
    leashed.lifts([1.0] * (RELEASE_SWINGS + 1))
    assert (leashed.monitor.status, leashed.monitor.unfit) == ("valid", False)
    another.lifts([120.0])
    assert another.monitor.unfit, "no foot is caught in one way for so long and comes all its way"


def test_ticks_in_which_a_leg_hardly_moves_take_no_suspicion_back() -> None:
    """They fit any model: at the top of a swing, a joint that is late is where it should be."""
    leg = Leg()
    assert not leg.lifts([12.0], way_rad=0.03)[0].changed
    for _ in range(9):
        leg.monitor.watch_tick(0.2, 3 * 0.01)
    assert leg.monitor.variance_in_force > 5.0
    for _ in range(3):
        leg.monitor.watch_tick(0.2, 3 * 0.02)
    assert leg.monitor.variance_in_force == leg.monitor.variance_scale < 2.0


def test_lifts_that_are_off_again_and_again_are_a_change_whatever_the_top_says() -> None:
    leg, assessed = Leg(), []
    for _ in range(4):
        assessed += leg.lifts([12.0], way_rad=0.03)
        for _ in range(6):
            leg.monitor.watch_tick(0.2, 3 * 0.005)
    assert assessed[1].changed
    assert leg.monitor.status == "adapting"


def test_a_leg_that_is_far_off_is_not_free_by_its_way_alone() -> None:
    """One with other servos comes all of it, and its lifts may be too short to assess."""
    leg = Leg()
    leg.lifts([200.0] * 3)
    for _ in range(3 * RELEASE_SWINGS):
        assert leg.monitor.doubt == "far"
        leg.monitor.begin_swing()
        leg.monitor.record_travel(obstructed=False, travel_ratio=1.0)
    leg.lifts([1.0] * RELEASE_SWINGS, held=False)
    assert leg.monitor.status == "valid"


@pytest.mark.parametrize("refuted", [1, 2, 3])
def test_contacts_that_stances_refute_are_an_error_of_the_model(refuted: int) -> None:
    leg, unlearned = Leg(), []
    for swing in range(refuted + 3):
        leg.lifts([1.0], refuted=swing < refuted)
        unlearned.append(leg.monitor.unlearned)
    # From the second refuted one on, until the second that is not.
    assert unlearned == [1 <= swing <= refuted and refuted > 1 for swing in range(refuted + 3)]
