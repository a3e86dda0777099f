"""The soak's own arithmetic: a verdict that cannot be wrong by accident."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import shipped_robot
from adaptive_contact.score import LegOutcome, LegStream
from adaptive_contact.score.contacts import truth_changes
from adaptive_contact.score.outcome import Events, SwingTable, TouchTable
from adaptive_contact.service.state.keeper import StateFacts
from adaptive_contact.service.status import ServiceStatus
from adaptive_contact.wire import ContactEvent, ContactTruth, LearnerStatus

pytest.importorskip("mujoco")

from adaptive_contact_sim.demo.child import Child
from adaptive_contact_sim.drift_spec import parse_drift
from adaptive_contact_sim.soak import accounts, sections, verdict
from adaptive_contact_sim.soak.arrival import Arrivals, SourceClock, judge_arrivals
from adaptive_contact_sim.soak.conduct import (
    Broken,
    Heard,
    Take,
    _born,
    _children,
    _crash,
    _resident_mb,
)
from adaptive_contact_sim.soak.memory import Grown, Resident, curves_of, grown, slope_of
from adaptive_contact_sim.soak.plan import Drifting, SoakPlan
from adaptive_contact_sim.soak.releases import judge_releases

S = 1_000_000_000
SENT = {seq * 20_000_000: seq for seq in range(1, 1001)}


def status(seq: int, ticks: int, missed: int, **fields: object) -> LearnerStatus:
    return LearnerStatus(
        leg="rf",
        t_ns=seq * 20_000_000,
        status=fields.get("word", "valid"),  # type: ignore[arg-type]
        model_version=1,
        residual_rms=[],
        noise_floor=[],
        ticks=ticks,
        missed=missed,
    )


def event(seq: int, *, t_ns: int | None = None, onset_ns: int = 0) -> ContactEvent:
    return ContactEvent(
        leg="rf",
        t_ns=seq * 20_000_000 if t_ns is None else t_ns,
        seq=seq,
        onset_ns=onset_ns,
        contact=True,
        status="valid",
        score=2.0,
        residual=[],
        model_version=1,
    )


def take(heard: Heard, broken: tuple[Broken, ...] = ()) -> Take:
    return Take(Path("none"), heard, broken, (), "")


def heard(*statuses: LearnerStatus) -> Heard:
    return Heard(statuses=[(at, one) for at, one in enumerate(statuses)])


def test_every_sample_is_accounted_for() -> None:
    whole = heard(status(10, 4, 0), status(60, 50, 4), status(200, 94, 100))
    assert accounts.uncounted("rf", SENT, take(whole)) == 0
    # A crash: ticks go back to the last save, what came since counts as missed.
    crashed = heard(status(100, 100, 0), status(200, 150, 50), status(0, 120, 0))
    assert accounts.uncounted("rf", SENT, take(crashed)) == 0


def test_a_loss_that_nobody_counted_is_found() -> None:
    lost = heard(status(10, 10, 0), status(60, 55, 2), status(100, 97, 3))
    assert accounts.uncounted("rf", SENT, take(lost)) == 3
    twice = heard(status(10, 10, 0), status(60, 60, 5))
    assert accounts.uncounted("rf", SENT, take(twice)) == 5


def test_events_must_rest_on_samples_and_come_once() -> None:
    good = Heard(events=[(0, event(10)), (1, event(30))])
    assert accounts.inconsistent(take(good), {"rf": SENT}) == 0
    bad = [event(10), event(10), event(11, t_ns=5), event(12, onset_ns=S), event(5000)]
    wrong = Heard(events=[(n, one) for n, one in enumerate(bad)])
    assert accounts.inconsistent(take(wrong), {"rf": SENT}) == 4


def test_windows_last_two_seconds_and_what_lies_between_is_a_section() -> None:
    drifts = [Drifting("mass:a", 20.0, 0.0), Drifting("supply:b", 40.0, 10.0)]
    windows = sections.windows_of([("router", 5 * S, 7 * S)], drifts, epoch_ns=0)
    assert [(w.begin_ns / S, w.end_ns / S) for w in windows] == [(5, 9), (20, 22), (40, 42)]
    spans = sections.spans_between(windows, 0, 100 * S)
    assert [(s.begin_ns / S, s.end_ns / S, s.after, s.ramp) for s in spans] == [
        (0, 5, "begin", False),
        (9, 20, "router restarted", False),
        (22, 40, "mass:a@20s", False),
        (42, 52, "supply:b@40s", True),
        (52, 100, "supply:b@40s", False),
    ]
    # A fault in the midst of a ramp does not end it.
    both = sections.windows_of([("service", 44 * S, 45 * S)], drifts, epoch_ns=0)
    spans = sections.spans_between(both, 0, 100 * S)
    assert [(s.begin_ns / S, s.end_ns / S, s.ramp) for s in spans][-3:] == [
        (42, 44, True),
        (47, 52, True),
        (52, 100, False),
    ]


def section(after: str = "begin", touches: int = 500, **fields: int) -> sections.Section:
    counts = dict.fromkeys(("missed", "false_alarms", "releases", "wrong_releases"), 0)
    counts |= {"ticks": 10_000, **fields}
    return sections.Section(after=after, ramp=after == "ramp", touches=touches, **counts)


ROBOT = shipped_robot()
PLAN = SoakPlan(minutes=30.0)
SOUND = verdict.Verdict(
    minutes=30.0,
    judged_ticks=170_000,
    inconsistent=0,
    false_alarms=0,
    alarms=[],
    touches=6000,
    missed_touches=12,
    misses=[],
    releases=6000,
    wrong_releases=0,
    wrong_released=[],
    arrivals=Arrivals(12_000, 12, 0.02, 0.4),
    source_behind_s=0.3,
    sections=[section(), section("ramp", 300, missed=9, false_alarms=3), section("router", 40)],
    samples=540_000,
    missed_samples=1500,
    uncounted=0,
    rejects={},
    outage_s=[1.2, 1.9, 1.2],
    recovery_s=[0.6, 0.1, 0.5],
    late_legs=[[], [], []],
    memory_mb=[Grown(1.0, 130.0, 0.1), Grown(1.0, 130.0, None)],
    worker_mb=[Grown(1.0, 130.0, 0.0)],
    memory_curve=[],
    left_behind=0,
    forgotten_s=[9.0],
    refits={"promoted": 3, "refused": 200, "rolled_back": 0},
    events=12_000,
    events_lost=0,
    cut_off=0,
    state={"saved": 500, "failed": 0, "restored": list(ROBOT.leg_ids), "refused": []},
    p99_ms=1.0,
    failures=[],
)


def failures(**changes: Any) -> list[str]:
    return verdict._failures(dataclasses.replace(SOUND, **changes), ROBOT, PLAN)


def test_a_sound_soak_passes() -> None:
    assert failures() == []


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"missed_touches": 6000}, "6000 of 6000 touches missed"),
        ({"missed_touches": 61}, "61 of 6000 touches missed"),
        ({"touches": 0, "missed_touches": 0}, "not one touch was judged"),
        ({"false_alarms": 1}, "1 false alarms outside the windows"),
        ({"sections": [section("router", 100, missed=3)]}, "3 of 100 touches missed after router"),
        ({"sections": [section("mass", 500, missed=6)]}, "6 of 500 touches missed after mass"),
        ({"sections": [section("ramp", 100, missed=6)]}, "6 of 100 touches missed during ramp"),
        (
            {"sections": [section("ramp", 100, false_alarms=6)]},
            "6 false alarms to 100 touches during ramp",
        ),
        ({"refits": {}}, "no refit came to an end, be it promoted or refused"),
        ({"refits": {"rolled_back": 1}}, "no refit came to an end, be it promoted or refused"),
        ({"state": {**SOUND.state, "failed": 2}}, "2 states could not be saved"),
        ({"state": {**SOUND.state, "saved": 0}}, "no state was saved"),
        ({"state": {**SOUND.state, "restored": ["rf"]}}, "not every leg was restored"),
        ({"memory_mb": []}, "memory is known of 0 lives of the service, of 2"),
        ({"memory_mb": [Grown(1.0, 1.0, 0.0)]}, "memory is known of 1 lives of the service, of 2"),
        (
            {"memory_mb": [Grown(1.0, 1.0, 0.0), Grown(5.1, 9.0, 0.0)]},
            "life 2: the service grew by 5.1 MB",
        ),
        (
            {"memory_mb": [Grown(1.0, 1.0, 0.17), Grown(1.0, 9.0, 0.0)]},
            "life 1: the service still grew by 0.17 MB/min at the end",
        ),
        ({"worker_mb": [Grown(1.0, 9.0, 0.2)]}, "life 1: its children still grew by 0.20 MB/min"),
        ({"left_behind": 1}, "1 child processes outlived the service"),
        ({"worker_mb": []}, "memory of the service's child processes is not known"),
        ({"worker_mb": [Grown(6.0, 9.0, None)]}, "life 1: its children grew by 6.0 MB"),
        ({"wrong_releases": 1}, "1 releases of loaded legs outside the windows"),
        (
            {"sections": [section("ramp", 100, wrong_releases=6)]},
            "6 releases of loaded legs to 100 touches during ramp",
        ),
        (
            {"arrivals": Arrivals(12_000, 13, 0.3, 4.0)},
            "13 of 12000 events came more than 0.25 s late",
        ),
        ({"arrivals": Arrivals(300, 3, 0.3, 4.0)}, "3 of 300 events came more than 0.25 s late"),
        ({"arrivals": Arrivals(0, 0, None, None)}, "not one event was timed"),
        ({"cut_off": 1}, "1 times a subscriber was cut off without a fault"),
        ({"refits": {"promoted": 0, "refused": 300}}, "no refit was promoted in 30 minutes"),
        ({"forgotten_s": [12.1]}, "a kill of the service cost 12.1 s of what it had learned"),
        ({"state": {**SOUND.state, "refused": ["rf: torn"]}}, "a state was refused: rf: torn"),
        ({"recovery_s": [], "late_legs": []}, "0 faults came about, of 3 planned"),
        (
            {"recovery_s": [0.6, math.inf, 0.5], "late_legs": [[], ["rf"], []]},
            "a fault took inf s to recover from: rf",
        ),
        ({"events_lost": 1}, "1 events lost"),
        ({"uncounted": 1}, "1 samples lost without being counted"),
        ({"inconsistent": 1}, "1 events that no sample bears out"),
    ],
)
def test_what_is_not_well_fails(changes: dict[str, Any], line: str) -> None:
    found = failures(**changes)
    assert any(one.startswith(line) for one in found), found


def test_a_blind_detector_fails_in_every_way() -> None:
    """As the auditor had it: it passed."""
    blind = failures(
        judged_ticks=0,
        missed_touches=6000,
        sections=[],
        recovery_s=[],
        late_legs=[],
        memory_mb=[],
        worker_mb=[],
        refits={},
        events=0,
        state={"saved": 0, "failed": 500, "restored": list(ROBOT.leg_ids)},
    )
    assert len(blind) >= 6


def outcome(onsets_s: list[float], found: list[bool]) -> LegOutcome:
    """Touches of swings that begin half a second before each, found 20 ms after it."""
    onset = np.array([int(at * S) for at in onsets_s], dtype=np.int64)
    hit = np.array(found)
    none = np.zeros(len(onset))
    count = np.zeros(len(onset), dtype=np.int64)
    touches = TouchTable(
        onset_ns=onset,
        swing=np.arange(len(onset)),
        row=count,
        window_ns=np.full(len(onset), 120_000_000),
        found=hit,
        latency_ns=np.where(hit, 20_000_000, -1),
        onset_error_ns=count,
        speed_m_s=none,
        force_n=none,
    )
    start = onset - S // 2
    swings = SwingTable(start, onset, *([count + 10] * 2), *([count] * 5))
    empty = np.zeros(0, dtype=np.int64)
    return LegOutcome("rf", swings, touches, empty, empty, empty, empty, (0, 100 * S))


NO_TRUTH = truth_changes([])


def recovery(events: list[ContactEvent], one: LegOutcome) -> tuple[float, list[str]]:
    told = take(Heard(events=[(e.t_ns + S // 100, e) for e in events]))
    right = verdict._right_events(told, [one], {"rf": NO_TRUTH})
    fault = Broken("router", 8 * S, 10 * S)
    return verdict._recovery(fault, ("rf",), right, [one], SourceClock({}))


def test_recovery_is_the_first_right_event() -> None:
    one = outcome([9.9, 11.5, 12.9], [True, True, True])
    right = [event(0, t_ns=int(at * S)) for at in (9.92, 11.52, 12.92)]
    assert recovery(right, one) == (pytest.approx(1.53), [])
    # A contact that is none is no recovery, nor is the release that a restart leaves.
    wrong = event(0, t_ns=int(10.5 * S))
    cut = msgspec.structs.replace(wrong, contact=False, score=0.0)
    assert recovery([wrong, cut, *right], one) == (pytest.approx(1.53), [])
    release = msgspec.structs.replace(cut, score=1.0)
    assert recovery([wrong, release, *right], one) == (pytest.approx(0.51), [])


def test_who_is_never_right_again_is_late_for_ever() -> None:
    blind = outcome([11.5, 12.9], [False, False])
    assert recovery([], blind) == (math.inf, ["rf"])
    slow = outcome([10.6, 12.9], [False, True])
    assert recovery([event(0, t_ns=int(12.92 * S))], slow) == (pytest.approx(2.93), ["rf"])
    # It had no whole swing with a touch before that one, so nothing to tell.
    idle = outcome([10.3, 12.9], [False, True])
    assert recovery([event(0, t_ns=int(12.92 * S))], idle) == (pytest.approx(2.93), [])


def test_memory_is_judged_per_life_after_the_warm_up() -> None:
    rows = [Resident(0, float(s), 100.0 + (20.0 if s > 60 else s / 3)) for s in range(0, 600, 2)]
    rows += [Resident(1, float(s), 100.0 + s / 60) for s in range(0, 600, 2)]
    rows.append(Resident(1, 601.0, float("nan")))
    flat, growing = grown(rows, 60.0, lambda one: one.mb)
    assert flat.growth_mb == 0.0
    assert 6.0 < growing.growth_mb < 9.0


def test_a_child_process_warms_up_from_its_own_start_and_counts() -> None:
    rows = [
        Resident(0, float(s), 100.0, 0.0 if s < 300 else 50.0 + (s - 300) / 10)
        for s in range(0, 600, 2)
    ]
    (growth, last, _), *more = grown(rows, 60.0, lambda one: one.workers_mb)
    assert not more
    assert 15.0 < growth < 25.0
    assert last == pytest.approx(79.8)
    assert grown((), 60.0, lambda one: one.workers_mb) == []


def life(mb: Any, until_s: int = 900) -> list[Resident]:
    """A life whose memory is a function of its age."""
    return [Resident(0, float(at), float(mb(at))) for at in range(0, until_s, 2)]


def test_a_plateau_has_no_slope_and_a_leak_has() -> None:
    rng = np.random.default_rng(4)

    def slope(mb: Any, until_s: int = 900) -> float | None:
        return grown(life(mb, until_s), 180.0, lambda one: one.mb)[0].slope_mb_min

    limit = verdict.SLOPE_MB_MIN
    filling = slope(lambda at: 130.0 - 4.0 * math.exp(-at / 120) + 0.05 * rng.normal())
    assert filling is not None
    assert abs(filling) < 0.3 * limit
    # A buffer that doubles, as measured (+1.3 MB at once), is no leak wherever it falls.
    for step_s in (460, 600, 675, 750, 890):
        step = slope(lambda at, step_s=step_s: 130.0 + 1.3 * (at >= step_s))
        assert step is not None
        assert step < limit
    leak = slope(lambda at: 130.0 + 0.25 * at / 60 + 0.05 * rng.normal())
    assert leak == pytest.approx(0.25, abs=0.02)
    # All of it is within the 5 MB that growth alone may have.
    assert grown(life(lambda at: 130.0 + 0.25 * at / 60), 180.0, lambda o: o.mb)[0].growth_mb < 5
    stairs = slope(lambda at: 130.0 + 0.5 * (at // 120))
    assert stairs is not None
    assert stairs > limit
    assert slope(lambda at: 130.0 + at, until_s=590) is None, "too short to tell"
    assert slope_of([]) is None


def test_a_day_has_a_slope_too() -> None:
    rows = [(float(at), 100.0 + at / 6000) for at in range(0, 43_200, 2)]
    assert slope_of(rows) == pytest.approx(0.01)


def test_the_curve_of_each_life_has_a_point_every_ten_seconds() -> None:
    rows = life(lambda at: 100.0 + at, 40)
    rows += [Resident(1, float(at), 50.0, 30.0) for at in range(0, 20, 2)]
    rows.append(Resident(1, 21.0, float("nan")))
    first, second = curves_of(rows)
    assert [point.after_s for point in first] == [4, 14, 24, 34]
    assert [point.mb for point in first] == [104, 114, 124, 134]
    assert [point.workers_mb for point in second[:2]] == [30, 30]
    assert math.isnan(second[2].mb)
    assert msgspec.json.encode(second[2]).startswith(b"[21.0,null")
    assert curves_of([]) == []


TRUE_S = [(1.0, True), (2.0, False), (3.0, True), (4.0, False)]


def releases(*told_s: tuple[float, float]) -> list[bool]:
    """Releases at (onset, deciding sample) of a leg that touches from 1 to 2 and from 3 to 4 s."""
    truth = truth_changes(
        [ContactTruth(t_ns=int(at * S), contact=on, force=9.0 * on) for at, on in TRUE_S]
    )
    t_ns = np.arange(0, 5 * S, S // 50)
    stream = LegStream("rf", t_ns, np.zeros(len(t_ns), dtype=bool), truth)
    at = [(int(t * S), on, int(onset * S)) for onset, t in told_s for on in (True, False)]
    columns = [np.array(column) for column in zip(*at, strict=True)]
    return judge_releases(stream, Events(*columns)).wrong.tolist()


def test_a_release_of_a_leg_that_stands_loaded_is_wrong() -> None:
    assert releases((1.2, 1.24)) == [True]
    assert releases((1.5, 1.5), (3.7, 3.74), (2.5, 2.6)) == [True, True, False]


def test_a_release_just_before_the_leg_comes_off_is_right() -> None:
    assert releases((1.72, 1.78), (1.95, 2.0), (2.02, 2.3)) == [False, False, False]


def test_a_leg_that_was_free_at_the_onset_was_released_truly() -> None:
    assert releases((2.98, 3.04), (0.9, 1.1)) == [False, False]
    assert releases((0.1, 0.2)) == [False], "nothing has touched yet"


def test_wrong_releases_are_counted_where_they_fall() -> None:
    found = judge_releases(
        LegStream(
            "rf",
            np.arange(0, 9 * S, S),
            np.ones(9, dtype=bool),
            truth_changes([ContactTruth(t_ns=S, contact=True, force=9.0)]),
        ),
        Events(np.array([2 * S, 5 * S]), np.zeros(2, dtype=bool), np.array([2 * S, 5 * S])),
    )
    spans = [
        sections.Span(0, 3 * S, "begin", ramp=False),
        sections.Span(4 * S, 6 * S, "ramp", ramp=True),
    ]
    rows = sections.judge_sections([], [found], spans)
    assert [(one.releases, one.wrong_releases) for one in rows] == [(1, 1), (1, 1)]


def test_an_event_is_late_against_the_samples_of_its_second() -> None:
    # The source's clock is 0.7 s behind the wall; at 6 s it let 0.6 s go.
    clock = SourceClock({second: S * 7 // 10 + (second >= 6) * S * 6 // 10 for second in range(10)})
    assert clock.behind_s == pytest.approx(0.6)
    assert clock.of_wall(3 * S) == 2_300_000_000
    on_time = [(int((t + 0.72) * S), int(t * S)) for t in (1.0, 2.0)]
    after = [(int((t + 1.32) * S), int(t * S)) for t in (7.0, 8.0)]
    late = (int((3.0 + 0.7 + 2.0) * S), 3 * S)
    found = judge_arrivals([*on_time, late, *after], clock, [])
    assert (found.events, found.late) == (5, 1)
    assert found.slowest_s == pytest.approx(2.0)
    assert judge_arrivals([late], clock, [(2 * S, 4 * S)]) == Arrivals(0, 0, None, None)
    assert SourceClock({}).of_wall(5) == 5


def service(instance: str, *, cut_off: int = 0, **state: Any) -> ServiceStatus:
    facts = {"restored": [], "refused": [], "saved": 0, "failed": 0, "error": None, **state}
    return ServiceStatus(
        version="0",
        robot="r",
        period_s=0.02,
        baseline=None,
        legs={},
        uptime_s=1.0,
        instance=instance,
        cut_off=cut_off,
        state=StateFacts(folder="f", **facts),
    )


def test_a_subscriber_cut_off_counts_unless_a_fault_did_it() -> None:
    broken = (Broken("router", 10 * S, 12 * S),)

    def counted(*told: tuple[int, int]) -> int:
        services = [(at * S, service("a", cut_off=count)) for at, count in told]
        return accounts.cut_off(take(Heard(services=services), broken))

    assert counted((1, 0), (2, 0), (9, 0)) == 0
    assert counted((9, 0), (13, 1), (14, 1), (20, 1)) == 0
    assert counted((1, 0), (2, 1), (9, 1), (13, 1)) == 1
    assert counted((15, 0), (16, 2)) == 2
    assert counted((1, 1)) == 1


def test_state_is_counted_over_all_lives() -> None:
    """A life that was killed cannot hide what it failed to save."""
    lives = accounts.last_words(
        [
            service("a", saved=3),
            service("a", saved=5, failed=1),
            service("b", saved=2, restored=["rf"], refused=["lf: torn"]),
        ]
    )
    assert accounts.state_of(lives) == {
        "saved": 7,
        "failed": 1,
        "restored": ["rf"],
        "refused": ["lf: torn"],
    }
    assert accounts.state_of([]) == {}


def test_what_a_kill_cost_is_told_from_the_counts() -> None:
    kill = Broken("service", 500 * S, 501 * S)

    def cost(*told: tuple[int, LearnerStatus]) -> float:
        statuses = [(at * S, one) for at, one in told]
        return accounts.forgotten_s("rf", SENT, take(Heard(statuses=statuses)), kill, ROBOT)

    before, silent = (499, status(600, 600, 0)), (502, status(0, 300, 0))
    assert cost(before, silent, (503, status(700, 320, 380))) == pytest.approx(5.6)
    assert cost(before, (503, status(700, 640, 60))) < 0.0
    assert cost(before) == math.inf
    # None of it is uncounted.
    whole = heard(before[1], status(700, 320, 380))
    assert accounts.uncounted("rf", SENT, take(whole)) == 0


@pytest.mark.e2e
def test_a_service_is_killed_as_by_a_crash(tmp_path: Path) -> None:
    """It used to be asked to end, and saved everything before it did."""
    listen = ("--listen", "tcp/127.0.0.1:0", "--state", str(tmp_path), "--log-level", "warning")
    with Child("the service", ("serve", *listen)) as child:
        assert _born(child.pid)
        _crash(child)
        assert not child.running
        assert "exit code -9" in str(child.failure())
        assert _born(child.pid) == ""


def test_a_process_is_told_from_a_later_one_of_its_id() -> None:
    assert _born(os.getpid()).isdigit()
    assert _born(2**22 + 1) == "", "beyond any id"


def test_children_of_a_process_are_found() -> None:
    code = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'])"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        until = time.monotonic() + 20
        while not (found := _children(process.pid)):
            assert time.monotonic() < until
            time.sleep(0.01)
        assert all(_resident_mb(pid) > 0.1 for pid in found)
        process.communicate(b"\n", timeout=20)


def test_the_plan_is_one_that_the_simulator_takes() -> None:
    for minutes in (1.0, 30.0, 600.0):
        plan = SoakPlan(minutes=minutes)
        kinds = [fault.kind for fault in plan.faults]
        assert sorted(kinds) == ["router", "router", "service"]
        for drift in plan.drifts:
            assert parse_drift(drift.option).at_s == pytest.approx(drift.at_s)
            assert drift.at_s + drift.duration_s < plan.seconds
    with pytest.raises(ConfigurationError, match="expected 1 to 1440 min"):
        SoakPlan(minutes=0.5)
