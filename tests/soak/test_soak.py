"""The soak's own arithmetic: a verdict that cannot be wrong by accident."""

from __future__ import annotations

import dataclasses
import math
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
from adaptive_contact.score import LegOutcome
from adaptive_contact.score.contacts import truth_changes
from adaptive_contact.score.outcome import SwingTable, TouchTable
from adaptive_contact.wire import ContactEvent, LearnerStatus

pytest.importorskip("mujoco")

from adaptive_contact_sim.drift_spec import parse_drift
from adaptive_contact_sim.soak import sections, verdict
from adaptive_contact_sim.soak.conduct import (
    Broken,
    Heard,
    Resident,
    Take,
    _children,
    _resident_mb,
)
from adaptive_contact_sim.soak.plan import Drifting, SoakPlan

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
    assert verdict._uncounted("rf", SENT, take(whole)) == 0
    # A crash: ticks go back to the last save, what came since counts as missed.
    crashed = heard(status(100, 100, 0), status(200, 150, 50), status(0, 120, 0))
    assert verdict._uncounted("rf", SENT, take(crashed)) == 0


def test_a_loss_that_nobody_counted_is_found() -> None:
    lost = heard(status(10, 10, 0), status(60, 55, 2), status(100, 97, 3))
    assert verdict._uncounted("rf", SENT, take(lost)) == 3
    twice = heard(status(10, 10, 0), status(60, 60, 5))
    assert verdict._uncounted("rf", SENT, take(twice)) == 5


def test_events_must_rest_on_samples_and_come_once() -> None:
    good = Heard(events=[(0, event(10)), (1, event(30))])
    assert verdict._inconsistent(take(good), {"rf": SENT}) == 0
    bad = [event(10), event(10), event(11, t_ns=5), event(12, onset_ns=S), event(5000)]
    wrong = Heard(events=[(n, one) for n, one in enumerate(bad)])
    assert verdict._inconsistent(take(wrong), {"rf": SENT}) == 4


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
    counts = {"ticks": 10_000, "missed": 0, "false_alarms": 0, **fields}
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
    sections=[section(), section("ramp", 300, missed=9, false_alarms=3), section("router", 40)],
    samples=540_000,
    missed_samples=1500,
    uncounted=0,
    rejects={},
    outage_s=[1.2, 1.9, 1.2],
    recovery_s=[0.6, 0.1, 0.5],
    late_legs=[[], [], []],
    memory_mb=[(1.0, 130.0), (1.0, 130.0)],
    worker_mb=[(1.0, 130.0)],
    refits={"promoted": 3, "refused": 200, "rolled_back": 0},
    events=12_000,
    events_lost=0,
    state={"saved": 500, "failed": 0, "restored": list(ROBOT.leg_ids)},
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
        ({"memory_mb": [(1.0, 1.0)]}, "memory is known of 1 lives of the service, of 2"),
        ({"memory_mb": [(1.0, 1.0), (5.1, 9.0)]}, "life 2: the service grew by 5.1 MB"),
        ({"worker_mb": []}, "memory of the service's child processes is not known"),
        ({"worker_mb": [(6.0, 9.0)]}, "life 1: its children grew by 6.0 MB"),
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
    return verdict._recovery(Broken("router", 8 * S, 10 * S), ("rf",), right, [one])


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
    flat, growing = verdict._memory(tuple(rows), 60.0, lambda one: one.mb)
    assert flat[0] == 0.0
    assert 6.0 < growing[0] < 9.0


def test_a_child_process_warms_up_from_its_own_start_and_counts() -> None:
    rows = [
        Resident(0, float(s), 100.0, 0.0 if s < 300 else 50.0 + (s - 300) / 10)
        for s in range(0, 600, 2)
    ]
    (growth, last), *more = verdict._memory(tuple(rows), 60.0, lambda one: one.workers_mb)
    assert not more
    assert 15.0 < growth < 25.0
    assert last == pytest.approx(79.8)
    assert verdict._memory((), 60.0, lambda one: one.workers_mb) == []


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
