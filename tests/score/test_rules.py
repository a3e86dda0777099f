"""Clauses of the rules (docs/scoring.md), worked by hand; rows of touches: test_reference.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.score import (
    ROWS,
    Events,
    LegOutcome,
    LegStream,
    clopper_pearson,
    find_swings,
    is_harmful,
    lift_by_halves,
    lift_by_height,
    match,
    poisson_mean,
    summarise,
    truth_changes,
)
from adaptive_contact.wire import ContactTruth

MS = 1_000_000


def touch(
    at_ms: float,
    until_ms: float | None = None,
    *,
    speed: float | None = 0.4,
    surface: str = "hard",
    grazing: bool = False,
) -> list[ContactTruth]:
    """A contact: a change that begins it and, unless it stays, one that ends it."""
    changes = [
        ContactTruth(
            t_ns=round(at_ms * MS),
            contact=True,
            force=2.0,
            speed_m_s=speed,
            surface=surface,
            grazing=grazing,
        )
    ]
    if until_ms is not None:
        changes.append(ContactTruth(t_ns=round(until_ms * MS), contact=False, force=0.0))
    return changes


AIR = [ContactTruth(t_ns=0, contact=False, force=0.0)]


def judge(
    phases: str, truth: list[ContactTruth], *events_ms: float, lift: str | None = None
) -> LegOutcome:
    """Judge ``contact: true`` at the given times; a tick of 20 ms per letter, s is swing."""
    n = len(phases)
    stream = LegStream(
        leg="rf",
        t_ns=np.arange(n, dtype=np.int64) * 20 * MS,
        swing=np.array([letter == "s" for letter in phases]),
        lift=np.zeros(n, dtype=bool) if lift is None else np.array([x == "l" for x in lift]),
        truth=truth_changes(truth),
    )
    times = np.array([round(ms * MS) for ms in events_ms], dtype=np.int64)
    return match(stream, Events(times, np.ones(len(times), dtype=bool), times - 10 * MS))


# Ten ticks of stance (0-180 ms), then forty of swing (200-980 ms), then ten of stance.
WALK = "." * 10 + "s" * 40 + "." * 10


# Then stance, its first tick at 1000 ms, where nothing touches.
LONG = "." * 10 + "s" * 40 + "." * 30 + "s" * 20


def test_events_after_the_turn_have_a_rate_of_their_own() -> None:
    after = summarise([judge(LONG, AIR, 1000, 1319, 1320, 1599)]).after
    assert (after.false_alarms, after.judged_ticks) == (4, 16)
    assert after.per_hour == pytest.approx(4 * ROBOT_HOUR_TICKS / 16)


def test_a_truth_without_speed_has_its_row_whenever_its_touches_come() -> None:
    truth = [*AIR, *touch(300, 320, speed=None), *touch(700, 720, speed=None)]
    lift = "." * 10 + "l" * 10 + "." * 60
    outcome = judge(LONG, truth + touch(990, speed=None), 720, 1000, lift=lift)
    assert [ROWS[row] for row in outcome.touches.row] == ["lift", "unknown", "unknown"]
    summary = summarise([outcome])
    assert summary.headline == "unknown"
    assert (summary.counted.touches, summary.in_time.touches) == (2, 1)
    assert (summary.late_in_swing.found, summary.late_after.touches) == (1, 0)
    assert summarise([judge(WALK, AIR + touch(500))]).headline == "headline"
    assert summarise([]).headline == "headline"


def test_lift_by_height_ends_within_a_millimetre_of_the_top() -> None:
    mask = np.array([letter == "s" for letter in "..sssssss..sss"])
    height = np.array([9, 9, 1, 5, 8, 9.5, 10, 7, 3, 9, 9, 5, 3, 1]) * 1e-3
    swings = find_swings(np.arange(14, dtype=np.int64) * 20 * MS, mask)
    assert np.flatnonzero(lift_by_height(swings, height)).tolist() == [2, 3, 4]
    assert np.flatnonzero(lift_by_halves(swings)).tolist() == [2, 3, 4, 11]


def test_counts_rates_and_intervals() -> None:
    phases = "s" * 30 + "." * 5
    n = 40
    truth = AIR + [c for k in range(n) for c in touch(700 * k + 300, 700 * k + 310)]
    found = [700 * k + 320 for k in range(36)]
    outcome = judge(phases * n, truth, *found, 100, 800)
    summary = summarise([outcome])
    row = summary.rows[ROWS[0]]
    assert (row.touches, row.found, row.recall) == (40, 36, 0.9)
    # 95 % limits as tabulated: 36 of 40, and a count of 2.
    assert row.interval == pytest.approx((0.7634, 0.9721), abs=1e-4)
    assert summary.precision == pytest.approx(36 / 38)
    assert summary.judged_ticks == 35 * n  # no foot stands
    assert summary.robot_hours == 35 * n / ROBOT_HOUR_TICKS
    hours = summary.robot_hours
    assert summary.per_hour == pytest.approx(2 / hours)
    assert summary.per_hour_interval == pytest.approx((0.2422 / hours, 7.2247 / hours), rel=1e-4)
    assert row.latency.median_ms == 20.0
    assert summary.lost_swings == 6  # four misses, two false alarms


def test_counted_leaves_out_what_may_be_beyond_any_detector() -> None:
    phases = "s" * 30 + "." * 5
    kinds: list[dict[str, float | bool | str | None]] = [
        {"speed": 0.4},
        {"speed": 0.15},
        {"speed": 0.05},
        {"speed": 0.4, "surface": "soft"},
        {"speed": None},
        {"speed": 0.01},
        {"speed": 0.4, "grazing": True},
    ]
    truth = list(AIR)
    for k, kind in enumerate(kinds):
        truth += touch(700 * k + 300, 700 * k + 400, **kind)  # type: ignore[arg-type]
    late = 700 * len(kinds) + 570
    outcome = judge(phases * (len(kinds) + 1), truth + touch(late))
    summary = summarise([outcome])
    assert {row: figures.touches for row, figures in summary.rows.items()} == dict.fromkeys(
        ["headline", "mid", "slow", "soft", "unknown", "creep", "grazing", "late"], 1
    )
    assert summary.counted.touches == 6
    assert summary.in_time.touches == 5
    assert summary.late_in_swing.touches == 1
    assert summary.lost_swings == 6
    assert outcome.swings.touches.tolist() == [1, 1, 1, 1, 1, 0, 0, 1]


def test_nothing_to_judge() -> None:
    summary = summarise([judge("....", AIR)])
    assert summary.rows[ROWS[0]].recall is None
    assert summary.rows[ROWS[0]].interval == (0.0, 1.0)
    assert summary.precision is None
    assert summary.per_hour is None
    assert math.isinf(summary.per_hour_interval.high)
    assert summarise([]).swings == 0


# -- Exact intervals against scipy's own tests, and against what they must mean


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 3000), st.integers(0, 3000), st.sampled_from([0.9, 0.95, 0.99]))
def test_clopper_pearson_equals_scipy(a: int, b: int, confidence: float) -> None:
    successes, trials = min(a, b), max(a, b, 1)
    expected = stats.binomtest(successes, trials).proportion_ci(confidence, method="exact")
    assert clopper_pearson(successes, trials, confidence) == pytest.approx(
        (expected.low, expected.high), abs=1e-9
    )


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2000))
def test_poisson_ends_leave_half_of_5_percent_outside(count: int) -> None:
    low, high = poisson_mean(count)
    assert stats.poisson.cdf(count, high) == pytest.approx(0.025, rel=1e-6)
    if count:
        assert stats.poisson.sf(count - 1, low) == pytest.approx(0.025, rel=1e-6)
    else:
        assert low == 0.0


# -- Recovery after a drift, and which drifts count


def outcome(found: list[bool], alarms: int) -> LegOutcome:
    """Swings with a touch each, found or not, and false alarms in the first ones."""
    n = len(found)
    truth = AIR + [c for k in range(n) for c in touch(700 * k + 300, 700 * k + 400)]
    hits = [700 * k + 320 for k in range(n) if found[k]]
    return judge(("s" * 30 + "." * 5) * n, truth, *hits, *(700 * k + 100 for k in range(alarms)))


def test_a_drift_counts_when_recall_is_lost_or_alarms_rise_tenfold() -> None:
    twin = outcome([True] * 100, 2)
    assert not is_harmful([outcome([True] * 96 + [False] * 4, 2)], [twin])
    assert is_harmful([outcome([True] * 95 + [False] * 5, 2)], [twin])
    assert not is_harmful([outcome([True] * 100, 19)], [twin])
    assert is_harmful([outcome([True] * 100, 20)], [twin])
    silent = outcome([True] * 100, 0)
    assert not is_harmful([outcome([True] * 100, 9)], [silent])
    assert is_harmful([outcome([True] * 100, 10)], [silent])
