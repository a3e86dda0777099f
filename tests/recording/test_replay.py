"""Replay: control ticks from a recording, through learners and onto the wire."""

from __future__ import annotations

import collections
import threading
import time
from collections.abc import Iterator
from typing import NamedTuple

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.service.link import Link, Received, client_settings
from adaptive_contact.service.recording import Record
from adaptive_contact.service.replay import Counts, WirePlayer, control_ticks
from adaptive_contact.wire import (
    JSON,
    MSGPACK,
    ContactTruth,
    Reject,
    ServoSample,
    contact_key,
    decode,
    encode,
    servo_key,
    truth_key,
)
from waiting import until

TICK = 20_000_000
LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")


def record(leg: str, k: int, *, run: int | None = 1, encoding: str = MSGPACK) -> Record:
    sample = ServoSample(
        t_ns=k * TICK, seq=k, measured=[0.1, k * 1e-3, 0.0], desired=[0.0, 0.0, 0.0], run=run
    )
    return Record(servo_key(leg), encode(sample, encoding), encoding, k * TICK, k * TICK)


def everyone(leg: str, joints: int) -> bool:
    return leg != "unwanted"


def test_a_tick_ends_where_a_leg_comes_round_again() -> None:
    legs = [("a", 0), ("b", 0), ("a", 1), ("b", 1), ("b", 2), ("a", 3), ("b", 3)]
    counts = Counts()
    ticks = list(control_ticks([record(leg, k) for leg, k in legs], everyone, counts))
    assert [[(leg, s.seq) for leg, s in tick.items()] for tick in ticks] == [
        [("a", 0), ("b", 0)],
        [("a", 1), ("b", 1)],
        [("b", 2), ("a", 3)],  # a's sample of tick 2 was lost
        [("b", 3)],
    ]
    assert (counts.samples, counts.ticks, counts.messages) == (7, 4, 7)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.sampled_from(LEGS), max_size=60))
def test_every_sample_is_in_one_tick_in_order(legs: list[str]) -> None:
    records = [record(leg, k) for k, leg in enumerate(legs)]
    counts = Counts()
    ticks = list(control_ticks(records, everyone, counts))
    flat = [(leg, sample.seq) for tick in ticks for leg, sample in tick.items()]
    assert flat == [(leg, k) for k, leg in enumerate(legs)]
    assert counts.ticks == len(ticks)


def test_bad_samples_are_counted_and_left_out() -> None:
    truth = ContactTruth(t_ns=0, contact=True, force=1.0)
    records = [
        record("a", 0),
        Record(servo_key("a"), b"\xc1", MSGPACK, 0, 0),
        Record(servo_key("a"), b'{"v":1}', JSON, 0, 0),
        Record("robot/leg/*/servo", record("a", 1).payload, MSGPACK, 0, 0),
        record("unwanted", 1),
        Record(truth_key("a"), encode(truth), MSGPACK, 0, 0),
        record("a", 2, encoding=JSON),
    ]
    counts = Counts()
    ticks = list(control_ticks(records, everyone, counts))
    assert [tick["a"].seq for tick in ticks] == [0, 2]
    assert counts.rejects == {
        Reject.MALFORMED: 1,
        Reject.MISSING_FIELD: 1,
        Reject.UNKNOWN_LEG: 2,
    }
    assert counts.messages == 7


class Wire(NamedTuple):
    """The session of the one who plays, and what comes to a router."""

    player: Link
    heard: list[Received]

    def wait_for(self, count: int) -> list[Received]:
        until(lambda: len(self.heard) >= count)
        return self.heard


@pytest.fixture
def wire(router: Link) -> Iterator[Wire]:
    with Link.open(client_settings(router.endpoints)) as player:
        made = Wire(player, [])
        router.subscribe("**", made.heard.append)
        yield made


RECORDED = [
    *(record(leg, k, run=9) for k in range(20) for leg in ("lf", "rf")),
    Record(truth_key("rf"), b"truth", MSGPACK, 20 * TICK, 20 * TICK),
    Record(contact_key("rf"), b"event", MSGPACK, 20 * TICK, 20 * TICK),
    Record("robot/leg/rf/command", b"command", MSGPACK, 20 * TICK, 20 * TICK),
    Record("robot/leg/*/servo", b"wild", MSGPACK, 20 * TICK, 20 * TICK),
]


@pytest.mark.e2e
def test_only_what_a_source_sends_goes_out(wire: Wire) -> None:
    player = WirePlayer(wire.player, None, run=1000)
    player.play(RECORDED, threading.Event())
    heard = wire.wait_for(41)
    assert collections.Counter(r.key for r in heard) == {
        "robot/leg/lf/servo": 20,
        "robot/leg/rf/servo": 20,
        "robot/leg/rf/truth": 1,
    }
    assert player.sent.total() == 41
    for leg in ("lf", "rf"):
        payloads = [(r.payload, r.encoding) for r in heard if r.key == servo_key(leg)]
        samples = [decode(payload, ServoSample, encoding) for payload, encoding in payloads]
        assert [(s.run, s.seq) for s in samples if isinstance(s, ServoSample)] == [
            (1000, k) for k in range(20)
        ]


@pytest.mark.e2e
def test_what_no_sample_holds_goes_out_as_it_is(wire: Wire) -> None:
    payload = msgpack.packb({"run": 1, "at": msgpack.Timestamp(1, 2)})
    player = WirePlayer(wire.player, None, run=1000)
    player.play([Record(servo_key("rf"), payload, MSGPACK, 0, 0)], threading.Event())
    assert [heard.payload for heard in wire.wait_for(1)] == [payload]


@pytest.mark.e2e
@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_timing_is_kept(wire: Wire, speed: float) -> None:
    records = [record("rf", k) for k in range(21)]  # 0.4 s
    player = WirePlayer(wire.player, speed, keep_run=True)
    started = time.monotonic()
    player.play(records, threading.Event())
    elapsed = time.monotonic() - started
    assert 0.4 / speed <= elapsed < 0.4 / speed + 10.0
    heard = wire.wait_for(21)
    assert [r.payload for r in heard] == [r.payload for r in records]
    gaps = np.diff([r.arrival_ns for r in heard]) / 1e6
    assert abs(np.median(gaps) - 20 / speed) < 5


@pytest.mark.e2e
def test_a_stop_ends_it_at_once(wire: Wire) -> None:
    records = [record("rf", 0), record("rf", 10**6)]  # 20,000 s apart
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    started = time.monotonic()
    WirePlayer(wire.player, 1.0).play(records, stop)
    assert time.monotonic() - started < 10.0
