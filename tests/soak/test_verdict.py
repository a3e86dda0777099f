"""The soak's own arithmetic: a verdict that cannot be wrong by accident."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")

from adaptive_contact.score import Events

from . import sections, verdict
from .arrival import Arrivals
from .made import ROBOT
from .memory import Grown
from .plan import SoakPlan


def section(after: str = "begin", touches: int = 500, **fields: int) -> sections.Section:
    counts = dict.fromkeys(
        ("missed", "others", "others_missed", "false_alarms", "releases", "wrong_releases"), 0
    )
    counts |= {"ticks": 10_000, **fields}
    return sections.Section(after=after, ramp=after == "ramp", touches=touches, **counts)


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
    others=300,
    others_missed=9,
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
    late_anyway=[[], [], []],
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
    return verdict.failures_of(dataclasses.replace(SOUND, **changes), ROBOT, PLAN)


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
        (
            {"recovery_s": [], "late_legs": [], "late_anyway": []},
            "0 faults came about, of 3 planned",
        ),
        (
            {"recovery_s": [0.6, math.inf, 0.5], "late_legs": [[], ["rf"], []]},
            "a fault took inf s to recover from: rf",
        ),
        (
            {
                "recovery_s": [0.6, 2.7, 0.5],
                "late_legs": [[], ["rf", "rm"], []],
                "late_anyway": [[], ["rf"], []],
            },
            "a fault took 2.70 s to recover from: rm",
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
        late_anyway=[],
        memory_mb=[],
        worker_mb=[],
        refits={},
        events=0,
        state={"saved": 0, "failed": 500, "restored": list(ROBOT.leg_ids)},
    )
    assert len(blind) >= 6


def test_the_release_that_every_service_owes_at_its_start_is_none_of_the_legs() -> None:
    times = np.array([7, 9, 12], dtype=np.int64)
    events = Events(times, np.array([False, True, False]), times)
    kept = verdict.heard_of(events, first_ns=7)
    assert kept.t_ns.tolist() == [9, 12]
    assert kept.contact.tolist() == [True, False]
