"""The mean rate over seconds, and the schedule that follows late and jittering stamps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from adaptive_contact.detect.source import vote_late
from adaptive_contact.detect.source_watch import RateWatch

STEP = 20_000_000


def watch(
    steps: list[int], *, numbers: list[int] | None = None
) -> tuple[RateWatch, list[int | None]]:
    """Feeds a 20 ms watch samples that are so many ms apart; the ticks missed at each."""
    rate = RateWatch(20_000_000)
    missed_at: list[int | None] = []
    t_ns = seq = 0
    for step, number in zip(steps, numbers or [1] * len(steps), strict=True):
        t_ns, seq = t_ns + step * 1_000_000, seq + number
        missed_at.append(rate.follow(t_ns, seq, restart=False))
    return rate, missed_at


@pytest.mark.parametrize("step", [16, 24])
def test_another_rate_shows_within_five_ticks(step: int) -> None:
    for after, off in ((3, False), (5, True)):
        rate, missed = watch([20] * 40 + [step] * after)
        assert rate.off is off
        assert not any(missed)
    rate, _ = watch([20] * 40 + [step] * 60)
    assert rate.found_ns == step * 1_000_000
    assert not watch([step] * 40 + [20] * 8)[0].off


def test_jitter_and_lost_samples_are_no_other_rate() -> None:
    rng = np.random.default_rng(0)
    times = 20.0 * np.arange(20_000) + rng.uniform(-5, 5, 20_000)
    numbers = np.sort(rng.choice(20_000, 18_000, replace=False))
    rate = RateWatch(20_000_000)
    lost = 0
    for number in numbers:
        missed = rate.follow(round(times[number] * 1e6), int(number), restart=False)
        assert missed is not None
        assert not rate.off
        lost += missed
    assert lost == numbers[-1] - numbers[0] - len(numbers) + 1


@pytest.mark.parametrize("step", [30, 33, 37, 41, 60])
def test_one_tick_that_comes_late_is_no_other_rate(step: int) -> None:
    """Nor is a sample lost: its number says so."""
    for after in range(1, 20):
        rate, missed_at = watch([20] * 20 + [step] + [20] * after)
        assert not rate.off
        assert not any(missed_at)
    _, missed_at = watch([20] * 20 + [60], numbers=[1] * 20 + [2])
    assert missed_at[-1] == 1


@pytest.mark.parametrize(("step", "missed"), [(30, 0), (33, 1), (37, 1), (41, 1), (60, 2)])
def test_where_readings_are_known_to_be_late_a_late_tick_is_one_without_a_reading(
    step: int, missed: int
) -> None:
    rate = RateWatch(STEP)
    observe(rate, late=True)
    for k in range(8):  # its schedule settles
        rate.follow(k * STEP + 10**9, 100 + k, restart=k == 0)
    assert rate.follow(7 * STEP + 10**9 + step * 1_000_000, 108, restart=False) == missed


def observe(rate: RateWatch, *, late: bool, ticks: int = 60) -> None:
    """Ticks late by up to a quarter of a period, and readings that are so, too, or are not."""
    rng = np.random.default_rng(0)
    moved, sigma, leg = np.array([0.08, -0.05]), np.array([0.004, 0.004]), rate.own[0]
    for k in range(ticks):
        rate.follow(k * STEP + round(rng.uniform(0, STEP / 4)), k, restart=k == 0)
        stretch = float(rate.leg.stretch)
        if stretch:
            # Where readings are known to be late they are moved to their ticks, and leave nothing.
            share = stretch if late else 0.0
            moved_by = stretch if rate.leg.late == 1 else 0.0
            shown = (share - moved_by) * moved + rng.normal(size=2) * 0.004
            vote_late(leg, shown, moved, sigma)
    assert rate.late is late


def test_readings_tell_whether_ticks_or_stamps_are_late() -> None:
    rate = RateWatch(STEP)
    assert rate.late is None
    observe(rate, late=False)
    observe(rate, late=True, ticks=600)  # the source is another, and its readings say so
    observe(rate, late=False, ticks=600)


@given(st.sampled_from([0.1, 0.4]), st.floats(-0.25, 0.25), st.integers(0, 20))
def test_of_stamps_that_jitter_the_mean_tells_the_rate(
    sigma: float, wrong: float, seed: int
) -> None:
    """Off by a tenth or not, within two seconds, and never while it is not."""
    assume(not 0.05 < abs(wrong) < 0.13)
    rng = np.random.default_rng(seed)
    t_ns = np.round((np.arange(400) * (1.0 + wrong) + rng.normal(size=400) * sigma) * STEP)
    t_ns = np.maximum.accumulate(t_ns + 10**9 + np.arange(400))
    rate = RateWatch(STEP)
    off = []
    for k, stamp in enumerate(t_ns.astype(int).tolist()):
        assert rate.follow(stamp, k, restart=k == 0) == 0
        off.append(rate.off)
    if abs(wrong) < 0.10:
        assert not any(off)
        assert rate.jitter == pytest.approx(sigma, rel=0.35)
    else:
        assert np.mean(off[150:]) > 0.95


@pytest.mark.parametrize(("share", "delay"), [(0.25, 0.25), (0.1, 0.5), (0.5, 0.12)])
def test_delays_that_add_up_are_no_other_rate_for_a_moment(share: float, delay: float) -> None:
    """A loop that sleeps a period after each tick: only the mean of many steps is its rate."""
    rng = np.random.default_rng(3)
    rate = RateWatch(STEP)
    observe(rate, late=True)
    steps = 1.0 + delay * (rng.random(5000) < share)
    stamps = np.round(np.cumsum(steps) * STEP).astype(int).tolist()
    off = []
    for k, t_ns in enumerate(stamps):
        rate.leg.late = 1  # by its readings
        assert rate.follow(t_ns, k, restart=k == 0) is not None
        off.append(rate.off)
    assert not any(off)
    # One that is too slow in the mean is, within two seconds.
    for k in range(101):
        rate.follow(stamps[-1] + (k + 1) * round(1.2 * STEP), 5000 + k, restart=False)
    assert rate.off


@given(st.lists(st.floats(-0.45, 0.45), min_size=50, max_size=200))
def test_the_schedule_follows_the_stamps_and_never_runs_back(off: list[float]) -> None:
    rate = RateWatch(STEP)
    before = 0
    for k, by in enumerate(off):
        assert rate.follow(round((k + 1 + by) * STEP), k, restart=k == 0) == 0
        if k:
            assert 0.8 * STEP < rate.at_ns - before < 1.2 * STEP
        before = rate.at_ns
        assert abs(rate.at_ns - (k + 1) * STEP) <= 0.45 * STEP + 2


def test_a_pause_connects_nothing_whether_it_was_counted_or_not() -> None:
    assert watch([20] * 10 + [5000] + [20] * 10)[1] == [0] * 10 + [None] + [0] * 10
    # 200 ms with nine samples lost is what it says; a number that does not count it is a pause.
    assert watch([20] * 10 + [200, 20], numbers=[1] * 10 + [10, 1])[1] == [0] * 10 + [9, 0]
    assert watch([20] * 10 + [200])[1][-1] is None


def test_a_restart_begins_the_schedule_again() -> None:
    rate, _ = watch([24] * 20)
    assert rate.off
    rate.follow(0, 0, restart=True)
    assert not rate.off
    assert rate.found_ns is None
