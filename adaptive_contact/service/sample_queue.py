"""Queues samples between Zenoh's callbacks and the worker, bounded per leg.

The callback side parses nothing but the key and never waits.  The worker takes rounds of at
most one sample per leg, so a leg that floods delays the others by one sample, whatever its
rate; what it sends beyond its own queue is dropped, oldest first, and counted.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

from adaptive_contact.wire import MAX_SAMPLE_BYTES, leg_of_key
from adaptive_contact.wire.received import Received

# The queue of all legs that have none: no leg's id, it is counted under that name.
NO_QUEUE: Final = "(without a learner)"


R = TypeVar("R")


# With their legs.
_Queue = deque[tuple[str, Received]]


@dataclass(slots=True)
class Batch(Generic[R]):
    """Holds what the worker takes in one round."""

    # at most one payload per leg, the oldest; and one of all legs without a queue
    samples: dict[str, Received] = field(default_factory=dict)
    # payloads dropped since the last round, per leg
    overflow: Counter[str] = field(default_factory=Counter)
    strangers: int = 0  # payloads on keys that name no usable leg, since the last round
    stranger: str | None = None  # one such key, for the log
    requests: list[R] = field(default_factory=list)  # queries

    def __bool__(self) -> bool:
        return bool(self.samples or self.overflow or self.strangers or self.requests)


class SampleQueue(Generic[R]):
    """Queues payloads per leg, bounded; filled on Zenoh's threads, emptied by one worker.

    Payloads of legs that have no queue wait in one, whatever they call themselves.

    Args:
        legs: ids that have a queue from the start.
        queue_samples: payloads held per leg, and of all legs without a queue.
    """

    def __init__(
        self,
        legs: Iterable[str] = (),
        *,
        # At 50 Hz this is 1.3 s of one leg: a worker that is further behind has failed anyway, and
        # old samples are worth less than new ones.
        queue_samples: int = 64,
    ) -> None:
        self._queue_samples = queue_samples
        self._queues: dict[str, _Queue] = {leg: deque() for leg in (*legs, NO_QUEUE)}
        self._next: Batch[R] = Batch()  # counts what the next round reports
        self._requests: deque[R] = deque()
        self._awake = threading.Condition()

    def offer(self, received: Received) -> None:
        """Queue a sample; never waits for the worker, never raises on what it was given."""
        leg = leg_of_key(received.key)
        if len(received.payload) > MAX_SAMPLE_BYTES:
            # It will be refused, and 64 of them would hold 256 MB.
            received = received._replace(payload=received.payload[: MAX_SAMPLE_BYTES + 1])
        with self._awake:
            if leg is None:
                self._next.strangers += 1
                self._next.stranger = received.key
            else:
                self._enqueue(leg, received)
            self._awake.notify()

    def open(self, leg: str) -> None:
        """Give a leg a queue of its own."""
        with self._awake:
            self._queues[leg] = deque()

    def add_request(self, request: R) -> bool:
        """Queue a query; return False where too many wait already."""
        with self._awake:
            # Queries waiting for the worker; an asker beyond them is refused at once.
            if len(self._requests) >= 64:
                return False
            self._requests.append(request)
            self._awake.notify()
        return True

    def pop_batch(self, timeout_s: float, *, query: bool = True) -> Batch[R]:
        """Remove and return what waits, or wait for it.

        Args:
            timeout_s: longest wait; 0 or less does not wait.
            query: whether one may be among it.

        Returns:
            A round; empty after a timeout.
        """
        with self._awake:
            if timeout_s > 0 and not self._waiting(query):
                self._awake.wait(timeout_s)
            round_, self._next = self._next, Batch()
            round_.samples = dict(queue.popleft() for queue in self._queues.values() if queue)
            if query and self._requests:
                # One: an answer takes a millisecond, and samples wait meanwhile.
                round_.requests.append(self._requests.popleft())
        return round_

    def _enqueue(self, leg: str, received: Received) -> None:
        name = leg if leg in self._queues else NO_QUEUE
        queue = self._queues[name]
        if len(queue) >= self._queue_samples:
            queue.popleft()
            self._next.overflow[name] += 1
        queue.append((leg, received))

    def _waiting(self, query: bool) -> bool:
        asked = query and self._requests
        return bool(asked or self._next or any(self._queues.values()))
