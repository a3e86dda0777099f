"""The service in this process, in lockstep: a real link, a fake learner, time as an argument."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Mapping
from typing import Any
from unittest import mock

import fake_service as fake
import msgspec
import pytest
from structlog.testing import capture_logs

from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.service import server
from adaptive_contact.service.link import Link
from adaptive_contact.service.sample_queue import Batch, SampleQueue
from adaptive_contact.service.server import Service, Sweeper
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus, StateFacts
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_STATE,
    MAX_SAMPLE_BYTES,
    MSGPACK,
    ContactEvent,
    LegState,
    ModelReport,
    Reject,
    ServoSample,
    contact_key,
    decode,
    encode,
    model_key,
    servo_key,
)
from adaptive_contact.wire.received import Received
from rig import at_work
from waiting import until

S = 1_000_000_000
MS = 1_000_000
Sample = Callable[..., ServoSample]


@pytest.fixture
def step(router: Link, lockstep: Callable[..., Any]) -> Any:
    return lockstep(router)


def test_states_are_published_while_somebody_subscribes(
    step: Any, inbox: Any, sample: Sample
) -> None:
    step.process(1, lf=sample(1))
    got = inbox(LegState)
    subscribed = step.client.subscribe(ALL_STATE, got)
    step.settle()
    step.process(2, lf=sample(2), rf=sample(2, contact=True))
    step.process(3, lf=sample(2), rf=sample(3))  # the first is refused: there is no state of it
    states = got.wait(3)
    assert sorted((one.seq, one.contact, one.p) for one in states) == [
        (2, False, 0.1),
        (2, True, 0.9),
        (3, False, 0.1),
    ]
    subscribed.close()
    step.settle()
    step.process(4, lf=sample(4))
    step.settle()
    assert len(got.items) == 3


def test_statuses_once_a_second_and_at_each_change(step: Any, inbox: Any, sample: Sample) -> None:
    got = step.statuses(inbox, "lf")
    for tick in range(171):  # 3.4 s
        if tick == 60:
            step.bank.learner("lf").word = "adapting"
        step.process(tick * 20 * MS, lf=sample(tick), rf=sample(tick))
    found = got.wait(5)
    assert [status.status for status in found] == ["valid"] * 2 + ["adapting"] * 3
    assert all(status.leg == "lf" for status in found)


def test_a_leg_that_never_spoke_is_silent_from_the_start(step: Any, inbox: Any) -> None:
    got = step.statuses(inbox, "rf")
    step.process(1200 * MS)
    (status,) = got.wait(1)
    assert (status.status, status.note) == ("silent", "no sample yet, after 1.2 s")


def test_bad_payloads_are_counted_by_reason_and_seen(step: Any, inbox: Any, sample: Sample) -> None:
    got = step.statuses(inbox, "lf")
    whole = encode(sample(1))
    nan = sample(2, measured=[float("nan"), 0.0, 0.0])
    for n, payload in enumerate([b"\xc1", whole[:-3], b"\x80", encode(nan), b'{"v":1}', whole]):
        step.process(n, lf=payload)
    step.process(1000 * MS, lf=sample(3), rf=sample(3))
    step.process(1100 * MS, lf=sample(4), rf=sample(3))
    status = got.wait(lambda items: items[-1].ticks >= 2)[-1]
    assert status.status == "valid"
    assert status.rejects == {
        Reject.MALFORMED: 2,
        Reject.MISSING_FIELD: 2,  # what begins with a brace is read as JSON
        Reject.NOT_FINITE: 1,
    }
    assert "payload refused: missing_field" in status.note


def test_dropped_samples_are_counted_for_their_leg(step: Any, sample: Sample) -> None:
    round_: Batch[Any] = Batch(samples={})
    round_.overflow.update(lf=3, nobody=2)
    with capture_logs() as logs:
        step.service.process_batch(round_, 5)
    assert [(line["event"], line["reason"], line["leg"], line["times"]) for line in logs] == [
        ("samples dropped", "overflow", "lf", 3),
        ("samples dropped", "overflow", "nobody", 2),
    ]
    assert step.bank.learner("lf").status.rejects == {Reject.OVERFLOW: 3}
    assert step.service.status(6).rejects == {Reject.OVERFLOW: 2}


BAD: dict[str, Callable[[Sample], bytes]] = {
    "malformed": lambda sample: b"noise",
    "not_finite": lambda sample: encode(sample(1, measured=[math.nan] * 16, desired=[0.0] * 16)),
    "out_of_range": lambda sample: encode(sample(-1)),
    "wrong_joints": lambda sample: encode(sample(1, desired=[0.1])),
    "too_large": lambda sample: bytes(MAX_SAMPLE_BYTES + 1),
}


def test_a_leg_is_made_by_a_good_sample_alone_and_too_many_are_refused(
    step: Any, inbox: Any, robot: Robot, sample: Sample
) -> None:
    bank, client = step.bank, step.client
    events = inbox(ContactEvent).subscribe(client, contact_key("extra"), history=True)
    told = inbox(ServiceStatus).subscribe(client, SERVICE_STATUS)
    step.settle()
    with at_work(step.service):
        for reason, payload in BAD.items():
            for n in range(8):
                client.publisher(servo_key(f"{reason}{n}")).put_raw(payload(sample), MSGPACK)
        refused = dict.fromkeys(BAD, 8)
        told.wait(lambda items: items[-1].rejects == refused)
        assert bank.legs == robot.leg_ids
        client.publisher(servo_key("extra")).put(sample(1, contact=True))
        told.wait(lambda items: "extra" in items[-1].legs)
        client.publisher(servo_key("extra")).put(sample(2, contact=True))
        assert events.wait(1)[0].seq == 2, "the sample that made the leg is not judged"
        for n in range(fake.MAX_LEGS):
            client.publisher(servo_key(f"more{n}")).put(sample(1))
        full = told.wait(lambda items: items[-1].rejects == {**refused, Reject.UNKNOWN_LEG: 3})[-1]
        assert full.legs["extra"].described is False
        assert "no room for another leg that is not described" in full.note
        told.wait(lambda items: len(items[-1].legs) == fake.MAX_LEGS == len(bank.legs))


def test_a_learner_that_is_being_made_holds_up_no_event(
    step: Any, inbox: Any, sample: Sample, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who invents legs costs those that are described nothing."""
    making, go_on, make = threading.Event(), threading.Event(), step.bank.make

    def slow(leg: str, joints: int) -> object:
        making.set()
        assert go_on.wait(60)
        return make(leg, joints)

    monkeypatch.setattr(step.bank, "make", slow)
    events = inbox(ContactEvent).subscribe(step.client, ALL_CONTACT)
    step.settle()
    with at_work(step.service, go_on):
        step.client.publisher(servo_key("extra")).put(sample(1, contact=True))
        assert making.wait(60)
        step.client.publisher(servo_key("lf")).put(sample(1, contact=True))
        assert events.wait(1)[0].leg == "lf"
        go_on.set()
        until(lambda: "extra" in step.service.status(0).legs)
        step.client.publisher(servo_key("extra")).put(sample(2, contact=True))
        assert events.wait(2)[1].leg == "extra"


def test_described_legs_only(
    router: Link, lockstep: Callable[..., Any], inbox: Any, robot: Robot, sample: Sample
) -> None:
    step = lockstep(router, described_only=True)
    events = inbox(ContactEvent).subscribe(step.client, ALL_CONTACT, history=True)
    step.settle()
    with at_work(step.service):
        for leg in ("extra", *robot.leg_ids):
            step.client.publisher(servo_key(leg)).put(sample(1, contact=True))
        events.wait(len(robot.leg_ids))
    assert step.service.status(0).samples == len(robot.leg_ids)


def test_wildcards_are_counted_for_the_service(step: Any, inbox: Any) -> None:
    got = inbox(ServiceStatus).subscribe(step.client, SERVICE_STATUS, history=True)
    step.service.process_batch(Batch(strangers=4, stranger="robot/leg/*/servo"), 1)
    step.service.publish_due(2 * S)
    assert got.wait(1)[-1].rejects == {Reject.UNKNOWN_LEG: 4}


def test_a_complaint_that_comes_or_goes_is_published_at_once(
    router: Link, lockstep: Callable[..., Any], inbox: Any
) -> None:
    """Not a second later: who reads "state is saved again" in the log looks at `watch` next."""
    facts = StateFacts(folder="kept", restored=[], refused=[], saved=0, failed=0, error=None)
    disk = mock.Mock(facts=facts)
    disk.restore.return_value, disk.due.return_value = None, False
    step = lockstep(router, keeper=disk)
    got = inbox(ServiceStatus).subscribe(step.client, SERVICE_STATUS, history=True)
    step.settle()
    errors = [None, None, "disk full", "disk full, still", None, None]
    for tick, error in enumerate(errors):
        disk.facts = msgspec.structs.replace(facts, error=error)
        step.service.publish_due(tick * 100 * MS)
    step.service.publish_due(S + 400 * MS)
    notes = [(status.note, status.uptime_s) for status in got.wait(4)]
    assert notes == [(None, 0.0), ("state: disk full", 0.2), (None, 0.4), (None, 1.4)]


def test_models_are_told_when_asked(step: Any) -> None:
    bank, client = step.bank, step.client
    with at_work(step.service):
        replies = client.query(model_key("*"))
        reports = [decode(reply.payload, ModelReport, reply.encoding) for reply in replies]
        assert sorted(r.leg for r in reports if isinstance(r, ModelReport)) == ["lf", "rf"]
        bank.learner("lf").fault = ZeroDivisionError("in its model")
        with capture_logs():  # a traceback in colours takes a second of a busy core
            assert len(client.query(model_key("*"))) == 2, "a fault in one leg begins it again"
        bank.learner("lf").report = None
        (one,) = client.query(model_key("*"))
        assert one.key == model_key("rf")
        (refusal,) = client.query(model_key("lf"))
        assert refusal.error == "lf: no model yet, still learning"
        (unknown,) = client.query(model_key("xx"))
        assert unknown.error == "no such leg in robot/leg/xx/model; legs are lf, rf"


def test_an_event_does_not_wait_for_learning(
    step: Any, inbox: Any, sample: Sample, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard, learned = threading.Event(), threading.Event()

    def learn_from_tick() -> None:
        if heard.wait(5):
            learned.set()

    monkeypatch.setattr(step.bank, "learn_from_tick", learn_from_tick)
    got = inbox(ContactEvent).subscribe(step.client, ALL_CONTACT)
    step.settle()
    with at_work(step.service, heard):
        step.client.publisher(servo_key("lf")).put(sample(1, contact=True))
        assert got.wait(1)[0].contact
        assert not learned.is_set()
        heard.set()
        assert learned.wait(5)


def test_a_worker_that_is_behind_ends_a_tick_before_it_catches_up(
    router: Link, sample: Sample, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight legs, forty ticks waiting: statuses, saves and the watchdog do not wait for all."""
    legs = [f"l{n}" for n in range(fake.MAX_LEGS)]
    text = "".join(f'[[leg]]\nid = "{leg}"\njoints = ["a", "b", "c"]\n' for leg in legs)
    many = parse_robot(
        f'[robot]\nname = "many"\nperiod_s = 0.02\nquantum_rad = 0.005\n{text}', source="test"
    )
    bank = fake.FakeBank(many)
    queue: SampleQueue[Any] = SampleQueue(many.leg_ids)
    monkeypatch.setattr(server, "SampleQueue", lambda _legs: queue)
    service = Service(router, bank, many, baseline=None, now_ns=0)
    for seq in range(40):
        for leg in legs:
            queue.offer(Received(servo_key(leg), encode(sample(seq)), MSGPACK, 0, None))
    detect, judged, most, done = bank.detect_contacts, [0], [0], threading.Event()

    def count(samples: Mapping[str, ServoSample]) -> object:
        judged[0] += 1
        most[0] = max(most[0], judged[0])
        if max(one.seq for one in samples.values()) == 39:
            done.set()
        return detect(samples)

    monkeypatch.setattr(bank, "detect_contacts", count)
    monkeypatch.setattr(bank, "learn_from_tick", lambda: judged.__setitem__(0, 0))
    with at_work(service):
        assert done.wait(20)
    assert most[0] == 2
    assert all(bank.learner(leg).status.ticks == 40 for leg in legs)


# -- Garbage is collected between ticks, and not by Python


def test_garbage_is_collected_after_a_tick(
    router: Link, lockstep: Callable[..., Any], inbox: Any, sample: Sample
) -> None:
    pauses = inbox()

    class Recorder(Sweeper):
        def sweep(self, now_ns: int, *, pause: bool) -> None:
            pauses(pause)

    step = lockstep(router, sweeper=Recorder())
    with at_work(step.service):
        assert not any(pauses.wait(3)), "without a sample it is no pause between two"
        publisher = step.client.publisher(servo_key("lf"))
        for seq in itertools.count(1):
            publisher.put(sample(seq))
            if any(pauses.wait(len(pauses.items) + 1)):
                break
