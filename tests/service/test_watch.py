"""What `watch` counts of events, truth and statuses."""

from __future__ import annotations

import io
import re
import time
from typing import Any

import msgspec
import pytest
from rich.console import Console
from views import MS, S, event, heartbeat, service, status, truth

from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.watch import Feed, LegView, View, Watch
from adaptive_contact.service.watch_table import counts_of, headline, table
from adaptive_contact.status import StateFacts
from adaptive_contact.wire import (
    HEARTBEAT,
    DriftLevel,
    LearnerStatus,
    LegState,
    contact_key,
    state_key,
    truth_key,
)
from waiting import matched, until


def drawn(view: View, width: int = 180) -> str:
    """The table of `watch`, as text."""
    out = io.StringIO()
    Console(width=width, file=out).print(table(view, width))
    return out.getvalue()


def after_one_swing() -> Watch:
    """Counting begins after the first touch."""
    watch = Watch()
    watch.truth("rf", truth(-2000, False), 0)
    watch.truth("rf", truth(-1000, True), 0)
    return watch


def row(watch: Watch, now_ns: int = 10 * S) -> Any:
    (leg,) = watch.view(now_ns).legs
    return leg


def test_events_and_statuses_make_a_row() -> None:
    watch = Watch()
    for second in range(4):
        watch.learner(status(ticks=50 * second, contacts=2, missed=3), second * S)
    watch.event(event(1), 4 * S)
    assert row(watch, 5 * S).contact is None, "no service says that it is known"
    watch.known.heartbeat(heartbeat("rf", age_s=0.1), 5 * S)
    leg = row(watch, 5 * S)
    assert leg.age_s == 0.1
    assert (leg.leg, leg.contact, leg.status, leg.model_version) == ("rf", True, "valid", 4)
    assert (leg.contact_age_s, leg.rate_hz, leg.missed, leg.contacts) == (1.0, 50.0, 3, 2)
    assert leg.touches is None
    assert not leg.stale
    watch.event(event(2, contact=False), 6 * S)
    assert row(watch, 6 * S).contact is None
    watch.known.heartbeat(heartbeat("rf"), 7 * S)
    assert row(watch, 7 * S).contact is False
    assert row(watch, 7 * S).contact_age_s == 3.0
    assert row(watch, 7 * S).stale, "the last status is 4 s old"
    watch.event(event(3), 8 * S, age_ns=4 * S)  # as a late joiner receives it
    assert row(watch, 8 * S).contact_age_s == 4.0
    for ticks in (10, 60):  # of a service that was restarted
        watch.learner(status(ticks=ticks), (8 + ticks // 60) * S)
    assert row(watch, 9 * S).rate_hz == 50.0


def test_p_is_of_the_newest_state_or_event_while_that_is_fresh() -> None:
    watch = Watch()

    def shown(now_ms: int) -> float | None:
        watch.known.heartbeat(heartbeat("rf"), now_ms * MS)
        return row(watch, now_ms * MS).p

    watch.event(msgspec.structs.replace(event(1), p=0.9), 1000 * MS, age_ns=400 * MS)
    assert shown(1500) == 0.9
    assert shown(1700) is None, "of an event that is over a second old"
    watch.state("rf", LegState(t_ns=0, seq=1, contact=True, p=0.75, known=True), 2000 * MS)
    assert shown(2100) == 0.75
    watch.state("rf", LegState(t_ns=0, seq=2, contact=False, p=None, known=False), 2200 * MS)
    assert shown(2300) is None
    watch.state("rf", LegState(t_ns=0, seq=3, contact=True, p=0.75, known=True), 2400 * MS)
    assert shown(2500) == 0.75
    assert row(watch, 3200 * MS).p is None, "the service is gone"


@pytest.mark.e2e
def test_states_are_asked_for_by_who_shows_p(router: Link) -> None:
    with (
        Link.open(client_settings(router.endpoints)) as own,
        Link.open(client_settings(router.endpoints)) as link,
    ):
        states, beats = own.publisher(state_key("rf")), own.publisher(HEARTBEAT)
        Feed(link)
        feed = Feed(link, states=True)

        def p() -> float | None:
            beats.put(heartbeat("rf"))
            states.put(LegState(t_ns=0, seq=1, contact=True, p=0.75, known=True))
            legs = feed.view(time.monotonic_ns()).legs
            return legs[0].p if legs else None

        until(lambda: p() == 0.75)
        assert states.matched
        truths, contacts = own.publisher(truth_key("rf")), own.publisher(contact_key("rf"))
        for t_ms in (100, 300, 500, 700):  # the first touch is neither seen nor missed
            matched(truths).put(truth(t_ms, t_ms % 400 == 300))
        contacts.put(event(710))
        until(lambda: p() and feed.view(time.monotonic_ns()).legs[0].latency_ms == 10.0)
        feed_without = Feed(router)
        for _ in range(5):
            assert p() == 0.75
        assert all(leg.p is None for leg in feed_without.view(time.monotonic_ns()).legs)


def test_contacts_that_did_not_arrive_are_counted() -> None:
    watch = Watch()
    watch.event(event(400), 0)  # before anything is known of how many there were
    watch.learner(status(t_ns=1 * S, contacts=7), 1 * S)
    watch.event(event(1500), 2 * S)
    watch.event(event(1700, contact=False), 2 * S)
    watch.learner(status(t_ns=2 * S, contacts=8), 2 * S)
    assert row(watch).unheard == 0
    watch.event(event(3900), 4 * S)
    watch.event(event(4100), 4 * S)  # told after the status that is still on its way
    watch.learner(status(t_ns=4 * S, contacts=11), 4 * S)
    assert row(watch).unheard == 2
    watch.event(event(2500), 4 * S)  # late is not lost
    watch.event(event(2500), 4 * S)  # nor is twice more than once
    assert row(watch).unheard == 1
    watch.service(service())
    assert "1 contact reported but not received here" in headline(watch.view(4 * S)).plain


@pytest.mark.parametrize(
    "fresh",
    [
        status(t_ns=8 * S, contacts=0),
        status(t_ns=1 * S, contacts=9),
        status(t_ns=0, contacts=9),
        status(t_ns=8 * S, contacts=5000),
    ],
    ids=["another service", "another clock", "before its first sample", "a rival"],
)
def test_the_count_of_what_did_not_arrive_begins_anew_and_keeps_what_it_has(
    fresh: LearnerStatus,
) -> None:
    watch = Watch()
    watch.learner(status(t_ns=2 * S, contacts=5), 1 * S)
    for t_ms in (2500, 3000, 3500):
        watch.event(event(t_ms), 2 * S)
    watch.learner(status(t_ns=4 * S, contacts=9), 2 * S)
    assert row(watch).unheard == 1
    watch.learner(fresh, 3 * S)
    assert row(watch).unheard == 1
    # Times that were heard of the other clock are none of this one's.
    watch.learner(status(t_ns=fresh.t_ns + 4 * S, contacts=fresh.contacts + 2), 4 * S)
    assert row(watch).unheard == 3


def test_what_a_leg_has_changed_in_and_when_is_shown() -> None:
    watch = Watch()
    watch.learner(status(t_ns=9 * S), 0)
    assert "changed" not in drawn(watch.view(0))
    drift = DriftLevel(level=5.0, since_ns=4 * S)
    watch.learner(status(t_ns=9 * S, status="adapting", drift=drift), 0)
    assert (row(watch).changed_s, row(watch).kind) == (5.0, None)
    watch.learner(status(t_ns=9 * S, drift=msgspec.structs.replace(drift, kind="friction")), 0)
    watch.service(service())
    assert "friction, 5.0 s ago" in drawn(watch.view(0))
    watch.learner(status(t_ns=9 * S, drift=DriftLevel(kind="load")), 0)
    assert "load" in drawn(watch.view(0)), "its time was of another clock"


@pytest.mark.parametrize(
    ("event_ms", "seen", "false_alarms"),
    [
        (1014, 1, 0),  # in time
        (1120, 1, 0),  # the last moment
        (1121, 0, 0),  # too late to count, but the foot is loaded: neither
        (1000, 0, 0),  # at the onset itself, loaded
        (900, 0, 1),  # in the air
        (1600, 0, 1),  # after the release
    ],
)
def test_truth_judges_events(event_ms: float, seen: int, false_alarms: int) -> None:
    watch = after_one_swing()
    watch.truth("rf", truth(500, False), 2 * S)
    watch.truth("rf", truth(1000, True), 2 * S)
    watch.event(event(event_ms), 2 * S)
    watch.truth("rf", truth(1500, False), 2 * S)
    assert row(watch, 2 * S + 100 * MS).seen == 0, "not judged before truth had time to arrive"
    assert row(watch, 2 * S + 400 * MS).touches == seen, "an event may still come"
    leg = row(watch, 3 * S)
    assert (leg.touches, leg.seen, leg.false_alarms) == (1, seen, false_alarms)
    assert leg.latency_ms == (event_ms - 1000 if seen else None)


@pytest.mark.parametrize(
    ("watch", "truths", "events", "counted"),
    [
        # Truth that comes after the event still counts.
        (after_one_swing(), [(500, False), (1000, True)], [1020], (1, 1, 0)),
        # A leg that is first seen loaded has not touched.
        (Watch(), [(1000, True), (1100, False)], [1020], (0, 0, 0)),
        # Chatter is one touch, and an event matches once.
        (
            after_one_swing(),
            [(0, False), (100, True), (110, False), (130, True), (400, False)],
            [112, 450],
            (1, 1, 1),
        ),
        # The event of the first touch after joining may have come before anybody listened.
        (Watch(), [(500, False), (1000, True)], [10, 1020], (0, 0, 0)),
    ],
)
def test_touches_are_counted_in_any_order(
    watch: Watch,
    truths: list[tuple[int, bool]],
    events: list[int],
    counted: tuple[int, int, int],
) -> None:
    for t_ms in events:
        watch.event(event(t_ms), 1 * S)
    for t_ms, contact in truths:
        watch.truth("rf", truth(t_ms, contact), 1 * S)
    leg = row(watch, 5 * S)
    assert (leg.touches, leg.seen, leg.false_alarms) == counted


def test_touches_while_the_service_compiles_are_not_missed() -> None:
    watch = Watch()
    watch.service(service(instance="", note="compiling"))
    for t_ms in (0, 1000, 2000, 3000, 4000):
        if t_ms == 3000:
            watch.service(service(instance="ab"))
        watch.truth("rf", truth(t_ms, False), t_ms * MS)
        watch.truth("rf", truth(t_ms + 500, True), (t_ms + 500) * MS)
    leg = watch.view(9 * S).legs[0]
    assert (leg.leg, leg.touches, leg.seen) == ("rf", 1, 0), (
        "after the first with a service that judges"
    )


@pytest.mark.e2e
def test_looking_once_ends_where_there_is_no_router(program: Any) -> None:
    words = ("watch", "--connect", "tcp/127.0.0.1:1", "--once", "--wait", "0.3")
    looking = program("-m", "adaptive_contact", *words)
    assert looking.wait() == 2
    looking.wait_line(
        "no router within 0.3 s: unreachable: nobody listens on tcp/127.0.0.1:1; start"
    )


# -- The table of `watch`: at any width, with what matters over it

LEGS = [
    LegView(
        leg=f"leg{i}",
        contact=i % 2 == 0,
        status="ambiguous" if i == 11 else "valid",
        contact_age_s=12.3,
        latency_ms=16.0,
        median_latency_ms=18.0,
        touches=120,
        seen=119,
        false_alarms=i,
        residual_rms=[0.01, 0.02],
        noise_floor=[0.01, 0.02],
        model_version=12,
        changed_s=40.0,
        kind="friction",
        rate_hz=50.0,
        missed=3,
        rejects={"malformed": 3, "implausible": 4} if i == 11 else {},
        note="what is wrong, in words that go on for longer than a line has" if i == 11 else None,
    )
    for i in range(12)
]


def test_a_leg_whose_status_has_not_come_yet_says_so_in_its_place() -> None:
    watch = Watch()
    watch.event(event(1, leg="aa"), 0)
    watch.service(service())
    assert [leg.leg for leg in watch.view(0).legs] == ["rf", "lf", "aa"]
    (row,) = [line for line in drawn(watch.view(S), 120).splitlines() if line.startswith("rf ")]
    assert row.split()[:3] == ["rf", "unknown", "waiting"]


@pytest.mark.parametrize("width", [30, 40, 60, 80, 100, 120, 160])
def test_a_row_is_a_line_at_any_width(width: int) -> None:
    """Columns that do not fit are left out and named; nothing is cut to pieces."""
    lines = drawn(View(legs=LEGS, alive=True), width).splitlines()
    assert all(len(line.rstrip()) <= width for line in lines)
    rows = [line for line in lines if re.match(r"leg\d+ ", line)]
    assert len(rows) == len(LEGS)
    assert not any("\u2026" in line for line in lines)
    words = " ".join(" ".join(lines).split())
    assert "leg11: what is wrong, in words that go on for longer than a line has" in words
    assert "leg11: refused: implausible 4, malformed 3" in words
    head = next(line for line in lines if line.startswith("leg "))
    named = words.partition(f"not shown at {width} columns: ")[2]
    for column in ("status", "seen", "false", "residual", "model", "Hz", "changed"):
        assert (column in head) != (column in named), column
    if width >= 80:
        for column in ("state", "status", "last contact", "seen", "false", "missed", "rejects"):
            assert column in head


def test_the_table_says_what_matters() -> None:
    watch = Watch()
    watch.service(service(events=7, rejects={"unknown_leg": 2}))
    watch.truth("rf", truth(0, False), 0)
    watch.truth("rf", truth(300, True), 0)
    watch.truth("rf", truth(500, False), 0)
    watch.truth("rf", truth(1000, True), 0)
    watch.event(event(1016), 1 * S)
    watch.known.heartbeat(heartbeat("rf"), 2 * S)
    watch.learner(
        status(
            rejects={"malformed": 3, "not_finite": 9},
            note="something odd",
            restarts=1,
            drift=DriftLevel(level=1.7),
            contact=True,
        ),
        1 * S,
    )
    text = drawn(watch.view(2 * S))
    for part in (
        "mini  up 1.2 min  7 events",
        "refused: unknown_leg 2",
        "CONTACT",
        "16 ms (16)",
        "1/1",
        "0.34°",
        "2.0",
        "v4",
        "not_finite 9, malformed 3",
        "something odd",
        "0, 1 restart",
    ):
        assert part in text, f"{part!r} not in\n{text}"


def test_p_has_a_column_where_it_is_known() -> None:
    legs = [LegView(leg="lf", contact=True, p=0.987), LegView(leg="rf", contact=False)]
    head, _, lf, rf = drawn(View(legs=legs, alive=True), 120).splitlines()[2:6]
    assert (head.split()[3], lf.split()[3], rf.split()[3]) == ("p", "0.99", "-")
    without = drawn(View(legs=legs[1:], alive=True), 120)
    assert " p " not in without
    assert "latency" not in without, "that is of truth, which nobody tells"


def test_the_headline_says_what_is_wrong_as_a_whole() -> None:
    watch = Watch()
    assert "router lost" in headline(watch.view(0, connected=False)).plain
    assert "no service is running" in headline(watch.view(0, alive=False)).plain
    assert "waiting for the service" in headline(watch.view(0, alive=True)).plain
    watch.service(service(callback_faults=2))
    assert "service gone" in headline(watch.view(0, alive=False)).plain
    assert "2 callback faults" in headline(watch.view(0)).plain


def test_what_the_service_says_of_itself_is_over_the_table() -> None:
    watch = Watch()
    kept = StateFacts(
        folder="/x", restored=[], refused=["rf.state: damaged"], saved=1, failed=0, error=None
    )
    told = service(
        note="state: disk full", events_lost=3, slow_puts=2, cut_off=4, stalls=1, state=kept
    )
    watch.service(told)
    text = drawn(watch.view(0))
    for part in (
        "state refused: rf.state: damaged",
        "state: disk full",
        "3 events lost",
        "2 events held up",
        "4 links of subscribers dropped",
        "stood still 1 times",
    ):
        assert part in text


def test_no_reason_is_out_of_sight_behind_larger_ones() -> None:
    counts = {"time_backwards": 9, "overflow": 650, "not_finite": 4000, "too_large": 2000, "x": 1}
    shown = counts_of(counts)
    assert shown == "not_finite 4000, too_large 2000, overflow 650, time_backwards 9, x 1"
