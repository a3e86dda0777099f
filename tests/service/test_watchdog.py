"""A worker that stands still, and a put that blocks, seen from outside."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import fake_service as fake
import pytest
from structlog.testing import capture_logs

from adaptive_contact.errors import LinkError
from adaptive_contact.robot import Robot
from adaptive_contact.service.event_publisher import EventPublisher
from adaptive_contact.service.link import Link
from adaptive_contact.service.server import Service
from adaptive_contact.service.watchdog import LOOK_S, Watchdog
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import ContactTruth, Message, ServoSample, servo_key
from rig import at_work
from waiting import until

S = 1_000_000_000

# `serve` with a learner that hangs at its first sample, and gives up sooner; what else hangs is
# the first argument.
HANGING = """
import sys, threading
import fake_service
from adaptive_contact.service import server, watchdog

what = sys.argv.pop(1)

def hangs(*_):
    while what == "the log":
        print("a line that nobody reads" * 100, file=sys.stderr)
    threading.Event().wait()

fake_service.FakeBank.detect_contacts = hangs
report = {"on_stall": hangs} if what == "the network" else {}
server.Watchdog = lambda *a, **k: watchdog.Watchdog(*a, **k | report, give_up_s=2.0)
fake_service.main()
"""


def message(n: int) -> Message:
    return ContactTruth(t_ns=n, contact=True, force=1.0)


def putting(does: Any) -> mock.Mock:
    """A publisher whose ``put`` does something, or raises it."""
    return mock.Mock(put=mock.Mock(side_effect=does))


class Gate:
    """A publisher that blocks until it is opened."""

    def __init__(self) -> None:
        self.open = threading.Event()
        self.entered = threading.Event()
        self.got: list[int] = []

    def put(self, message: Message) -> None:
        self.entered.set()
        assert self.open.wait(60)
        self.got.append(message.t_ns)


class Bench:
    """A watchdog on values of our choosing."""

    def __init__(self) -> None:
        self.beat = 0
        self.blocked_ns = 0
        self.stalls: list[float] = []
        self.ended = 0
        self.now_s = 0.0
        self.dog = Watchdog(
            lambda: self.beat,
            lambda _: self.blocked_ns,
            on_stall=self.stalls.append,
            on_end=self._end,
            clock_s=lambda: self.now_s,
        )

    def _end(self) -> None:
        self.ended += 1

    def check(self, times: int, *, beat: bool) -> None:
        for _ in range(times):
            self.beat += beat
            self.dog.check(0)


def test_a_stall_is_told_once_and_its_end_too() -> None:
    bench = Bench()
    with capture_logs() as logs:
        bench.check(1, beat=True)
        bench.check(8, beat=False)
        bench.check(3, beat=True)
    assert bench.dog.stalls == 1
    assert bench.stalls == [1.0, 1.25, 1.5, 1.75, 2.0]
    assert [line["event"] for line in logs] == ["worker stands still", "worker goes on"]
    assert bench.ended == 0


@pytest.mark.parametrize("stopped_s", [1.5, 60.0, 86_400.0])
def test_a_process_that_was_stopped_is_counted_once_and_goes_on(stopped_s: float) -> None:
    bench = Bench()
    with capture_logs() as logs:
        for k in range(20):
            bench.now_s += stopped_s if k == 10 else LOOK_S
            bench.check(1, beat=k != 10)  # the worker has not come round yet
    assert (bench.dog.stalls, bench.ended) == (1, 0)
    assert [line["event"] for line in logs] == ["process stood still"]


@pytest.mark.parametrize(
    ("beat", "blocked_s", "said"),
    [
        (False, 0, "worker stood still for too long, ending"),
        (True, 1, "an event could not be sent, ending"),
    ],
)
def test_half_a_minute_is_the_end(beat: bool, blocked_s: int, said: str) -> None:
    bench = Bench()
    bench.check(1, beat=True)
    bench.blocked_ns = blocked_s * S
    with capture_logs() as logs:
        bench.check(round(29.0 / LOOK_S), beat=beat)
        assert bench.ended == 0
        bench.check(round(2.0 / LOOK_S), beat=beat)
    assert bench.ended == 1
    assert [line["event"] for line in logs if line["log_level"] == "critical"] == [said]


def test_a_put_that_blocks_is_told_once() -> None:
    bench = Bench()
    with capture_logs() as logs:
        for blocked_s in (0.1, 0.6, 0.9, 0.0, 0.7):
            bench.blocked_ns = int(blocked_s * S)
            bench.check(1, beat=True)
    assert [line["event"] for line in logs] == ["contact events are held up"] * 2


def test_a_blocked_put_holds_only_the_outbox_up_and_the_oldest_are_counted_as_lost() -> None:
    box, gate = EventPublisher(size=4), Gate()
    box.start()
    box.post(gate, message(0), 0)
    assert gate.entered.wait(60)
    for n in range(1, 11):
        box.post(gate, message(n), 0)  # returns at once
    assert box.busy_ns(time.monotonic_ns() + S) >= S
    assert box.lost == 6
    gate.open.set()
    box.close(5.0)
    assert gate.got == [0, 7, 8, 9, 10]
    assert box.busy_ns(time.monotonic_ns()) == 0


@pytest.mark.parametrize("held_s", [0, 2])
def test_slow_puts_and_closed_links_are_counted(
    monkeypatch: pytest.MonkeyPatch, held_s: int
) -> None:
    """Only a link that was seen to take nothing makes its subscriber the cause."""

    now = [0]

    def takes_a_second(_: Message) -> None:
        now[0] += S

    monkeypatch.setattr(
        "adaptive_contact.service.event_publisher.time.monotonic_ns", lambda: now[0]
    )
    box = EventPublisher(lambda: held_s * S)
    with capture_logs() as logs:
        now[0] = S
        box.post(putting(takes_a_second), message(1), now[0])
        box.post(putting(LinkError("closed")), message(2), now[0])
        for _ in range(2):  # braked: the next line within a while would say how often
            box.post(putting(TypeError("no such thing")), message(3), now[0])
        box.missed(3, "links dropped that held up contact events")
    late = held_s < 1
    assert (box.slow, box.late, box.lost, box.cut_off) == (1, late, 3, 3)
    assert box.latency.quantiles().max == 1000.0
    assert box.dropped_within(now[0] + S, S)
    assert not box.dropped_within(now[0] + S + 1, S)
    held, lost, broken, dropped = logs
    assert (held["event"], held["for_ms"]) == ("contact events held up", 1000)
    assert ("subscriber" in held["by"]) is not late
    assert (lost["event"], lost["why"], lost["times"]) == ("contact events lost", "closed", 1)
    assert (broken["event"], broken["why"]) == ("contact events lost", "TypeError: no such thing")
    assert dropped["event"].startswith("links dropped that held up contact events")
    assert dropped["times"] == 3


def test_what_waits_at_the_end_is_counted_as_lost_and_not_sent_after_all() -> None:
    box, gate = EventPublisher(), Gate()
    before = set(threading.enumerate())
    box.start()
    (sender,) = set(threading.enumerate()) - before
    box.post(gate, message(0), 0)
    assert gate.entered.wait(60)
    for n in range(1, 10):
        box.post(gate, message(n), 0)
    with capture_logs() as logs:
        box.close(0.01)
        assert box.lost == 9, "the one being put may arrive yet"
        box.post(gate, message(10), 0)  # nobody is left to send it
        box.close(60.0)
        assert box.busy_ns(time.monotonic_ns() + S) >= S, "waited for once, not twice"
    (line,) = logs
    assert (line["event"], line["why"], line["times"]) == (
        "contact events lost",
        "not sent by the end",
        9,
    )
    gate.open.set()
    sender.join(5)
    assert (gate.got, box.lost) == ([0], 10)


def test_what_is_held_up_now_is_told(
    router: Link, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked_ns = [0]
    monkeypatch.setattr(EventPublisher, "busy_ns", lambda _box, now_ns: blocked_ns[0])
    router.sockets.close()  # looks no more
    service = Service(router, fake.FakeBank(robot), robot, baseline=None, now_ns=0)
    computer = "this computer, overloaded or stopped, has held up contact events for 1.2 s"
    for blocked, held_s, note in (
        (0.4, 9, None),
        (1.23, 9, "a subscriber that hangs has held up contact events for 1.2 s"),
        (1.23, 8, computer),
    ):
        blocked_ns[0], router.sockets.held_ns = int(blocked * S), held_s * S
        assert service.status(10 * S).note == note


def test_a_learner_that_hangs_is_seen_by_everyone(
    router: Link,
    join: Callable[..., Link],
    inbox: Any,
    robot: Robot,
    sample: Callable[..., ServoSample],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bank = fake.FakeBank(robot)
    hang = threading.Event()

    def detect_contacts(samples: Any) -> list[Any]:
        hang.wait(60)
        return []

    monkeypatch.setattr(bank, "detect_contacts", detect_contacts)
    service = Service(router, bank, robot, baseline=None, now_ns=time.monotonic_ns())
    client = join(router.endpoints[0])
    got = inbox(ServiceStatus).subscribe(client, SERVICE_STATUS, history=True)
    with at_work(service, hang):
        got.wait(1)
        client.publisher(servo_key("lf")).put(sample(1))
        told = got.wait(lambda items: items[-1].note is not None)[-1]
        assert told.note.startswith("the worker has stood still for 1.")
        assert told.stalls == 1
        hang.set()
        assert got.wait(lambda items: items[-1].note is None)[-1].stalls == 1


@pytest.mark.e2e
@pytest.mark.parametrize("too", ["nothing", "the network", "the log"])
def test_a_service_whose_worker_hangs_ends_with_code_70(
    program: Any,
    config: Path,
    join: Callable[..., Link],
    sample: Callable[..., ServoSample],
    tmp_path: Path,
    too: str,
) -> None:
    log = tmp_path / "log"
    reader, unread = os.pipe()
    with log.open("w") as file:
        service = program(
            *("-c", HANGING, too, "--config", config),
            *("--listen", "127.0.0.1:0", "--no-state"),
            stderr=unread if too == "the log" else file,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        )
    try:
        source = join(service.wait_line("listening on ([^;]+);")[1])
        publisher = source.publisher(servo_key("lf"))
        until(lambda: publisher.matched)
        publisher.put(sample(1))
        assert service.wait() == 70
    finally:
        os.close(reader)
        os.close(unread)
    if too != "the log":
        text = log.read_text()
        assert "worker stands still" in text
        assert "worker stood still for too long, ending" in text
        assert "in hangs" in text, "the stack that hung"
