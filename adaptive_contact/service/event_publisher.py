"""Publishes contact events, on a thread of its own.

An event is put reliably, so links that take nothing any more hold the put up, until the service
drops them (:mod:`adaptive_contact.service.sockets`).  The learners must not wait for that: the
worker only appends, and what cannot be sent for so long that the queue is full is dropped, oldest
first, and counted; so is what is left at the end.  Each put that was slow, or failed, is logged:
the watchdog sees only those that go on.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

import structlog

from adaptive_contact.errors import LinkError
from adaptive_contact.service.link import Publisher
from adaptive_contact.service.logs import LogThrottle
from adaptive_contact.status import Latency
from adaptive_contact.wire import Message

_log = structlog.get_logger()

# A put that has gone on for so long is reported before it ends.
HELD_UP_NS: Final = 500_000_000
_SUBSCRIBER: Final = "a subscriber that hangs"
_COMPUTER: Final = "this computer, overloaded or stopped,"


# A message, where to, and when the sample came that it is about.
_Letter = tuple[Publisher, Message, int]


class EventPublisher:
    """Sends messages in order, on the caller's thread until :meth:`start`, then on its own.

    Args:
        held_ns: when a link was last seen that took nothing, monotonic.
        size: messages that wait at most.
    """

    # A robot has some ten events a second; this is more than a minute of them.
    def __init__(self, held_ns: Callable[[], int] = lambda: 0, size: int = 1024) -> None:
        self._held_ns = held_ns
        # messages dropped because the queue was full, that could not be put, or that were left at
        # the end
        self.lost = 0
        self.slow = 0  # puts that took longer than a tenth of a second
        self.late = 0  # of these, the ones that no link held up
        # links dropped because they held up a put, or lost because their subscribers took nothing
        # any more: these miss events
        self.cut_off = 0
        self._throttle = LogThrottle()
        self._size = size
        self._queue: deque[_Letter] = deque()
        self._changed = threading.Condition()
        self._ending = False
        self._thread: threading.Thread | None = None
        self._putting_since_ns: int | None = None
        self._dropped_ns: int | None = None
        # From the deciding sample received to its event sent; the sending thread adds.
        self.latency = Latency()

    def start(self) -> None:
        """Send on a thread from now on."""
        self._thread = threading.Thread(target=self._run, name="outbox", daemon=True)
        self._thread.start()

    def close(self, timeout_s: float = 0.5) -> None:
        """Send what waits, as far as that goes in time, count the rest as lost, and end.

        A put that goes on beyond that is not counted: it may yet arrive, and is counted by itself
        if it fails.  Calling close() twice is safe.
        """
        with self._changed:
            if self._ending:
                return
            self._ending = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)
        with self._changed:
            left = len(self._queue)
            self._queue.clear()  # what is counted as lost must not be sent after all
            self.lost += left
        if left:
            _log.warning("contact events lost", why="not sent by the end", times=left)

    def post(self, publisher: Publisher, message: Message, arrival_ns: int) -> None:
        """Send a message; waits for nothing once the thread runs."""
        if self._thread is None:
            self._publish(publisher, message, arrival_ns)
            return
        with self._changed:
            if self._ending:  # the sender may be gone
                self.lost += 1
                return
            if len(self._queue) >= self._size:
                self._queue.popleft()
                self.lost += 1
            self._queue.append((publisher, message, arrival_ns))
            self._changed.notify_all()

    def missed(self, links: int, what: str) -> None:
        """Count links that miss events, and say what became of them."""
        now_ns = self._dropped_ns = time.monotonic_ns()
        self.cut_off += links
        self._throttle.warn(
            what, now_ns, f"{what}: their subscribers hang or are gone", times=links
        )

    def dropped_within(self, now_ns: int, span_ns: int) -> bool:
        """Return whether a link was dropped or lost in the last ``span_ns``."""
        return self._dropped_ns is not None and now_ns - self._dropped_ns <= span_ns

    def busy_ns(self, now_ns: int) -> int:
        """Return how long the put under way has been going on, ns; 0 when there is none."""
        since_ns = self._putting_since_ns
        return 0 if since_ns is None else max(0, now_ns - since_ns)

    def held_up(self, now_ns: int) -> str | None:
        """Return one line on a put that has gone on for too long, and its cause; else None."""
        for_ns = self.busy_ns(now_ns)
        if for_ns <= HELD_UP_NS:
            return None
        who = _SUBSCRIBER if self._held_ns() >= now_ns - for_ns else _COMPUTER
        return f"{who} has held up contact events for {for_ns / 1e9:.1f} s"

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._queue) or self._ending)
                if not self._queue:
                    return
                letter = self._queue.popleft()
            self._publish(*letter)

    def _publish(self, publisher: Publisher, message: Message, arrival_ns: int) -> None:
        began_ns = self._putting_since_ns = time.monotonic_ns()
        try:
            publisher.put(message)
        except Exception as fault:  # a closed link, or a fault of ours: the next must go out
            with self._changed:  # others count, too
                self.lost += 1
            kind = type(fault).__name__
            why = str(fault) if isinstance(fault, LinkError) else f"{kind}: {fault}"
            self._throttle.warn(kind, time.monotonic_ns(), "contact events lost", why=why)
            return
        finally:
            self._putting_since_ns = None
        done_ns = time.monotonic_ns()
        self.latency.add(done_ns - arrival_ns)
        # A put takes 0.05 ms; a tenth of a second means that a subscriber hangs, or that
        # the computer has no core for it.
        if done_ns - began_ns > 100_000_000:
            late = self._held_ns() < began_ns
            self.slow += 1
            self.late += late
            who = _COMPUTER if late else _SUBSCRIBER
            for_ms = round((done_ns - began_ns) / 1e6)
            self._throttle.warn(who, done_ns, "contact events held up", by=who, for_ms=for_ms)
