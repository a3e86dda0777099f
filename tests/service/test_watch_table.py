"""The table of `watch`: at any width, with what matters over it."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console
from views import S, drawn, event, heartbeat, service, status, truth

from adaptive_contact.service.status import StateFacts
from adaptive_contact.service.watch import LegView, View, Watch
from adaptive_contact.service.watch_table import counts_of, headline, table
from adaptive_contact.wire import (
    DriftLevel,
)

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


def lines(view: View, width: int) -> list[str]:
    out = io.StringIO()
    Console(width=width, file=out).print(table(view, width))
    return out.getvalue().splitlines()


def test_a_leg_whose_status_has_not_come_yet_says_so() -> None:
    watch = Watch()
    watch.service(service())
    (row,) = [line for line in lines(watch.view(S), 120) if line.startswith("rf ")]
    assert row.split()[:3] == ["rf", "unknown", "waiting"]


@pytest.mark.parametrize("width", [30, 40, 60, 80, 100, 120, 160])
def test_a_row_is_a_line_at_any_width(width: int) -> None:
    """Columns that do not fit are left out and named; nothing is cut to pieces."""
    drawn = lines(View(legs=LEGS, alive=True), width)
    assert all(len(line.rstrip()) <= width for line in drawn)
    rows = [line for line in drawn if re.match(r"leg\d+ ", line)]
    assert len(rows) == len(LEGS)
    assert not any("\u2026" in line for line in drawn)
    words = " ".join(" ".join(drawn).split())
    assert "leg11: what is wrong, in words that go on for longer than a line has" in words
    assert "leg11: refused: implausible 4, malformed 3" in words
    head = next(line for line in drawn if line.startswith("leg "))
    named = words.partition(f"not shown at {width} columns: ")[2]
    for column in ("status", "seen", "false", "residual", "model", "Hz", "changed"):
        assert (column in head) != (column in named), column
    if width >= 80:
        for column in ("state", "status", "last contact", "seen", "false", "missed", "rejects"):
            assert column in head


def test_rows_come_in_the_order_of_the_robot() -> None:
    watch = Watch()
    watch.event(event(1, leg="aa"), 0)
    watch.service(service())
    assert [leg.leg for leg in watch.view(0).legs] == ["rf", "lf", "aa"]


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
    ):
        assert part in text, f"{part!r} not in\n{text}"


def test_p_has_a_column_where_it_is_known() -> None:
    legs = [LegView(leg="lf", contact=True, p=0.987), LegView(leg="rf", contact=False)]
    head, _, lf, rf = lines(View(legs=legs, alive=True), 120)[2:6]
    assert (head.split()[3], lf.split()[3], rf.split()[3]) == ("p", "0.99", "-")
    assert " p " not in "\n".join(lines(View(legs=legs[1:], alive=True), 120))


def test_without_truth_there_are_no_columns_of_it() -> None:
    watch = Watch()
    watch.learner(status(), 0)
    assert "latency" not in drawn(watch.view(0))


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
