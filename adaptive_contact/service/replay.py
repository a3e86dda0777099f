"""Recordings played back: through the learners without a network, or onto the wire.

Through the learners a recording is a row of control ticks: consecutive samples until a leg comes
round again.  Time is the samples' own, so the same file gives the same events, as fast as the
learners can.  Onto the wire, messages go out at the distance in time at which they were recorded.
"""

from __future__ import annotations

import collections
import dataclasses
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, Protocol

import msgpack
import msgspec

from adaptive_contact.service.link import Link, Publisher
from adaptive_contact.service.recording import Record
from adaptive_contact.wire import (
    ContactEvent,
    Reject,
    Rejected,
    ServoSample,
    decode,
    is_json,
    is_leg_id,
    json_text,
    leg_of_key,
)

# What a source sends.  Events and status are the service's own to send, and a command would move
# whatever robot listens.
SOURCE_KINDS: Final = frozenset({"servo", "truth"})
# Zenoh 1.10 panics where a put that leaves the process has an encoding of 256 bytes (measured; one
# that begins with a type it knows may be longer), or a key of 64 kB, the namespace with it.
MAX_ENCODING_BYTES: Final = 255
MAX_KEY_BYTES: Final = 32_768
# What a concrete key of Zenoh does not have.
_NO_KEY: Final = re.compile(r"[*$?#]|^/|/$|//")
_NS_PER_S: Final = 1_000_000_000


class LegBank(Protocol):
    """What takes one control tick of samples and gives the events it decides."""

    def learner(self, leg: str, joints: int | None = None, /) -> object | None:
        """The leg's learner, None where it gets none."""

    def update(self, samples: Mapping[str, ServoSample], /) -> list[ContactEvent]:
        """Take in at most one sample per leg."""


@dataclasses.dataclass
class Counts:
    """What a replay met.

    Attributes:
        messages: of any key.
        samples: servo samples handed on.
        ticks: control ticks they came in.
        first_ns, last_ns: log time of the first and last message handed on.
        rejects: servo messages that could not be used, by reason.
    """

    messages: int = 0
    samples: int = 0
    ticks: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    rejects: collections.Counter[Reject] = dataclasses.field(default_factory=collections.Counter)

    @property
    def span_s(self) -> float:
        """Time between the first and the last message handed on, as recorded, s."""
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) / _NS_PER_S

    def hand_on(self, log_time_ns: int) -> None:
        """Note a message that is handed on."""
        if self.first_ns is None:
            self.first_ns = log_time_ns
        self.last_ns = log_time_ns


def control_ticks(
    records: Iterable[Record], wanted: Callable[[str, int], bool], counts: Counts
) -> Iterator[dict[str, ServoSample]]:
    """Servo samples of a recording, grouped by control tick.

    Args:
        records: messages in the order they were recorded; only servo samples are used.
        wanted: tells for a leg, and the joints of its first sample, whether it is used; samples of
            others are counted as unknown.
        counts: filled on the way.

    Yields:
        At most one sample per leg, in order of arrival.
    """
    tick: dict[str, ServoSample] = {}
    legs: dict[str, str | None] = {}  # by key; to parse it for each sample would cost a third
    for record in records:
        counts.messages += 1
        key = record.key
        if not key.endswith("/servo"):
            continue
        sample = decode(record.payload, ServoSample, record.encoding)
        if isinstance(sample, Rejected):
            counts.rejects[sample.reason] += 1
            continue
        if key not in legs:
            found = leg_of_key(key)
            use = found is not None and wanted(found, len(sample.measured))
            legs[key] = found if use else None
        leg = legs[key]
        if leg is None:
            counts.rejects[Reject.UNKNOWN_LEG] += 1
            continue
        counts.samples += 1
        if counts.first_ns is None:
            counts.first_ns = record.log_time_ns
        counts.last_ns = record.log_time_ns
        if leg in tick:
            counts.ticks += 1
            yield tick
            tick = {}
        tick[leg] = sample
    if tick:
        counts.ticks += 1
        yield tick


def replay_events(
    records: Iterable[Record], bank: LegBank, counts: Counts
) -> Iterator[ContactEvent]:
    """Events that the learners decide on a recording, in order.

    Args:
        records: of the recording.
        bank: the learners; they are advanced.
        counts: filled on the way.
    """

    def wanted(leg: str, joints: int) -> bool:
        return bank.learner(leg, joints) is not None

    for tick in control_ticks(records, wanted, counts):
        yield from bank.update(tick)


class WirePlayer:
    """Publishes a recording.

    A replay is a new start of the source: unless told to keep it, ``run`` is replaced in every
    servo sample, so that a service which has seen the recording before takes it for a restart
    rather than for time going backwards.

    Args:
        link: open session.
        speed: over the recorded one; None for as fast as the network takes it.
        everything: also events, status and commands that were recorded.
        keep_run: send servo samples byte for byte.
        run: base of the new values of ``run``.
    """

    def __init__(
        self,
        link: Link,
        speed: float | None = 1.0,
        *,
        everything: bool = False,
        keep_run: bool = False,
        run: int = 0,
    ) -> None:
        self._link = link
        self._speed = speed
        self._everything = everything
        self._keep_run = keep_run
        self._base = run
        self._runs: dict[object, int] = {}
        self._publishers: dict[str, Publisher] = {}
        self.counts = Counts()
        self.sent: collections.Counter[str] = collections.Counter()
        self.behind_s = 0.0

    def play(self, records: Iterable[Record], stop: threading.Event) -> None:
        """Publish until the end, or until ``stop`` is set.

        Messages that were recorded out of order go out without waiting.  :attr:`sent` counts by
        key, :attr:`behind_s` is the furthest that the schedule was missed by.
        """
        started_s: float | None = None
        for record in records:
            self.counts.messages += 1
            if not self._wanted(record.key):
                continue
            if (
                len(record.encoding.encode()) > MAX_ENCODING_BYTES
                or len(record.key.encode()) > MAX_KEY_BYTES
            ):
                self.counts.rejects[Reject.MALFORMED] += 1
                continue
            publisher = self._publisher(record.key)
            if started_s is None:
                started_s = time.monotonic()
            self.counts.hand_on(record.log_time_ns)
            if self._speed is not None:
                due_s = started_s + self.counts.span_s / self._speed
                wait_s = due_s - time.monotonic()
                self.behind_s = max(self.behind_s, -wait_s)
                if wait_s > 0:
                    stop.wait(wait_s)
            if stop.is_set():
                return
            payload = record.payload
            if record.key.endswith("/servo"):
                self.counts.samples += 1
                if not self._keep_run:
                    payload = self._with_new_run(payload, record.encoding)
            publisher.put_raw(payload, record.encoding)
            self.sent[record.key] += 1

    def _wanted(self, key: str) -> bool:
        if not key or _NO_KEY.search(key):
            return False  # a put on wildcards would reach every leg; others are no keys of Zenoh
        if self._everything:
            return True
        head, _, kind = key.rpartition("/")
        leg = head.removeprefix("robot/leg/")
        return kind in SOURCE_KINDS and head.startswith("robot/leg/") and is_leg_id(leg)

    def _publisher(self, key: str) -> Publisher:
        if key not in self._publishers:
            # As fast as possible means faster than some subscriber: there BLOCK must hold us back.
            self._publishers[key] = self._link.publisher(key, reliable=self._speed is None)
        return self._publishers[key]

    def _with_new_run(self, payload: bytes, encoding: str) -> bytes:
        """The same sample with another ``run``; bytes that are no sample stay as they are."""
        json = is_json(payload, encoding)
        try:
            fields = msgspec.json.decode(json_text(payload)) if json else msgpack.unpackb(payload)
        except (ValueError, msgpack.UnpackException, msgspec.DecodeError, RecursionError):
            return payload
        if not isinstance(fields, dict):
            return payload
        run = fields.get("run")
        if not isinstance(run, int | None):
            return payload
        fields["run"] = self._base + self._runs.setdefault(run, len(self._runs))
        try:
            return msgspec.json.encode(fields) if json else msgspec.msgpack.encode(fields)
        except (TypeError, ValueError, OverflowError):  # a type that samples do not have
            return payload
