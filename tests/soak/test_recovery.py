"""When a leg was right again after a fault, and how late its events were."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from adaptive_contact.score import LegOutcome
from adaptive_contact.score.contacts import truth_changes
from adaptive_contact.score.outcome import SwingTable, TouchTable
from adaptive_contact.wire import ContactEvent

pytest.importorskip("mujoco")

from .arrival import Arrivals, SourceClock, judge_arrivals
from .conduct import Broken, Heard
from .made import S, event, take
from .recovery import recovery_of, right_events


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
        after_turn=none > 0.0,
        late=none > 0.0,
        found_late_ns=count - 1,
    )
    start = onset - S // 2
    swings = SwingTable(start, onset, *([count + 10] * 2), *([count] * 7))
    empty = np.zeros(0, dtype=np.int64)
    return LegOutcome("rf", swings, touches, *([empty] * 5), (0, 100 * S))


NO_TRUTH = truth_changes([])


def recovery(events: list[ContactEvent], one: LegOutcome) -> tuple[float, list[str]]:
    told = take(Heard(events=[(e.t_ns + S // 100, e) for e in events]))
    right = right_events(told, [one], {"rf": NO_TRUTH})
    fault = Broken("router", 8 * S, 10 * S)
    return recovery_of(fault, ("rf",), right, [one], SourceClock({}))


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
