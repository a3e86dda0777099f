"""The mean rate over seconds, and the schedule that follows late and jittering stamps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from adaptive_contact.checks.source_watch import RateWatch
from adaptive_contact.core.detect.source import vote_late

STEP = 20_000_000


@pytest.mark.parametrize(("step", "missed"), [(30, 0), (33, 1), (37, 1), (41, 1), (60, 2)])
def test_where_readings_are_known_to_be_late_a_late_tick_is_one_without_a_reading(
    step: int, missed: int
) -> None:
    rate = RateWatch(STEP)
    observe(rate)
    for k in range(8):  # its schedule settles
        rate.update(k * STEP + 10**9, 100 + k, restart=k == 0)
    assert rate.update(7 * STEP + 10**9 + step * 1_000_000, 108, restart=False) == missed


@pytest.mark.parametrize("ticks", [4, 5, 8, 12])
@pytest.mark.parametrize("first", [0, 1, 3])
@pytest.mark.parametrize("jitter_ms", [0.0, 3.0])
def test_ticks_of_a_burst_are_counted_by_their_numbers(
    ticks: int, first: int, jitter_ms: float
) -> None:
    """From the second burst on; a pause of the source stays one, and ends no burst."""
    rng = np.random.default_rng(1)
    rate = RateWatch(STEP)
    arrived = [
        (k // ticks * ticks + ticks - 1) * STEP + round(1e6 * jitter_ms * rng.uniform())
        for k in range(0, 40 * ticks, ticks)
    ]
    pause = 30 * ticks
    missed, at = list[int | None](), list[int]()
    for k in range(first, 40 * ticks):
        late = 50 * STEP if k >= pause else 0
        t_ns = arrived[k // ticks] + k % ticks * 300_000 + late
        missed.append(rate.update(t_ns, k, restart=k == first))
        at.append(rate.leg.at_ns)
    settled = 3 * ticks - first
    others = [m for k, m in enumerate(missed) if k >= settled and k != pause - first]
    assert missed[pause - first] is None
    assert set(others) == {0}
    assert rate.burst == ticks
    assert not rate.leg.rate_off
    steps = np.diff(at[settled : pause - first])
    assert np.abs(steps / STEP - 1.0).max() < 0.15


def test_a_stall_that_is_made_up_for_is_no_burst_for_long() -> None:
    rate = RateWatch(STEP)
    for k in range(200):
        stalled = 100 <= k < 106
        t_ns = (105 if stalled else k) * STEP + k % 6 * 300_000 * stalled
        assert rate.update(t_ns, k, restart=k == 0) in ((0,) if k != 100 else (0, None))
        assert rate.burst == 0


def observe(rate: RateWatch, ticks: int = 60) -> None:
    """Ticks late by up to a quarter of a period, and readings that are so, too."""
    rng = np.random.default_rng(0)
    moved, sigma, leg = np.array([0.08, -0.05]), np.array([0.004, 0.004]), rate.own[0]
    for k in range(ticks):
        rate.update(k * STEP + round(rng.uniform(0, STEP / 4)), k, restart=k == 0)
        stretch = float(rate.leg.stretch)
        if stretch:
            # Where readings are known to be late they are moved to their ticks, and leave nothing.
            moved_by = stretch if rate.leg.late == 1 else 0.0
            shown = (stretch - moved_by) * moved + rng.normal(size=2) * 0.004
            vote_late(leg, shown, moved, sigma)
    assert rate.leg.late == 1


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
        assert rate.update(stamp, k, restart=k == 0) == 0
        off.append(bool(rate.leg.rate_off))
    if abs(wrong) < 0.10:
        assert not any(off)
        assert rate.jitter == pytest.approx(sigma, rel=0.35)
    else:
        assert np.mean(off[150:]) > 0.95


@given(st.lists(st.floats(-0.45, 0.45), min_size=50, max_size=200))
def test_the_schedule_follows_the_stamps_and_never_runs_back(off: list[float]) -> None:
    rate = RateWatch(STEP)
    before = 0
    for k, by in enumerate(off):
        assert rate.update(round((k + 1 + by) * STEP), k, restart=k == 0) == 0
        if k:
            assert 0.8 * STEP < rate.leg.at_ns - before < 1.2 * STEP
        before = rate.leg.at_ns
        assert abs(rate.leg.at_ns - (k + 1) * STEP) <= 0.45 * STEP + 2
