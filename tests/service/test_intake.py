from __future__ import annotations

import threading
import time
from collections import Counter

from adaptive_contact.service.sample_queue import NO_QUEUE, SampleQueue
from adaptive_contact.wire import (
    MAX_SAMPLE_BYTES,
    MSGPACK,
    Reject,
    ServoSample,
    decode,
    servo_key,
)
from adaptive_contact.wire.received import Received


def received(leg: str, payload: bytes = b"", n: int = 0) -> Received:
    return Received(servo_key(leg), payload, MSGPACK, n, None)


def drain(intake: SampleQueue[object]) -> list[dict[str, Received]]:
    rounds = []
    while round_ := intake.pop_batch(0.0):
        rounds.append(round_.samples)
    return rounds


def test_a_round_holds_at_most_one_sample_per_leg_in_order() -> None:
    intake: SampleQueue[object] = SampleQueue(["lf", "rf"])
    for n, leg in enumerate(["lf", "rf", "lf", "lf", "rf"]):
        intake.offer(received(leg, n=n))
    rounds = drain(intake)
    assert [{leg: raw.arrival_ns for leg, raw in samples.items()} for samples in rounds] == [
        {"lf": 0, "rf": 1},
        {"lf": 2, "rf": 4},
        {"lf": 3},
    ]


def test_a_flood_costs_the_others_nothing_and_is_counted() -> None:
    intake: SampleQueue[object] = SampleQueue(["bad", "good"], queue_samples=8)
    for n in range(1000):
        intake.offer(received("bad", n=n))
    intake.offer(received("good", n=5000))
    first = intake.pop_batch(0.0)
    assert first.samples["good"].arrival_ns == 5000
    assert first.samples["bad"].arrival_ns == 992  # the newest are kept
    assert first.overflow == Counter(bad=992)
    assert len(drain(intake)) == 7
    assert not intake.pop_batch(0.0)


def test_keys_that_name_no_leg_are_counted_together() -> None:
    intake: SampleQueue[object] = SampleQueue()
    for key in ("robot/leg/*/servo", "robot/leg/**/servo", "robot/leg/a$*/servo", "other"):
        intake.offer(Received(key, b"", MSGPACK, 0, None))
    round_ = intake.pop_batch(0.0)
    assert (round_.samples, round_.strangers, round_.stranger) == ({}, 4, "other")
    assert not intake.pop_batch(0.0)


def test_legs_without_a_queue_share_one() -> None:
    intake: SampleQueue[object] = SampleQueue(["real"], queue_samples=4)
    for n in range(10):
        intake.offer(received(f"fake{n}", n=n))
        intake.offer(received("real", n=n))
    first = intake.pop_batch(0.0)
    assert {leg: raw.arrival_ns for leg, raw in first.samples.items()} == {"real": 6, "fake6": 6}
    assert first.overflow == {"real": 6, NO_QUEUE: 6}
    assert [set(samples) for samples in drain(intake)] == [
        {"real", "fake7"}, {"real", "fake8"}, {"real", "fake9"},
    ]  # fmt: skip


def test_a_leg_gets_a_queue_of_its_own() -> None:
    intake: SampleQueue[object] = SampleQueue(queue_samples=1)
    intake.open("new")
    for leg in ("new", "other"):
        intake.offer(received(leg))
    assert set(intake.pop_batch(0.0).samples) == {"new", "other"}


def test_questions_are_bounded() -> None:
    intake: SampleQueue[int] = SampleQueue()
    taken = [intake.add_request(n) for n in range(100)]
    assert taken == [True] * 64 + [False] * 36
    assert intake.pop_batch(0.0).requests == [0]
    assert intake.add_request(64)
    assert not intake.add_request(65)


def test_a_flood_of_questions_gets_one_answer_between_two_rounds_of_samples() -> None:
    """And none of them is forgotten, nor waited for."""
    intake: SampleQueue[int] = SampleQueue(["lf"])
    for n in range(30):
        intake.add_request(n)
    intake.offer(received("lf"))
    first = intake.pop_batch(0.0)
    assert (list(first.samples), first.requests) == (["lf"], [0])
    began = time.monotonic()
    assert [intake.pop_batch(60.0).requests for _ in range(29)] == [[n] for n in range(1, 30)]
    assert time.monotonic() - began < 30.0
    assert not intake.pop_batch(0.0)


def test_a_question_can_wait_for_the_next_round() -> None:
    intake: SampleQueue[int] = SampleQueue(["lf"])
    intake.add_request(7)
    began = time.monotonic()
    assert not intake.pop_batch(0.05, query=False)
    assert time.monotonic() - began > 0.04
    intake.offer(received("lf"))
    assert intake.pop_batch(5.0, query=False).samples
    assert intake.pop_batch(60.0).requests == [7]


def test_a_waiting_worker_wakes_at_once() -> None:
    intake: SampleQueue[object] = SampleQueue()
    threading.Timer(0.05, intake.offer, [received("lf")]).start()
    began = time.monotonic()
    assert intake.pop_batch(60.0).samples
    assert time.monotonic() - began < 30.0


def test_huge_payloads_are_refused_and_not_kept() -> None:
    intake: SampleQueue[object] = SampleQueue()
    intake.offer(received("lf", bytes(100 * MAX_SAMPLE_BYTES)))
    huge = intake.pop_batch(0.0).samples["lf"]
    assert len(huge.payload) == MAX_SAMPLE_BYTES + 1
    assert decode(huge.payload, ServoSample).reason is Reject.TOO_LARGE
