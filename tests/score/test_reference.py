"""The vectorised score against a slow one, written from the text of the rules with plain loops."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.score import (
    ROWS,
    Events,
    LegStream,
    TruthChanges,
    match,
    summarise,
    swings_to_recovery,
)

MS = 1_000_000


@dataclass
class Case:
    t: list[int]
    swing: list[bool]
    lift: list[bool]
    changes: list[tuple[int, bool, float, bool, bool]]  # time, state, speed, soft, grazing
    events: list[tuple[int, bool]]


@dataclass
class Reference:
    # onset, row, found, latency, latency of a detection that came too late
    touches: list[tuple[int, str, bool, int, int]] = field(default_factory=list)
    alarms: list[int] = field(default_factory=list)
    outside: list[int] = field(default_factory=list)
    unjudged: list[int] = field(default_factory=list)
    judged: Counter[int] = field(default_factory=Counter)
    neutral: Counter[int] = field(default_factory=Counter)
    judged_after: Counter[int] = field(default_factory=Counter)
    alarms_after: list[int] = field(default_factory=list)
    late: list[int] = field(default_factory=list)  # onsets
    late_after: list[int] = field(default_factory=list)
    errors: Counter[int] = field(default_factory=Counter)
    swings: list[tuple[int, int]] = field(default_factory=list)


def reference(case: Case) -> Reference:
    out = Reference()
    gap = 10 * statistics.median([b - a for a, b in zip(case.t, case.t[1:], strict=False)] or [0])

    # Swings: runs of swing samples without a hole.
    number: list[int | None] = []
    for k, swinging in enumerate(case.swing):
        if not swinging:
            number.append(None)
            continue
        goes_on = k > 0 and case.swing[k - 1] and case.t[k] - case.t[k - 1] <= gap
        if not goes_on:
            out.swings.append((k, k))
        out.swings[-1] = (out.swings[-1][0], k)
        number.append(len(out.swings) - 1)

    # What follows a swing: stance, without a hole.
    follows: list[int | None] = [None] * len(case.t)
    for swing, (_, last) in enumerate(out.swings):
        for k in range(last + 1, len(case.t)):
            if case.swing[k] or case.t[k] - case.t[k - 1] > gap:
                break
            follows[k] = swing

    def tick_at(when: int) -> int | None:
        found = None
        for k, t in enumerate(case.t):
            if t <= when:
                found = k
        return found if found is not None and when - case.t[found] <= gap else None

    def swing_at(when: int) -> int | None:
        tick = tick_at(when)
        return None if tick is None else number[tick]

    # Contacts: at least 60 ms in the air before each.
    contacts: list[dict[str, object]] = []
    start = min([case.t[0], *([case.changes[0][0]] if case.changes else [])])
    air_since: int | None = start
    if case.changes and not case.changes[0][1]:
        contacts.append({"on": start, "off": None, "touch": False, "row": None})
        air_since = None
    for when, state, speed, soft, grazing in case.changes:
        if state and air_since is not None:
            if when - air_since >= 60 * MS:
                told = {"speed": speed, "soft": soft, "grazing": grazing}
                contacts.append({"on": when, "off": None, "touch": True, **told})
            elif contacts:
                contacts[-1]["off"] = None
            else:
                contacts.append({"on": when, "off": None, "touch": False})
            air_since = None
        elif not state and air_since is None:
            contacts[-1]["off"] = when
            air_since = when
    for contact in contacts:
        contact["swing"] = swing_at(contact["on"]) if contact["touch"] else None

    def held(when: int) -> dict[str, object] | None:
        for c in contacts:
            if c["on"] <= when and (c["off"] is None or when < c["off"]):
                return c
        return None

    def after_at(when: int) -> int | None:
        tick = tick_at(when)
        return None if tick is None else follows[tick]

    def touched_after(when: int, swing: int) -> bool:
        """Whether a contact was there from the swing's turn on until then, at any time."""
        turn = case.t[out.swings[swing][1] + 1]
        return any((c["off"] is None or c["off"] > turn) and c["on"] <= when for c in contacts)

    for contact in contacts:
        if not contact["touch"]:
            continue
        onset = contact["on"]
        after = after_at(onset)
        first = after is not None and not touched_after(onset - 1, after)
        if first and tick_at(onset) - out.swings[after][1] <= 10:
            contact["swing"] = after
            out.late_after.append(onset)
        if contact["swing"] is None:
            out.unjudged.append(onset)

    for k, t in enumerate(case.t):
        holder = held(t)
        if number[k] is not None and (holder is None or holder["swing"] == number[k]):
            out.judged[number[k]] += 1
        if follows[k] is not None and k - out.swings[follows[k]][1] <= 16 and holder is None:
            out.judged_after[follows[k]] += 1

    for contact in contacts:
        contact["found"], contact["too late"] = None, None
        slow = contact["touch"] and (contact["soft"] or contact["speed"] <= 0.1)
        contact["window"] = (500 if slow else 120) * MS
    for when in sorted({t for t, contact in case.events if contact}):
        swing, after = swing_at(when), after_at(when)
        before = [c for c in contacts if c["on"] <= when]
        last = before[-1] if before and before[-1]["touch"] else None
        in_time = last is not None and when <= last["on"] + last["window"]
        holder = held(when)
        place = swing if swing is not None else after
        if place is None:
            out.outside.append(when)
            continue
        if last is not None and last["swing"] == place and last["found"] is None:
            if in_time:
                last["found"] = when - last["on"]
                continue
            if holder is last and last["too late"] is None:
                last["too late"] = when - last["on"]
                continue
        if swing is not None and holder is not None and holder["swing"] != swing:
            out.neutral[swing] += 1
        elif swing is not None:
            out.alarms.append(when)
            out.errors[swing] += 1
        elif holder is not None or (in_time and last["swing"] is None):
            out.outside.append(when)
        else:
            out.alarms.append(when)
            out.alarms_after.append(when)
            out.errors[after] += 1

    for contact in contacts:
        swing, onset = contact["swing"], contact["on"]
        if swing is None:
            continue
        first, last = out.swings[swing]
        left = sum(1 for k in range(first, last + 1) if case.t[k] > onset)
        speed = contact["speed"]
        if left < 3:
            out.late.append(onset)
        if left < 3 and not (math.isnan(speed) and not contact["soft"] and not contact["grazing"]):
            row = "late"
        elif case.lift[tick_at(onset)] and tick_at(onset) <= last:
            row = "lift"
        elif contact["grazing"]:
            row = "grazing"
        elif contact["soft"]:
            row = "soft"
        elif math.isnan(speed):
            row = "unknown"
        elif speed >= 0.2:
            row = "headline"
        elif speed > 0.1:
            row = "mid"
        elif speed >= 0.02:
            row = "slow"
        else:
            row = "creep"
        found, too_late = contact["found"], contact["too late"]
        if found is None and row in ("headline", "mid", "slow", "soft", "unknown", "late"):
            out.errors[swing] += 1
        latencies = (-1 if found is None else found, -1 if too_late is None else too_late)
        out.touches.append((onset, row, found is not None, *latencies))
    return out


@st.composite
def cases(draw: st.DrawFn) -> Case:
    n = draw(st.integers(1, 60))
    steps = draw(
        st.lists(st.sampled_from([20, 20, 20, 20, 19, 21, 40, 250]), min_size=n, max_size=n)
    )
    t = list(np.cumsum(steps) * MS)
    swing: list[bool] = []
    flag = draw(st.booleans())
    while len(swing) < n:
        swing += [flag] * draw(st.integers(1, 25))
        flag = not flag
    lift = draw(st.lists(st.booleans(), min_size=n, max_size=n))
    end = int(t[-1]) // MS + 100
    # Times on ticks, and anywhere, so that both sides of every edge are met.
    moment = st.one_of(
        st.integers(0, end).map(lambda ms: ms * MS), st.sampled_from([int(x) for x in t])
    )
    times = sorted(draw(st.lists(moment, max_size=14, unique=True)))
    states = draw(st.lists(st.booleans(), min_size=len(times), max_size=len(times)))
    if draw(st.booleans()):  # a well-behaved stream, which alternates
        states = [(k % 2 == 0) != states[0] for k in range(len(times))] if times else []
    speeds = st.sampled_from([0.0, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.5, math.nan])
    changes = [
        (when, state, draw(speeds), draw(st.integers(0, 3)) == 0, draw(st.integers(0, 5)) == 0)
        for when, state in zip(times, states, strict=True)
    ]
    onsets = [when for when, state, *_ in changes if state]
    near = (
        st.builds(
            lambda a, b: max(0, a + b * MS),
            st.sampled_from(onsets),
            st.sampled_from([-20, 0, 1, 20, 119, 120, 121, 300, 499, 500, 501]),
        )
        if onsets
        else moment
    )
    events = draw(st.lists(st.tuples(st.one_of(moment, near), st.booleans()), max_size=14))
    return Case([int(x) for x in t], swing[:n], lift, changes, events)


def stream_of(case: Case) -> LegStream:
    columns = list(zip(*case.changes, strict=True)) or [(), (), (), (), ()]
    return LegStream(
        leg="rf",
        t_ns=np.array(case.t, dtype=np.int64),
        swing=np.array(case.swing, dtype=bool),
        lift=np.array(case.lift, dtype=bool),
        truth=TruthChanges(
            t_ns=np.array(columns[0], dtype=np.int64),
            contact=np.array(columns[1], dtype=bool),
            speed_m_s=np.array(columns[2], dtype=np.float64),
            soft=np.array(columns[3], dtype=bool),
            grazing=np.array(columns[4], dtype=bool),
            force_n=np.ones(len(columns[0])),
        ),
    )


def events_of(case: Case) -> Events:
    times = np.array([when for when, _ in case.events], dtype=np.int64)
    return Events(times, np.array([flag for _, flag in case.events], dtype=bool), times - 5 * MS)


@settings(max_examples=1000, deadline=None)
@given(cases())
def test_equals_the_slow_reference(case: Case) -> None:
    expected = reference(case)
    got = match(stream_of(case), events_of(case))
    swings, count = got.swings, range(len(expected.swings))
    touches = [
        (int(onset), ROWS[row], bool(found), int(latency), int(too_late))
        for onset, row, found, latency, too_late in zip(
            got.touches.onset_ns,
            got.touches.row,
            got.touches.found,
            got.touches.latency_ns,
            got.touches.found_late_ns,
            strict=True,
        )
    ]
    assert touches == expected.touches
    assert int(swings.hits.sum()) == sum(found for _, _, found, *_ in touches)
    for ours, theirs in (
        (swings.start_ns, [case.t[a] for a, _ in expected.swings]),
        (swings.end_ns, [case.t[b] for _, b in expected.swings]),
        (swings.ticks, [b - a + 1 for a, b in expected.swings]),
        (got.alarms_ns, expected.alarms),
        (got.outside_ns, expected.outside),
        (got.unjudged_ns, expected.unjudged),
        (got.alarms_ns[got.alarm_after], expected.alarms_after),
        (got.touches.onset_ns[got.touches.late], expected.late),
        (got.touches.onset_ns[got.touches.after_turn], expected.late_after),
        (swings.judged_after, [expected.judged_after[s] for s in count]),
        (swings.judged - swings.judged_after, [expected.judged[s] for s in count]),
        (swings.neutral, [expected.neutral[s] for s in count]),
        (swings.errors, [expected.errors[s] for s in count]),
    ):
        assert list(ours) == theirs


@settings(max_examples=200, deadline=None)
@given(cases(), st.integers(0, 1500))
def test_two_parts_of_a_stream_add_up(case: Case, cut_ms: int) -> None:
    whole = match(stream_of(case), events_of(case))
    parts = [whole.between(0, cut_ms * MS), whole.between(cut_ms * MS, 10**15)]
    together, apart = summarise([whole]), summarise(parts)
    for name in (
        *("counted", "rows", "late_after", "detections", "false_alarms", "after", "swings"),
        *("neutral", "outside", "unjudged"),
    ):
        assert getattr(together, name) == getattr(apart, name), name
    for part in parts:
        assert np.all(part.touches.swing < len(part.swings.start_ns))
        assert np.array_equal(
            part.swings.false_alarms,
            np.bincount(part.alarm_swing, minlength=len(part.swings.ticks)),
        )


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2), st.booleans()), max_size=80), st.integers(0, 60))
def test_recovery_equals_the_slow_reference(swings: list[tuple[int, bool]], drift: int) -> None:
    table = match(
        stream_of(Case([0], [False], [False], [], [])), events_of(Case([], [], [], [], []))
    )
    n = len(swings)
    zeros = np.zeros(n, dtype=np.int64)
    table = table.swings._replace(
        start_ns=np.arange(n, dtype=np.int64),
        touches=np.array([int(touched) for _, touched in swings], dtype=np.int64),
        misses=zeros,
        false_alarms=np.array([errors for errors, _ in swings], dtype=np.int64),
    )
    expected = None
    after = swings[drift:]
    for first in range(len(after) - 19):
        window = after[first : first + 20]
        rest = after[first + 20 :]
        while rest and not 5 <= sum(flag for _, flag in window) <= len(window) - 5:
            window, rest = [*window, rest[0]], rest[1:]
        touched = sum(flag for _, flag in window)
        if sum(errors for errors, _ in window) <= 1 and 5 <= touched <= len(window) - 5:
            expected = first
            break
    assert swings_to_recovery(table, drift) == expected
