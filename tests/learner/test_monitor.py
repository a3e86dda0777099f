"""What a leg's lifts say of it: change, creep, settling, and what cannot be told."""

from __future__ import annotations

import copy

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
from adaptive_contact.model.labelled_swing import Rows

from .ticks import Tick, rows_of

SWING_NS = 1_000_000_000


def lift(level: float, rng: np.random.Generator | None = None, ticks: int = 6) -> Rows:
    """Rows of a lift whose residuals are so many times as large, squared, as they should be."""
    levels = (
        np.full(ticks, level) if rng is None else level * rng.chisquare(3, ticks) / 3
    ).tolist()
    return rows_of(
        [Tick(np.zeros(1), np.zeros(3), at, 3 * at, t_ns=k) for k, at in enumerate(levels)]
    )


def assess(monitor: DriftMonitor, level: float, swing: int, **more: object) -> LiftAssessment:
    monitor.begin_swing()
    return monitor.assess_lift(lift(level, **more), swing * SWING_NS)  # type: ignore[arg-type]


def calmed() -> DriftMonitor:
    """Of a leg that has swung for a while as it should."""
    monitor = DriftMonitor(3)
    for k in range(30):
        assert not assess(monitor, 1.0, k).changed
    return monitor


def test_a_good_model_is_hardly_ever_doubted() -> None:
    rng = np.random.default_rng(0)
    monitor = DriftMonitor(3)
    changed = sum(assess(monitor, 1.0, k, rng=rng).changed for k in range(5000))
    assert changed == 0
    assert monitor.status == "valid"
    assert monitor.variance_scale == pytest.approx(1.0, abs=0.35)


def test_a_lasting_level_is_never_called_valid() -> None:
    """A level that stays is followed and doubted no more; it is no good model's all the same."""
    monitor = calmed()
    for k in range(200):
        assess(monitor, 30.0, 30 + k)
    assert monitor.status == "ambiguous"
    assert monitor.drift.since_ns == 30 * SWING_NS
    for k in range(SETTLED_SWINGS):
        assess(monitor, 1.0, 230 + k)
    assert monitor.status == "valid"
    assert monitor.note is None


def test_what_creeps_up_lift_by_lift_is_a_change_too() -> None:
    monitor = calmed()
    level, assessed = 1.0, []
    for k in range(200):
        level *= 1.02
        assessed.append(assess(monitor, level, 30 + k))
        if assessed[-1].changed:
            break
    assert assessed[-1].first
    assert monitor.status == "adapting"
    assert level < 2.0 * WORN_LEVEL
    assert all(h.rows for h in assessed), "nothing stood out on the way"


def test_a_foot_that_does_not_rise_is_ambiguous_until_it_does() -> None:
    monitor = calmed()
    for _ in range(OBSTRUCTED_SWINGS):
        monitor.note_travel(obstructed=True, travel_ratio=0.4)
    assert monitor.status == "ambiguous"
    assert monitor.note == (
        "the foot came 40 % of its command's way, 2 swings in a row: caught, no strength, or it "
        "strikes or stands on something"
    )
    for k in range(RELEASE_SWINGS):
        assert monitor.obstructed
        assert rises(monitor, 1.0, 40 + k).rows, "what is predicted is learned"
    assert monitor.status == "valid"
    assert monitor.note is None


def rises(monitor: DriftMonitor, level: float, swing: int) -> LiftAssessment:
    """A swing in which the foot came with its command."""
    monitor.begin_swing()
    monitor.note_travel(obstructed=False, travel_ratio=1.0)
    return monitor.assess_lift(lift(level), swing * SWING_NS)


def test_a_foot_on_a_leash_is_ambiguous_and_nothing_of_it_is_learned() -> None:
    """It comes with its command, and is pulled as no drift pulls it; now and then it is not."""
    monitor = calmed()
    assessed = [
        rises(monitor, 120.0 if k % 4 < 2 else 20.0, 30 + k) for k in range(2 * PATIENCE_SWINGS + 2)
    ]
    assert not any(h.rows or h.changed for h in assessed)
    assert monitor.status == "ambiguous"
    assert "caught, no strength" in (monitor.note or "")
    free = [rises(monitor, 1.0, 100 + k) for k in range(RELEASE_SWINGS)]
    assert all(h.rows for h in free)
    assert monitor.status == "valid"
    assert monitor.variance_scale < 2.0, "what was not learned has not raised the level"


@pytest.mark.parametrize(
    ("level", "learned"), [(1.0, True), (2.0, True), (5.0, False), (50.0, False)]
)
@pytest.mark.parametrize("held", [True, False])
def test_of_a_leg_that_is_doubted_what_its_model_predicts_is_learned(
    level: float, *, learned: bool, held: bool
) -> None:
    """Whether its foot comes short of its way in every swing, or has done so before."""
    monitor = calmed()
    for k in range(12):
        monitor.begin_swing()
        monitor.note_travel(obstructed=held or k < OBSTRUCTED_SWINGS, travel_ratio=0.5)
        assessed = monitor.assess_lift(lift(level), (30 + k) * SWING_NS)
        if monitor.obstructed and k >= OBSTRUCTED_SWINGS:
            assert bool(assessed.rows) is learned
            # Nothing of a descent that something may have met.
            assert monitor.trusted is (learned and not held)
        assert not assessed.changed or not monitor.obstructed
    assert (monitor.status == "ambiguous") is held


def test_a_leg_that_stays_as_far_off_is_followed_in_the_end() -> None:
    """A horn that slipped: ambiguous as long as a foot may be caught, not for ever."""
    monitor = calmed()
    assessed = [rises(monitor, 200.0, 30 + k) for k in range(PATIENCE_SWINGS)]
    assert not any(h.changed for h in assessed[:-1])
    assert assessed[-1].changed
    assert assessed[-1].rows
    assert monitor.trusted


def test_a_baseline_that_never_fitted_is_unfit_and_one_that_did_is_not() -> None:
    monitor = DriftMonitor(3)
    for k in range(UNFIT_LIFTS):
        assert not monitor.unfit
        assess(monitor, 100.0, k)
    assert monitor.unfit
    later = DriftMonitor(3)
    assess(later, 1.0, 0)
    for k in range(10):
        assess(later, 100.0, 1 + k)
    assert not later.unfit, "it fitted once: the leg may have changed"
    for k in range(PATIENCE_SWINGS - 11):
        assert not later.unfit
        assess(later, 30.0, 11 + k)
    assert later.unfit, "it fitted by chance: nothing that is learned brings it any nearer"


def test_a_foot_on_a_leash_from_the_start_says_nothing_of_the_baseline() -> None:
    """Its lifts are as far off as another leg's: for as long as nobody can tell, none is thrown."""
    monitor = DriftMonitor(3)
    for k in range(PATIENCE_SWINGS - 1):
        assess(monitor, 120.0, k)
        assert not monitor.unfit
        assert k < 1 or monitor.status == "ambiguous"
    leashed, another = copy.deepcopy(monitor), monitor
    for k in range(RELEASE_SWINGS + 1):
        assess(leashed, 1.0, PATIENCE_SWINGS + k)
    assert leashed.status == "valid"
    assert not leashed.unfit
    assess(another, 120.0, PATIENCE_SWINGS)
    assert another.unfit, "no foot is caught in the same way for so long and comes all its way"


def moved(level: float, way_rad: float) -> Rows:
    """Rows of a lift in whose ticks each of three joints moves so far."""
    rows = lift(level)
    rows.target[:] = way_rad
    return rows


def test_ticks_in_which_a_leg_hardly_moves_take_no_suspicion_back() -> None:
    """They fit any model: at the top of a swing, a joint that is late is where it should be."""
    monitor = calmed()
    monitor.begin_swing()
    assert not monitor.assess_lift(moved(12.0, 0.03), 40 * SWING_NS).changed
    for _ in range(9):
        monitor.watch_tick(0.2, 3 * 0.01)
    assert monitor.variance_in_force > 5.0
    for _ in range(3):
        monitor.watch_tick(0.2, 3 * 0.02)
    assert monitor.variance_in_force == monitor.variance_scale < 2.0


def test_lifts_that_are_off_again_and_again_are_a_change_whatever_the_top_says() -> None:
    monitor = calmed()
    changed = []
    for swing in range(40, 44):
        monitor.begin_swing()
        changed.append(monitor.assess_lift(moved(12.0, 0.03), swing * SWING_NS).changed)
        for _ in range(6):
            monitor.watch_tick(0.2, 3 * 0.005)
    assert changed[1]
    assert monitor.status == "adapting"


def test_a_leg_that_is_far_off_is_not_free_by_its_way_alone() -> None:
    """One with other servos comes all of it, and its lifts may be too short to assess."""
    monitor = calmed()
    for swing in range(40, 43):
        assess(monitor, 200.0, swing)
    assert monitor.doubt == "far"
    for _ in range(3 * RELEASE_SWINGS):
        monitor.begin_swing()
        monitor.note_travel(obstructed=False, travel_ratio=1.0)
        assert monitor.doubt == "far"
    for swing in range(60, 60 + RELEASE_SWINGS):
        rises(monitor, 1.0, swing)
    assert monitor.status == "valid"


@pytest.mark.parametrize("refuted", [1, 2, 3])
def test_contacts_that_stances_refute_are_an_error_of_the_model(refuted: int) -> None:
    monitor, unlearned = calmed(), []
    for swing in range(refuted + 3):
        monitor.begin_swing(refuted=swing < refuted)
        monitor.assess_lift(lift(1.0), (40 + swing) * SWING_NS)
        unlearned.append(monitor.unlearned)
    # From the second refuted one on, until the second that is not.
    assert unlearned == [1 <= swing <= refuted and refuted > 1 for swing in range(refuted + 3)]
