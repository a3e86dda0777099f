"""Plays recordings back: through the learners without a network, or onto the wire.

Through the learners a recording is a row of control ticks: consecutive samples until a leg comes
round again.  Time is the samples' own, so the same file gives the same events, as fast as the
learners can.  Onto the wire, messages go out at the distance in time at which they were recorded.

What a replay decided and why: per leg the test ratio of every tick, events, and truth.

The test ratio of a tick is the statistic over its threshold, the largest of its windows; above 1 is
a contact.  A touch that was missed is judged by the largest ratio while it could have been found:
0.6 is 40 % below the threshold.
"""

from __future__ import annotations

import collections
import dataclasses
import re
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import msgspec
import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.core.bank import LearnerBank
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.score import ROWS, Contacts, Gatherer, LegOutcome, contacts_of, match
from adaptive_contact.service.link import Link, Publisher
from adaptive_contact.service.recording import Record
from adaptive_contact.service.settings import SILENT_AFTER_S
from adaptive_contact.service.trace import Judged, judged_tick
from adaptive_contact.wire import (
    JSON,
    MSGPACK,
    NS_PER_S,
    ContactEvent,
    Reject,
    Rejected,
    ServoSample,
    decode,
    encode,
    is_json,
    leg_of_key,
)


@dataclasses.dataclass
class Counts:
    """Counts what a replay read and handed on."""

    messages: int = 0  # of any key
    samples: int = 0  # servo samples handed on
    ticks: int = 0  # control ticks they came in
    # first_ns, last_ns: log time of the first and last message handed on
    first_ns: int | None = None
    last_ns: int | None = None
    # servo messages that could not be used, by reason
    rejects: collections.Counter[Reject] = dataclasses.field(default_factory=collections.Counter)

    @property
    def span_s(self) -> float:
        """Return the recorded time between the first and the last message handed on, s."""
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) / NS_PER_S

    def hand_on(self, log_time_ns: int) -> None:
        """Count a message that is handed on."""
        if self.first_ns is None:
            self.first_ns = log_time_ns
        self.last_ns = log_time_ns


def control_ticks(
    records: Iterable[Record], wanted: Callable[[str, int], bool], counts: Counts
) -> Iterator[dict[str, ServoSample]]:
    """Yield the servo samples of a recording, grouped by control tick.

    Args:
        records: messages in the order they were recorded; only servo samples are used.
        wanted: returns for a leg, and the joints of its first sample, whether it is used; samples
            of others are counted as unknown.
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
        counts.hand_on(record.log_time_ns)
        if leg in tick:
            counts.ticks += 1
            yield tick
            tick = {}
        tick[leg] = sample
    if tick:
        counts.ticks += 1
        yield tick


def replay_events(
    records: Iterable[Record], bank: LearnerBank | TraceBank, counts: Counts
) -> Iterator[ContactEvent]:
    """Yield the events that the learners decide on a recording, in order."""
    for tick in control_ticks(
        records, lambda leg, joints: bank.learner(leg, joints) is not None, counts
    ):
        yield from bank.update(tick)


class WirePlayer:
    """Publishes a recording.

    A replay is a new start of the source: unless it is to be kept, ``run`` is replaced in every
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
        self._runs: dict[int | None, int] = {}
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
                # Zenoh 1.10 panics where a put that leaves the process has an encoding of 256 bytes
                # (measured; one that begins with a type it knows may be longer), or a key of 64 kB,
                # the namespace with it.
                len(record.encoding.encode()) > 255 or len(record.key.encode()) > 32_768
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
        # What a concrete key of Zenoh does not have.
        if not key or re.search(r"[*$?#]|^/|/$|//", key):
            return False  # a put on wildcards would reach every leg; others are no keys of Zenoh
        if self._everything:
            return True
        # What a source sends.  Events and status are the service's own to send, and a command would
        # move whatever robot listens.
        return key.rpartition("/")[2] in ("servo", "truth") and leg_of_key(key) is not None

    def _publisher(self, key: str) -> Publisher:
        if key not in self._publishers:
            # As fast as possible means faster than some subscriber: there BLOCK must hold us back.
            self._publishers[key] = self._link.publisher(key, reliable=self._speed is None)
        return self._publishers[key]

    def _with_new_run(self, payload: bytes, encoding: str) -> bytes:
        """Give a sample a new ``run``; bytes that are no sample stay as they are."""
        sample = decode(payload, ServoSample, encoding)
        if isinstance(sample, Rejected):
            return payload
        run = self._base + self._runs.setdefault(sample.run, len(self._runs))
        fresh = msgspec.structs.replace(sample, run=run)
        return encode(fresh, JSON if is_json(payload, encoding) else MSGPACK)


Spans = list[tuple[float, float]]


@dataclasses.dataclass(frozen=True, slots=True)
class Touch:
    """Describes a touch of the truth, or a contact that is reported without one."""

    at_s: float  # its onset, or the deciding sample of a false one
    # `hit`, `miss`, `beyond` (missed, but of a row that may be beyond any detector) or
    # `false`
    kind: str
    why: str  # one line for the operator


@dataclasses.dataclass(frozen=True, slots=True)
class LegTrace:
    """Holds one leg over a recording, times in s since its first sample."""

    leg: str
    t_s: Array  # (n,) of its samples
    ratio: Array  # (n,) test ratio, NaN where the tick could not be judged
    p: Array  # (n,) probability that the foot carries, NaN while unknown
    stance: Spans  # spans of commanded stance
    contact: Spans  # spans of reported contact
    truth: Spans | None  # spans of true contact; None where the recording has no truth
    touches: tuple[Touch, ...]  # what is to be looked at, in order of time
    joints: Sequence[str]  # their names
    angles: Array  # (n, 3, J) rad, measured, desired and predicted, in the source's; NaN if not
    note: str | None = None  # why touches were not judged, where they were not


class _Ticks:
    """Stores the ticks of one leg."""

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = joints
        # t_ns, ratio, p, angles: as of LegTrace, the angles row by row
        self.t_ns = array("q")
        self.ratio = array("d")
        self.p = array("d")
        self.angles = array("f")

    def add(self, sample: ServoSample, judged: Judged | None, p: float | None) -> None:
        """Append a tick."""
        unknown = [np.nan] * len(self.joints)
        self.t_ns.append(sample.t_ns)
        self.ratio.append(np.nan if judged is None else judged.test_ratio)
        self.p.append(np.nan if p is None else p)
        predicted = unknown if judged is None else judged.predicted
        for row in (sample.measured, sample.desired, predicted):
            self.angles.extend(row if len(row) == len(unknown) else unknown)


class TraceBank:
    """Records how each tick was judged, around a bank; used in place of the bank of a replay."""

    def __init__(self, bank: LearnerBank) -> None:
        self._bank = bank
        self._gathered = Gatherer(bank.robot)
        self._ticks: dict[str, _Ticks] = {}
        self._events: list[ContactEvent] = []

    def learner(self, leg: str, joints: int | None = None, /) -> object | None:
        """Return the bank's learner of a leg."""
        return self._bank.learner(leg, joints)

    def update(self, samples: Mapping[str, ServoSample], /) -> list[ContactEvent]:
        """Update the bank by samples, and record how each was judged."""
        robot = self._bank.robot
        learners = {leg: self._bank.learner(leg) for leg in samples}
        known = {leg: learner for leg, learner in learners.items() if learner is not None}
        before = {leg: learner.place.leg.t_ns for leg, learner in known.items()}
        events = self._bank.detect_contacts(samples)
        for leg, learner in known.items():
            sample = samples[leg]
            if leg not in self._ticks:
                numbers = [f"joint {j}" for j in range(len(sample.measured))]
                named = robot.leg(leg).joints if leg in robot.leg_ids else numbers
                self._ticks[leg] = _Ticks(named)
            used = learner.place.leg.t_ns != before[leg]
            judged = judged_tick(learner, sample) if used else None
            self._ticks[leg].add(sample, judged, learner.state.p if used else None)
        self._bank.learn_from_tick()
        self._events += events
        return events

    def gather(self, records: Iterable[Record]) -> Iterator[Record]:
        """Pass records on, and keep of them what the score needs."""
        for record in records:
            self._gathered.add_message(record)
            yield record

    def traces(self) -> list[LegTrace]:
        """Combine what was decided with what the gathered records say."""
        gathered = self._gathered
        gathered.replace_events(self._events)
        legs = [leg for leg in gathered.legs if leg in self._ticks]
        start_ns = min((self._ticks[leg].t_ns[0] for leg in legs), default=0)
        return [self._trace(leg, gathered, start_ns) for leg in legs]

    def _trace(self, leg: str, gathered: Gatherer, start_ns: int) -> LegTrace:
        ticks = self._ticks[leg]
        t_ns = np.array(ticks.t_ns, dtype=np.int64)
        ratio = np.array(ticks.ratio, dtype=np.float64)
        angles = np.array(ticks.angles, dtype=np.float64)
        events = [event for event in self._events if event.leg == leg]
        end_ns = int(t_ns.max(initial=start_ns))
        # Nothing is known from a leg's last sample on until something is said of it again.
        gaps = t_ns[:-1][np.diff(t_ns) > int(SILENT_AFTER_S * NS_PER_S)].tolist()
        ends = [(t, False) for t in gaps]
        decided = [(event.t_ns, event.contact) for event in events]
        reported = _spans([*decided, *ends], start_ns, end_ns)
        stance: Spans = []
        truth: Spans | None = None
        touches: list[Touch] = []
        note = None
        try:
            stream = gathered.stream(leg)
        except (ConfigurationError, RecordingError) as error:
            note = str(error)
        else:
            changes = [(int(t), not s) for t, s in zip(stream.t_ns, stream.swing, strict=True)]
            stance = _spans([*changes, *ends], start_ns, end_ns)
            if leg in gathered.legs_with_truth:
                contacts = contacts_of(stream.truth, int(stream.t_ns[0]))
                truth = [
                    ((begin - start_ns) / NS_PER_S, (min(end, end_ns) - start_ns) / NS_PER_S)
                    for begin, end in zip(
                        contacts.onset_ns.tolist(), contacts.release_ns.tolist(), strict=True
                    )
                ]
                touches = _touches(
                    match(stream, gathered.events(leg)), contacts, t_ns, ratio, events, start_ns
                )
        return LegTrace(
            leg=leg,
            t_s=(t_ns - start_ns) / NS_PER_S,
            ratio=ratio,
            p=np.array(ticks.p, dtype=np.float64),
            stance=stance,
            contact=reported,
            truth=truth,
            touches=tuple(touches),
            joints=ticks.joints,
            angles=angles.reshape(len(t_ns), 3, -1),
            note=note,
        )


def _spans(changes: list[tuple[int, bool]], start_ns: int, end_ns: int) -> Spans:
    """Return the spans in which a state holds, s; of changes at one time the last counts."""
    spans: Spans = []
    since: int | None = None
    for at_ns, holds in [*sorted(changes, key=lambda change: change[0]), (end_ns, False)]:
        if holds and since is None:
            since = at_ns
        elif not holds and since is not None:
            spans.append(((since - start_ns) / NS_PER_S, (at_ns - start_ns) / NS_PER_S))
            since = None
    return spans


def _touches(
    outcome: LegOutcome,
    contacts: Contacts,
    t_ns: Ints,
    ratio: Array,
    events: list[ContactEvent],
    start_ns: int,
) -> list[Touch]:
    scores = {event.t_ns: event.score for event in events if event.contact}
    releases = dict(zip(contacts.onset_ns.tolist(), contacts.release_ns.tolist(), strict=True))
    withheld = [event.t_ns for event in events if event.withheld]
    found = []
    table = outcome.touches
    for i, onset in enumerate(table.onset_ns.tolist()):
        row = ROWS[int(table.row[i])]
        speed = table.speed_m_s[i]
        of = row if np.isnan(speed) else f"{row}, {speed:.3f} m/s"
        at_s = (onset - start_ns) / NS_PER_S
        if table.found[i]:
            latency = int(table.latency_ns[i])
            score = scores.get(onset + latency)
            peak = "" if score is None else f" at {score:.2f} times the threshold"
            why = f"found after {latency / 1e6:.0f} ms{peak} ({of})"
            found.append(Touch(at_s, "hit", why))
            continue
        end = min(onset + int(table.window_ns[i]), releases[onset])
        why = why_missed(t_ns, ratio, onset, end, withheld)
        if table.found_late_ns[i] >= 0:
            window_ms, ms = table.window_ns[i] / 1e6, table.found_late_ns[i] / 1e6
            why = f"missed: found after {ms:.0f} ms, later than {window_ms:.0f} ms"
        found.append(Touch(at_s, "miss" if table.counted[i] else "beyond", f"{why} ({of})"))
    for at_ns, after in zip(outcome.alarms_ns.tolist(), outcome.alarm_after, strict=True):
        where = "in or after the turn to stance" if after else "in the swing"
        why = f"false, {scores.get(at_ns, np.nan):.2f} times the threshold, {where}"
        found.append(Touch((at_ns - start_ns) / NS_PER_S, "false", why))
    return sorted(found, key=lambda touch: touch.at_s)


def why_missed(t_ns: Ints, ratio: Array, onset: int, end: int, withheld: list[int]) -> str:
    """Return the largest test ratio while a touch could be found, and explain it in words."""
    if any(onset < at_ns <= end for at_ns in withheld):
        return "missed: withheld, the leg was ambiguous"
    inside = (t_ns > onset) & (t_ns <= end)
    judged = ratio[inside & np.isfinite(ratio)]
    if not np.any(inside):
        return "missed: no sample while it lasted"
    if not len(judged):
        return "missed: no tick could be judged while it lasted"
    peak = float(judged.max())
    if peak <= 1.0:
        return f"missed: at most {peak:.2f} times the threshold, {1 - peak:.0%} below it"
    return (
        f"missed: reached {peak:.2f} times the threshold, but was not reported: the leg was still "
        "held to touch, in its lift, or beyond what its model has seen"
    )
