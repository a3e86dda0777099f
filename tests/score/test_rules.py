"""Every clause of the rules (docs/scoring.md), worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.score import (
    ROWS,
    Events,
    LegOutcome,
    LegStream,
    find_swings,
    lift_by_halves,
    lift_by_height,
    match,
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


def rows(outcome: LegOutcome) -> list[str]:
    return [ROWS[row].value for row in outcome.touches.row]


# Ten ticks of stance (0-180 ms), then forty of swing (200-980 ms), then ten of stance.
WALK = "." * 10 + "s" * 40 + "." * 10


class TestDetection:
    def test_first_event_in_the_window_detects(self) -> None:
        outcome = judge(WALK, AIR + touch(505), 520, 540)
        assert outcome.touches.found.tolist() == [True]
        assert outcome.touches.latency_ns.tolist() == [15 * MS]
        assert outcome.touches.onset_error_ns.tolist() == [5 * MS]  # estimate 510, onset 505
        assert outcome.alarms_ns.tolist() == [540 * MS]  # "every other" one is a false alarm

    @pytest.mark.parametrize(
        ("event_ms", "found"), [(500, False), (520, True), (620, True), (640, False)]
    )
    def test_window_is_open_at_the_onset_and_closed_at_120_ms(
        self, event_ms: float, found: bool
    ) -> None:
        outcome = judge(WALK, AIR + touch(500), event_ms)
        assert outcome.touches.found.tolist() == [found]
        assert len(outcome.alarms_ns) == (1 if event_ms == 500 else 0)

    @pytest.mark.parametrize(
        ("events_ms", "found", "latency_ms"),
        [
            ([420], [True, False], [20, -1]),
            ([480], [True, False], [80, -1]),  # the sample at the bounce cannot know of it
            ([500], [False, True], [-1, 20]),  # a miss is none the less one for a bounce
            ([420, 500], [True, True], [20, 20]),
        ],
    )
    def test_an_event_belongs_to_the_touch_that_it_follows_most_closely(
        self, events_ms: list[float], found: list[bool], latency_ms: list[int]
    ) -> None:
        for kind in ({}, {"surface": "soft"}):  # the window of the first would reach on
            truth = AIR + touch(400, 420, **kind) + touch(480, **kind)  # type: ignore[arg-type]
            outcome = judge(WALK, truth, *events_ms)
            assert outcome.touches.found.tolist() == found
            assert (outcome.touches.latency_ns // MS).tolist() == latency_ms
            assert outcome.touches.window_ns[0] == 80 * MS
            assert len(outcome.alarms_ns) == 0

    @pytest.mark.parametrize(
        ("until_ms", "events_ms", "late_ms", "alarms_ms"),
        [
            (None, [640], [140], []),
            (640, [640], [-1], [640]),  # the foot is off again
            (None, [640, 700], [140], [700]),  # twice
            (None, [520, 640], [-1], [640]),  # found in time, and again
            (None, [1040], [540], []),  # after the turn
            (620, [980], [-1], [980]),
        ],
    )
    def test_an_event_after_the_window_is_late_and_not_false_while_the_foot_touches(
        self,
        until_ms: float | None,
        events_ms: list[float],
        late_ms: list[int],
        alarms_ms: list[int],
    ) -> None:
        outcome = judge(WALK, AIR + touch(500, until_ms), *events_ms)
        assert outcome.touches.found.tolist() == [520 in events_ms]
        late_ns = outcome.touches.found_late_ns
        assert [int(ns) // MS for ns in late_ns] == late_ms
        assert (outcome.alarms_ns // MS).tolist() == alarms_ms
        summary = summarise([outcome])
        assert summary.rows[ROWS[0]].found_late == (late_ms != [-1])

    @pytest.mark.parametrize("kind", [{"speed": 0.05}, {"surface": "soft"}])
    @pytest.mark.parametrize(("event_ms", "found"), [(900, True), (920, False)])
    def test_slow_and_soft_have_500_ms(
        self, kind: dict[str, float | str], event_ms: float, found: bool
    ) -> None:
        outcome = judge(WALK, AIR + touch(400, **kind), event_ms)  # type: ignore[arg-type]
        assert outcome.touches.found.tolist() == [found]


class TestWhatIsJudged:
    def test_events_in_stance_do_not_count(self) -> None:
        # Of a foot that has touched, and before the first swing.
        outcome = judge(WALK, AIR + touch(700), 100, 720, 1000)
        assert len(outcome.alarms_ns) == 0
        assert outcome.outside_ns.tolist() == [100 * MS, 1000 * MS]

    def test_an_event_belongs_to_the_last_sample_at_its_time(self) -> None:
        outcome = judge(WALK, AIR, 199, 200, 989, 1000)
        assert outcome.outside_ns.tolist() == [199 * MS]
        assert outcome.alarms_ns.tolist() == [200 * MS, 989 * MS, 1000 * MS]
        assert outcome.alarm_after.tolist() == [False, False, True]

    def test_events_while_still_loaded_are_neither(self) -> None:
        loaded = [
            ContactTruth(t_ns=0, contact=True, force=5.0),
            ContactTruth(t_ns=300 * MS, contact=False, force=0.0),
        ]
        outcome = judge(WALK, loaded, 220, 280, 300, 320)
        assert outcome.swings.neutral.tolist() == [2]
        assert outcome.alarms_ns.tolist() == [300 * MS, 320 * MS]
        # Ticks at 200, 220, 240, 260, 280 ms are loaded: 35 of 40 are judged, and 10 after them.
        assert outcome.swings.judged.tolist() == [45]


class TestAfterTheTurn:
    """Stance, its first tick at 1000 ms, where nothing touches."""

    LONG = "." * 10 + "s" * 40 + "." * 30 + "s" * 20

    @pytest.mark.parametrize(("onset_ms", "late"), [(1000, True), (1199, True), (1200, False)])
    def test_touches_in_the_first_10_ticks_are_late(self, onset_ms: float, late: bool) -> None:
        outcome = judge(self.LONG, AIR + touch(onset_ms), onset_ms + 20)
        assert rows(outcome) == (["late"] if late else [])
        assert outcome.touches.found.tolist() == ([True] if late else [])
        assert outcome.touches.after_turn.tolist() == ([True] if late else [])
        assert outcome.unjudged_ns.tolist() == ([] if late else [onset_ms * MS])
        assert len(outcome.alarms_ns) == 0  # the later one is neither

    def test_events_where_nothing_touches_are_false_alarms(self) -> None:
        outcome = judge(self.LONG, AIR, 1000, 1319, 1320, 1599)
        assert outcome.alarms_ns.tolist() == [1000 * MS, 1319 * MS, 1320 * MS, 1599 * MS]
        assert outcome.alarm_swing.tolist() == [0, 0, 0, 0]
        assert outcome.alarm_after.tolist() == [True] * 4
        assert len(outcome.outside_ns) == 0
        assert outcome.swings.judged_after.tolist() == [16, 0]
        assert outcome.swings.errors.tolist() == [4, 0]
        assert [str(kind) for kind in outcome.swings.outcome] == ["false alarm", "clean"]
        summary = summarise([outcome])
        assert (summary.false_alarms, summary.judged_ticks) == (4, 76)
        assert (summary.after.false_alarms, summary.after.judged_ticks) == (4, 16)
        assert summary.after.per_hour == pytest.approx(4 * ROBOT_HOUR_TICKS / 16)
        assert summary.precision == 0.0

    def test_only_the_first_touch_is_judged(self) -> None:
        truth = AIR + touch(1045, 1070) + touch(1150, 1170)
        outcome = judge(self.LONG, truth, 1020, 1060, 1120, 1160, 1200, 1290)
        assert outcome.touches.onset_ns.tolist() == [1045 * MS]
        assert outcome.touches.found.tolist() == [True]
        assert outcome.unjudged_ns.tolist() == [1150 * MS]
        assert outcome.outside_ns.tolist() == [1160 * MS, 1200 * MS]  # they belong to that one
        # Where nothing touches; at 1060 and 1160 ms something did.
        assert outcome.alarms_ns.tolist() == [1020 * MS, 1120 * MS, 1290 * MS]
        assert outcome.swings.judged_after.tolist() == [14, 0]


class TestContacts:
    def test_chatter_is_one_contact(self) -> None:
        truth = AIR + touch(500, 530) + touch(580, 600) + touch(659, 700)
        outcome = judge(WALK, truth, 520, 600)
        assert len(outcome.touches.onset_ns) == 1
        assert outcome.alarms_ns.tolist() == [600 * MS]


class TestRows:
    @pytest.mark.parametrize(
        ("kind", "row"),
        [
            ({"speed": 0.2}, "headline"),
            ({"speed": 1.5}, "headline"),
            ({"speed": 0.199}, "mid"),
            ({"speed": 0.101}, "mid"),
            ({"speed": 0.1}, "slow"),
            ({"speed": 0.02}, "slow"),
            ({"speed": 0.019}, "creep"),
            ({"speed": None}, "unknown"),
            ({"speed": 0.5, "surface": "soft"}, "soft"),
            ({"speed": 0.05, "surface": "soft"}, "soft"),
            ({"speed": 0.5, "grazing": True}, "grazing"),
            ({"speed": 0.5, "surface": "soft", "grazing": True}, "grazing"),
        ],
    )
    def test_a_touch_is_in_one_row(self, kind: dict[str, float | None], row: str) -> None:
        assert rows(judge(WALK, AIR + touch(500, **kind))) == [row]  # type: ignore[arg-type]

    @pytest.mark.parametrize(
        ("onset_ms", "row"), [(930, "headline"), (939.9, "headline"), (940, "late"), (990, "late")]
    )
    def test_fewer_than_3_samples_left_is_late(self, onset_ms: float, row: str) -> None:
        # The swing's last samples are at 940, 960 and 980 ms; one at the onset cannot know of it.
        assert rows(judge(WALK, AIR + touch(onset_ms))) == [row]

    def test_a_truth_without_speed_has_its_row_whenever_its_touches_come(self) -> None:
        truth = [*AIR, *touch(300, 320, speed=None), *touch(700, 720, speed=None)]
        lift = "." * 10 + "l" * 10 + "." * 60
        outcome = judge(TestAfterTheTurn.LONG, truth + touch(990, speed=None), 720, 1000, lift=lift)
        assert rows(outcome) == ["lift", "unknown", "unknown"]
        summary = summarise([outcome])
        assert summary.headline == "unknown"
        assert (summary.counted.touches, summary.in_time.touches) == (2, 1)
        assert (summary.late_in_swing.found, summary.late_after.touches) == (1, 0)
        assert summarise([judge(WALK, AIR + touch(500))]).headline == "headline"
        assert summarise([]).headline == "headline"

    def test_a_touch_in_the_lift_has_its_row(self) -> None:
        lift = "." * 10 + "l" * 20 + "." * 30  # 200 to 580 ms
        assert rows(judge(WALK, AIR + touch(590), lift=lift)) == ["lift"]
        assert rows(judge(WALK, AIR + touch(600), lift=lift)) == ["headline"]

    def test_lift_by_height_ends_within_a_millimetre_of_the_top(self) -> None:
        mask = np.array([letter == "s" for letter in "..sssssss..sss"])
        height = np.array([9, 9, 1, 5, 8, 9.5, 10, 7, 3, 9, 9, 5, 3, 1]) * 1e-3
        swings = find_swings(np.arange(14, dtype=np.int64) * 20 * MS, mask)
        assert np.flatnonzero(lift_by_height(swings, height)).tolist() == [2, 3, 4]
        assert np.flatnonzero(lift_by_halves(swings)).tolist() == [2, 3, 4, 11]

    def test_lift_of_a_stream_without_swings(self) -> None:
        swings = find_swings(np.arange(3, dtype=np.int64), np.zeros(3, dtype=bool))
        assert not lift_by_height(swings, np.zeros(3)).any()
        assert not lift_by_halves(swings).any()


class TestSwings:
    def test_a_hole_in_the_samples_ends_a_swing(self) -> None:
        t_ns = np.array([0, 20, 40, 60, 260, 280, 481, 500], dtype=np.int64) * MS
        swings = find_swings(t_ns, np.ones(8, dtype=bool))
        assert swings.start.tolist() == [0, 6]  # 200 ms are 10 ticks, 201 are more
        assert swings.stop.tolist() == [6, 8]

    def test_outcome_is_the_worst_that_happened(self) -> None:
        phases = "s" * 30 + "." * 5  # 600 ms of swing, 100 ms of stance
        at = 700  # swing k begins at 700 k ms
        truth = [
            *AIR,
            *touch(300, 310),
            *touch(at + 300, at + 310),
            *touch(2 * at + 300, 2 * at + 310),
        ]
        outcome = judge(phases * 4, truth, 320, at + 100, at + 320, 2 * at + 100)
        assert outcome.swings.outcome.tolist() == ["hit", "false alarm", "false alarm", "clean"]
        assert outcome.swings.errors.tolist() == [0, 1, 2, 0]
        assert judge(phases, truth).swings.outcome.tolist() == ["miss"]


class TestFigures:
    def test_counts_rates_and_intervals(self) -> None:
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
        assert summary.per_hour_interval == pytest.approx(
            (0.2422 / hours, 7.2247 / hours), rel=1e-4
        )
        assert row.latency is not None
        assert row.latency.median_ms == 20.0
        assert summary.lost_swings == 6  # four misses, two false alarms

    def test_latency_quantiles(self) -> None:
        phases = "s" * 30 + "." * 5
        truth = AIR + [c for k in range(100) for c in touch(700 * k + 300 - k / 10, 700 * k + 310)]
        outcome = judge(phases * 100, truth, *[700 * k + 300 + 20 for k in range(100)])
        latency = summarise([outcome]).rows[ROWS[0]].latency
        assert latency is not None
        assert latency.median_ms == pytest.approx(24.95)
        assert latency.p95_ms == pytest.approx(29.405)
        assert latency.p99_ms == pytest.approx(29.801)

    def test_counted_leaves_out_what_may_be_beyond_any_detector(self) -> None:
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
        assert {
            row.value: figures.touches for row, figures in summary.rows.items()
        } == dict.fromkeys(
            ["headline", "mid", "slow", "soft", "unknown", "creep", "grazing", "late"], 1
        )
        assert summary.counted.touches == 6
        assert summary.in_time.touches == 5
        assert summary.late_in_swing.touches == 1
        assert summary.lost_swings == 6
        assert outcome.swings.touches.tolist() == [1, 1, 1, 1, 1, 0, 0, 1]

    def test_nothing_to_judge(self) -> None:
        summary = summarise([judge("....", AIR)])
        assert summary.rows[ROWS[0]].recall is None
        assert summary.rows[ROWS[0]].interval == (0.0, 1.0)
        assert summary.precision is None
        assert summary.per_hour is None
        assert math.isinf(summary.per_hour_interval.high)
        assert summarise([]).swings == 0
