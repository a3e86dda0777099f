"""A robot of made-up legs, a listener that judges events, a router to kill and a wire to cut.

The fake learner says contact where ``measured[0]`` is off by more than 0.2 rad; the robot's legs
touch for ten ticks and are free for ten, so that what every event must say is known.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console

from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.watch import Feed
from adaptive_contact.service.watch_table import headline, table
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    MSGPACK,
    ContactEvent,
    LearnerStatus,
    ServoSample,
    decode,
    servo_key,
)
from adaptive_contact.wire.received import Received
from programs import Program
from waiting import Every, until

HALF = 10  # ticks of contact, ticks without
S = 1_000_000_000

# Subscribers that hang when their process is stopped: foreign ones, with Zenoh's own settings but
# for the lease (ms; that of our own commands), after which a router gives a silent link up.
FOREIGN = """
import json, sys, threading, zenoh
config, lease = (*sys.argv[3:], None, None)[:2]
kept = []
for _ in range(int(sys.argv[2])):
    zenoh_config = zenoh.Config() if config is None else zenoh.Config.from_file(config)
    zenoh_config.insert_json5("mode", '"client"')
    zenoh_config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
    zenoh_config.insert_json5("transport/link/tx/lease", lease or "2000")
    session = zenoh.open(zenoh_config)
    kept += [session, session.declare_subscriber("robot/**", lambda sample: None)]
print("subscribed", flush=True)
threading.Event().wait()
"""

# Carries bytes both ways until its process is stopped; says where it listens.
PROXY = """
import asyncio, sys
host, _, port = sys.argv[1].rpartition(":")

async def carry(reader, writer):
    while data := await reader.read(65536):
        writer.write(data)
        await writer.drain()
    writer.close()

async def join(reader, writer):
    there, back = await asyncio.open_connection(host, int(port))
    await asyncio.gather(carry(reader, back), carry(there, writer), return_exceptions=True)

async def main():
    server = await asyncio.start_server(join, "127.0.0.1", 0, backlog=1024)
    print("127.0.0.1:%d" % server.sockets[0].getsockname()[1], flush=True)
    await server.serve_forever()

asyncio.run(main())
"""


def touches(seq: int) -> bool:
    """Whether the robot's legs touch in a tick."""
    return seq % (2 * HALF) >= HALF


class Robot50(Every):
    """Publishes legs at 50 Hz until closed, whatever happens to the network."""

    def __init__(
        self,
        endpoint: str,
        legs: tuple[str, ...] = ("rf",),
        *,
        run: int | None = None,
        zenoh_config: Path | None = None,
        touch: Callable[[int], bool] = touches,
    ) -> None:
        self.link = Link.open(client_settings([endpoint], wait=False, zenoh_config=zenoh_config))
        self.touch = touch
        self.publishers = {leg: self.link.publisher(servo_key(leg)) for leg in legs}
        self.seq = 0
        self.run_id = run
        self.sent_at: dict[int, float] = {}
        super().__init__(0.02, self._tick)

    def _tick(self) -> None:
        off = 0.5 if self.touch(self.seq) else 0.0
        sample = ServoSample(
            t_ns=S + self.seq * 20_000_000,
            seq=self.seq,
            measured=[off, 0.1, 0.2],
            desired=[0.0, 0.1, 0.2],
            run=self.run_id,
        )
        self.sent_at[self.seq] = time.monotonic()
        for publisher in self.publishers.values():
            publisher.put(sample)
        self.seq += 1

    def close(self) -> None:
        super().close()
        self.link.close()


class Bulk(Every):
    """Publishes 3 MB/s of what is no sample, until closed."""

    def __init__(self, endpoint: str, leg: str, *, zenoh_config: Path | None = None) -> None:
        self.link = Link.open(client_settings([endpoint], wait=False, zenoh_config=zenoh_config))
        self.publisher = self.link.publisher(servo_key(leg))
        super().__init__(0.01, lambda: self.publisher.put_raw(bytes(30_000), MSGPACK))

    def close(self) -> None:
        super().close()
        self.link.close()


def uncounted(before: LearnerStatus, after: LearnerStatus) -> int:
    """Samples of a :class:`Robot50` between two statuses of a leg that no counter has."""
    sent = (after.t_ns - before.t_ns) // 20_000_000
    return sent - (after.ticks + after.missed - before.ticks - before.missed)


class Listener:
    """Keeps events and statuses of all legs, with the time of their arrival."""

    def __init__(self, endpoint: str, *, zenoh_config: Path | None = None) -> None:
        self.link = Link.open(client_settings([endpoint], wait=False, zenoh_config=zenoh_config))
        self.events: list[tuple[float, ContactEvent]] = []
        self.statuses: dict[str, LearnerStatus] = {}
        self.link.subscribe(ALL_CONTACT, self._event, history=True)
        self.link.subscribe(ALL_LEARNER, self._status)

    def _event(self, received: Received) -> None:
        event = decode(received.payload, ContactEvent, received.encoding)
        assert isinstance(event, ContactEvent)
        self.events.append((received.arrival_ns / 1e9, event))

    def _status(self, received: Received) -> None:
        status = decode(received.payload, LearnerStatus, received.encoding)
        self.statuses[status.leg] = status

    def wait(self, test: Any, timeout_s: float = 30.0) -> None:
        """Wait until ``test(self)`` holds."""
        until(lambda: test(self), lambda: (self.statuses, self.events[-3:]), timeout_s)

    def wait_event(
        self, leg: str, robot: Robot50, *, after: float, timeout_s: float = 30.0
    ) -> float:
        """When the first event on a sample that a robot sent after a moment arrived.

        It must be right.  What was sent before and only comes late does not count: a leg that has
        not caught up is not well again.
        """

        def fresh(pair: tuple[float, ContactEvent]) -> bool:
            at, event = pair
            return event.leg == leg and at > after and robot.sent_at.get(event.seq, 0.0) > after

        self.wait(lambda me: any(map(fresh, me.events)), timeout_s)
        at, event = next(filter(fresh, self.events))
        assert event.contact == touches(event.seq)
        return at

    def steady(self, robot: Robot50, leg: str, count: int = 4) -> None:
        """From now on every change must come, once, at the tick at which it happens."""
        begin = len(self.events)
        self.wait(lambda me: len(me.of(leg, begin)) >= count)
        seqs = [event.seq for event in self.of(leg, begin)]
        assert all(event.contact == touches(event.seq) for event in self.of(leg, begin))
        assert [b - a for a, b in itertools.pairwise(seqs)] == [HALF] * (len(seqs) - 1)

    def of(self, leg: str, begin: int = 0) -> list[ContactEvent]:
        return [event for _, event in self.events[begin:] if event.leg == leg]

    def close(self) -> None:
        self.link.close()


class Wire:
    """A wire between a client and a router that can be cut: nothing passes, nobody is told."""

    def __init__(self, endpoint: str) -> None:
        self._proxy = Program("-c", PROXY, endpoint.removeprefix("tcp/"))
        self.endpoint = f"tcp/{self._proxy.wait_line('127').string}"

    def cut(self) -> None:
        self._proxy.process.send_signal(signal.SIGSTOP)

    def mend(self) -> None:
        self._proxy.process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self._proxy.close()


@contextlib.contextmanager
def at_work(service: Any, *held: threading.Event) -> Iterator[None]:
    """Run a service in a thread; events that hold it up are set at the end."""
    stop = threading.Event()
    worker = threading.Thread(target=service.run, args=[stop])
    worker.start()
    try:
        yield
    finally:
        for event in (*held, stop):
            event.set()
        worker.join(10)
    assert not worker.is_alive()


@contextlib.contextmanager
def closing(*things: Any) -> Iterator[None]:
    """Close them, last first, whatever happens."""
    with contextlib.ExitStack() as stack:
        for thing in things:
            stack.callback(thing.close)
        yield


def watched(link: Link, line: str = "", timeout_s: float = 20.0) -> str:
    """What `watch` shows, once it has every status, and shows a line."""
    feed = Feed(link)
    shown = ""

    def found() -> bool:
        nonlocal shown
        view = feed.view(time.monotonic_ns())
        if view.service is None or any(leg.status is None for leg in view.legs):
            return False
        text = io.StringIO()
        Console(file=text, width=240).print(table(view))
        # The lines over the table as they are, not as they are folded to its width.
        shown = f"{headline(view).plain}\n{text.getvalue()}"
        return line in shown

    until(found, lambda: f"'{line}' is not in {shown or 'nothing'}", timeout_s)
    return shown
