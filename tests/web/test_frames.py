"""Frames and the table: times of all clocks on one; of the wire nothing but numbers and text."""

from __future__ import annotations

import json
import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.service.watch import LegView, Verdict, View
from adaptive_contact.status import LegFacts, ServiceStatus
from adaptive_contact.web.frames import Frames, Table
from adaptive_contact.wire import ContactEvent, ContactTruth, LearnerStatus, LegTrace

S = 1_000_000_000
TICK = 20_000_000


def trace(leg: str, first_ns: int, count: int = 5, **fields: Any) -> LegTrace:
    given_: dict[str, Any] = {
        "t_ns": [first_ns + i * TICK for i in range(count)],
        "seq": list(range(count)),
        "swing": [True] * count,
        "measured": [[0.1, 0.2]] * count,
        "desired": [[0.3, 0.4]] * count,
        "predicted": [[0.1001, 0.2]] * count,
        "test_ratio": [0.25] * count,
        "p": [0.875] * count,
        **fields,
    }
    return LegTrace(leg=leg, number=given_.pop("number", 7), **given_)


def event(leg: str, t_ns: int, **fields: Any) -> ContactEvent:
    given_: dict[str, Any] = {"onset_ns": t_ns - TICK, "contact": True, "score": 2.5, **fields}
    return ContactEvent(
        leg=leg, t_ns=t_ns, seq=1, status="valid", residual=[0.0, 0.0], model_version=1, **given_
    )


def frame(frames: Frames, now_ns: int) -> dict[str, Any]:
    return json.loads(frames.frame(now_ns))


def test_a_tick_has_time_swing_ratio_and_angles() -> None:
    frames = Frames(start_ns=100 * S)
    frames.trace(trace("rf", 5000 * S, 1), 101 * S)
    found = frame(frames, 101 * S)
    assert found["t"] == 1000
    assert found["k"] == {"rf": [[1000, 1, 25, 88, 3000, 4000, 1000, 2000, 1001, 2000]]}
    assert frame(frames, 101 * S + 1) == {"t": 1000}, "each comes once"


def test_an_outline_is_seen_from_above_and_comes_once() -> None:
    frames = Frames(0)
    frames.trace(trace("rf", 0, 1, places_m=[[0.1, -0.05, 0.0], [0.2, -0.15, 0.03]]), S)
    frames.trace(trace("lf", 0, 1), S)
    assert frame(frames, S)["f"] == {"rf": [100, -50, 200, -150]}
    assert "f" not in frame(frames, S + 1)


def test_a_tick_that_was_not_judged_has_no_prediction() -> None:
    frames = Frames(0)
    frames.trace(trace("rf", 0, 1, predicted=[None], test_ratio=[None], swing=[None], p=[]), S)
    assert frame(frames, S)["k"]["rf"] == [[1000, -1, None, None, 3000, 4000, 1000, 2000]]


def test_events_and_truth_are_placed_by_the_clock_of_their_leg() -> None:
    frames = Frames(0)
    frames.contact("rf", event("rf", 50 * S))
    assert frame(frames, 1 * S).keys() == {"t"}, "nobody knows their clock yet"
    frames.contact("rf", event("rf", 50 * S))
    frames.contact("rf", ContactTruth(t_ns=50 * S - TICK, contact=True, force=3.0))
    frames.trace(trace("rf", 50 * S, 1), 2 * S)
    frames.verdicts([("rf", Verdict("missed", 50 * S)), ("lf", Verdict("false", 50 * S))])
    found = frame(frames, 2 * S)
    assert found["e"] == [["rf", 2000, 1980, 1, 250, 0]]
    assert found["g"] == [["rf", 1980, 1]]
    assert found["v"] == [["rf", "missed", 2000]]


def test_a_clock_that_jumps_is_followed_and_time_never_runs_back() -> None:
    frames = Frames(0)
    frames.trace(trace("rf", 1000 * S), 10 * S)
    frames.trace(trace("rf", 5 * S), 11 * S)  # the source has begun again
    frames.trace(trace("rf", 5 * S), 11 * S)  # and a tick that comes twice is dropped
    times = [tick[0] for tick in frame(frames, 11 * S)["k"]["rf"]]
    assert times == [9920, 9940, 9960, 9980, 10000, 10920, 10940, 10960, 10980, 11000]


@given(
    t_ns=st.lists(st.integers(-(2**63), 2**63 - 1), max_size=4),
    measured=st.lists(st.lists(st.floats(), max_size=4), max_size=4),
    desired=st.lists(st.lists(st.floats(), max_size=4), max_size=4),
    predicted=st.lists(st.none() | st.lists(st.floats(), max_size=4), max_size=4),
    ratio=st.lists(st.none() | st.floats(), max_size=4),
    places=st.lists(st.lists(st.floats(), max_size=4), max_size=40),
)
def test_whatever_a_trace_holds_a_frame_is_json_of_numbers(
    t_ns: list[int],
    measured: list[list[float]],
    desired: list[list[float]],
    predicted: list[list[float] | None],
    ratio: list[float | None],
    places: list[list[float]],
) -> None:
    frames = Frames(0)
    hostile = LegTrace(
        leg="rf",
        number=1,
        t_ns=t_ns,
        seq=t_ns,
        swing=[True] * 4,
        measured=measured,
        desired=desired,
        predicted=predicted,
        test_ratio=ratio,
        places_m=places,
    )
    frames.trace(hostile, S)
    frames.contact("rf", event("rf", 2**62, onset_ns=-(2**62), score=math.nan))
    found = frame(frames, S)
    for rows in found.get("k", {}).values():
        for row in rows:
            assert len(row) % 1 == 0
            assert all(value is None or isinstance(value, int) for value in row)
        assert [row[0] for row in rows] == sorted({row[0] for row in rows})
    for outline in found.get("f", {}).values():
        assert len(outline) % 2 == 0
        assert all(isinstance(value, int) for value in outline)


def test_the_table_comes_when_it_has_changed() -> None:
    status = LearnerStatus(
        leg="rf",
        t_ns=S,
        status="valid",
        model_version=3,
        residual_rms=[0.002, 0.001],
        noise_floor=[0.001, 0.001],
        rejects={"not_finite": 2, "overflow": 0},
    )
    service = ServiceStatus(
        version="1",
        robot="mini<b>\x1b[2J",
        period_s=0.02,
        baseline="shipped",
        legs={"rf": LegFacts(joints=["femur", "tibia\u202e"])},
        uptime_s=1.0,
    )
    view = View(legs=[LegView(leg="rf", status="valid", contact=True)], service=service, alive=True)
    table = Table(1_700_000_000_000)
    encoded = table.encode(view, {"rf": status}, S)
    assert b"\n" not in encoded
    found = json.loads(encoded)
    assert found["banner"] == []
    assert found["service"]["robot"] == "mini<b>\\u001b[2J", "control characters are shown"
    (row,) = found["legs"]
    assert row["joints"] == ["femur", "tibia\\u202e"]
    assert row["floor"] == 2.0
    assert row["rejects"] == {"not_finite": 2}
    assert table.encode(view, {"rf": status}, S) is None
