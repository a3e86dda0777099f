"""Feeds a :class:`~adaptive_contact.service.watch.Watch` from a link."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Final

from adaptive_contact.service.link import Link
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.service.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.service.traffic import Received
from adaptive_contact.service.watch import View, Watch
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    ALL_TRUTH,
    MAX_PAYLOAD_BYTES,
    ContactEvent,
    ContactTruth,
    LearnerStatus,
    Rejected,
    decode,
    leg_of_key,
)

__all__ = ["Feed"]

OnContact = Callable[[str, ContactEvent | ContactTruth], None]

_KEPT: Final = 20_000


class Feed:
    """Subscribes to what a :class:`Watch` shows; call :meth:`view` as often as it is shown.

    Args:
        link: open; closed by its owner.
        on_contact: is given each contact event and change of truth that :meth:`view` takes in, with
            its leg.

    Attributes:
        watch: that is fed.
    """

    def __init__(self, link: Link, on_contact: OnContact | None = None) -> None:
        self._link = link
        self._on_contact = on_contact
        self.watch = Watch()
        # Zenoh's thread appends, the reader pops; should nobody read, the oldest go.
        self._waiting: deque[Received] = deque(maxlen=_KEPT)
        self._alive = False
        self.unreadable = 0
        link.watch_tokens(SERVICE_TOKEN, self._token)
        link.subscribe(SERVICE_STATUS, self._hear, history=True)
        link.subscribe(ALL_CONTACT, self._hear, history=True)
        link.subscribe(ALL_LEARNER, self._hear)
        link.subscribe(ALL_TRUTH, self._hear)

    def _hear(self, received: Received) -> None:
        if len(received.payload) <= MAX_PAYLOAD_BYTES:
            self._waiting.append(received)
        else:  # it would only be refused, and until then be kept
            self.unreadable += 1

    def view(self, now_ns: int) -> View:
        """Take in what has arrived, and give what is known now; ``now_ns`` is monotonic."""
        for _ in range(len(self._waiting)):
            self._take(self._waiting.popleft())
        return self.watch.view(now_ns, alive=self._alive, connected=self._link.is_connected())

    def _take(self, received: Received) -> None:
        kind = received.key.rsplit("/", 1)[-1]
        message = (
            decode(received.payload, ServiceStatus, received.encoding)
            if received.key == SERVICE_STATUS
            else decode(received.payload, ContactEvent, received.encoding)
            if kind == "contact"
            else decode(received.payload, LearnerStatus, received.encoding)
            if kind == "learner"
            else decode(received.payload, ContactTruth, received.encoding)
        )
        leg = leg_of_key(received.key)
        if isinstance(message, Rejected):
            self.unreadable += 1
            return
        if isinstance(message, ServiceStatus):
            self.watch.service(message)
        elif isinstance(message, ContactEvent):
            self.watch.event(message, received.arrival_ns, _age_ns(received))
        elif isinstance(message, LearnerStatus):
            self.watch.learner(message, received.arrival_ns)
        elif leg is not None:
            self.watch.truth(leg, message, received.arrival_ns)
        if self._on_contact is None or leg is None:
            return
        if isinstance(message, ContactEvent | ContactTruth):
            self._on_contact(leg, message)

    def _token(self, key: str, alive: bool) -> None:
        self._alive = alive


def _age_ns(received: Received) -> int:
    """How old a sample was on arrival, by the publisher's wall clock (0 where it has none)."""
    if received.published_ns is None:
        return 0
    arrived_ns = time.time_ns() - (time.monotonic_ns() - received.arrival_ns)
    return max(0, arrived_ns - received.published_ns)
