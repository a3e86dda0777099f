"""Follows a running service from its messages, for ``watch``.

Truth, where a simulator publishes it, is matched to events by a simple form of ``docs/scoring.md``:
a touch counts after 60 ms in the air, an event detects it within 120 ms, an event while the
foot is loaded anyway is neither right nor wrong, any other is a false alarm.  Of each leg, counting
begins after the first touch, of whose swing the beginning may have been missed; a touch counts as
missed once its event had time to arrive.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec

from adaptive_contact.service.known_contacts import KnownContacts
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus, message_of
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    ALL_STATE,
    ALL_TRUTH,
    HEARTBEAT,
    MAX_PAYLOAD_BYTES,
    ContactEvent,
    ContactTruth,
    Heartbeat,
    LearnerStatus,
    LegState,
    Status,
    leg_of_key,
)
from adaptive_contact.wire.received import Received

if TYPE_CHECKING:  # loads zenoh, which a view of messages does without
    from adaptive_contact.service.link import Link

_DETECTION_NS: Final = 120_000_000
# Truth and events travel on different keys; an event is judged when truth had time to arrive.
_JUDGE_AFTER_NS: Final = 250_000_000
# Times of contacts that are kept, of a leg.
_MOST_TIMES: Final = 256


class LegView(msgspec.Struct, frozen=True, kw_only=True):
    """Describes one row: a leg as it is now."""

    leg: str
    contact: bool | None = None  # None while it is not known
    p: float | None = None  # probability that the foot carries, None while it is not known
    age_s: float | None = None  # of the newest sample that the service has used
    status: Status | None = None
    contact_age_s: float | None = None  # since the last change to contact
    contacts: int = 0
    # contacts that the service reported since `watch` began and that did not arrive
    unheard: int = 0
    latency_ms: float | None = None  # of the last detection, with its median; None without truth
    median_latency_ms: float | None = None
    # touches, seen, false_alarms: after the first touch; None without truth
    touches: int | None = None
    seen: int | None = None
    false_alarms: int | None = None
    # residual_rms, noise_floor: (J,) rad
    residual_rms: list[float] = msgspec.field(default_factory=list)
    noise_floor: list[float] = msgspec.field(default_factory=list)
    model_version: int | None = None
    drift: float | None = None  # level of the residuals of recent lifts, 1 without drift
    changed_s: float | None = None  # since the newest change of the leg, None without one
    kind: str | None = None  # of that change, None where it is unknown
    ticks: int = 0
    rate_hz: float | None = None  # accepted samples per second
    missed: int = 0
    restarts: int = 0
    rejects: dict[str, int] = msgspec.field(default_factory=dict)
    withheld: int = 0
    note: str | None = None
    stale: bool = False  # the service has sent no status of this leg for a while


class Verdict(NamedTuple):
    """Holds what became of a touch or an event, by the simulator's truth."""

    # `seen` or `missed`, of a touch; `false`, of an event
    kind: Literal["seen", "missed", "false"]
    t_ns: int  # onset of the touch, or of the sample that decided the event


class View(msgspec.Struct, frozen=True, kw_only=True):
    """Holds everything on the screen."""

    legs: list[LegView]
    service: ServiceStatus | None = None
    alive: bool = False
    connected: bool = True


@dataclass(slots=True)
class _Truth:
    """Holds the truth of one leg, and judges its events by it."""

    loaded_since_ns: int | None = None
    released_ns: int | None = None
    began_ns: int | None = None  # onset of the first touch; what comes after it counts
    # onset_ns, heard_ns: of those whose event may still come
    touches: list[tuple[int, int]] = field(default_factory=list)
    loads: list[tuple[int, int | None]] = field(default_factory=list)
    count: int = 0
    latencies_ms: list[float] = field(default_factory=list)
    false_alarms: int = 0
    verdicts: deque[Verdict] = field(default_factory=lambda: deque(maxlen=_MOST_TIMES))

    def change(self, truth: ContactTruth, now_ns: int, *, judged: bool) -> None:
        if truth.contact:
            if self.loaded_since_ns is not None:
                return
            self.loaded_since_ns = truth.t_ns
            self.loads = [*self.loads[-20:], (truth.t_ns, None)]
            # It is unknown whether a leg that was first seen loaded has been in the air.
            if self.released_ns is not None and truth.t_ns - self.released_ns >= 60_000_000:
                if self.began_ns is None:
                    self.began_ns = truth.t_ns if judged else None
                else:
                    self.touches.append((truth.t_ns, now_ns))
            return
        if self.loaded_since_ns is not None:
            self.loads[-1] = (self.loaded_since_ns, truth.t_ns)
            self.loaded_since_ns = None
        self.released_ns = truth.t_ns

    def match_event(self, event: ContactEvent) -> None:
        if self.began_ns is None or event.t_ns <= self.began_ns + _DETECTION_NS:
            return
        for touch in reversed(self.touches):  # it belongs to the one that it follows most closely
            late_ns = event.t_ns - touch[0]
            if 0 < late_ns <= _DETECTION_NS:
                self.touches.remove(touch)
                self.count += 1
                self.latencies_ms.append(late_ns / 1e6)
                self.verdicts.append(Verdict("seen", touch[0]))
                return
        loaded = any(
            start <= event.t_ns and (end is None or event.t_ns <= end) for start, end in self.loads
        )
        if not loaded:
            self.false_alarms += 1
            self.verdicts.append(Verdict("false", event.t_ns))

    def give_up(self, now_ns: int) -> None:
        """Count touches whose event has not come as missed."""
        # A touch whose event has not come by then is missed: it is late, travels, and waits to be
        # judged.
        oldest_ns = now_ns - (_DETECTION_NS + 2 * _JUDGE_AFTER_NS)
        late = [onset_ns for onset_ns, heard_ns in self.touches if heard_ns <= oldest_ns]
        self.count += len(late)
        self.verdicts.extend(Verdict("missed", onset_ns) for onset_ns in late)
        self.touches = [touch for touch in self.touches if touch[1] > oldest_ns]


@dataclass(slots=True)
class _Arrivals:
    """Compares contacts of one leg that arrived with those that its statuses count.

    A status counts the contacts up to its own time; their times show which of them arrived, in
    any order.  Another clock, and another service, restart the count.
    """

    base: LearnerStatus | None = None
    last: LearnerStatus | None = None
    times_ns: set[int] = field(default_factory=set)  # of contacts
    before: int = 0  # unheard before the base

    @property
    def unheard(self) -> int:
        if self.base is None or self.last is None:
            return self.before
        until_ns = self.last.t_ns
        arrived = sum(self.base.t_ns < t_ns <= until_ns for t_ns in self.times_ns)
        return self.before + max(self.last.contacts - self.base.contacts - arrived, 0)

    def event(self, t_ns: int) -> None:
        self.times_ns.add(t_ns)

    def status(self, status: LearnerStatus) -> None:
        last = self.last
        if last is None:
            self._begin(status)
        elif status.t_ns < last.t_ns:
            self._begin(status)
            self.times_ns.clear()  # they are of another clock
        # No leg touches more often than this; a count that grows faster is another service's.
        elif (
            not 0 <= status.contacts - last.contacts <= 1 + (status.t_ns - last.t_ns) // 40_000_000
        ):
            self._begin(status)
        elif len(self.times_ns) > _MOST_TIMES:
            self._begin(last)  # not this one: what it counts may be on its way
        self.last = status

    def _begin(self, status: LearnerStatus) -> None:
        self.before = self.unheard
        self.base = self.last = status
        self.times_ns = {t_ns for t_ns in self.times_ns if t_ns > status.t_ns}


@dataclass(slots=True)
class _Leg:
    status: LearnerStatus | None = None
    status_ns: int = 0
    contact: bool | None = None
    contact_ns: int | None = None
    arrivals: _Arrivals = field(default_factory=_Arrivals)
    truth: _Truth | None = None
    pending: list[tuple[int, ContactEvent]] = field(default_factory=list)
    ticks: list[tuple[int, int]] = field(default_factory=list)
    p: float | None = None
    p_ns: int = 0


class Watch:
    """Takes messages in, gives a :class:`View`; times are monotonic ns of this process."""

    def __init__(self) -> None:
        self._legs: dict[str, _Leg] = {}
        self._service: ServiceStatus | None = None
        self.known = KnownContacts()

    def event(self, event: ContactEvent, now_ns: int, age_ns: int = 0) -> None:
        """Process an event; ``age_ns`` is its age on arrival (large for a late joiner)."""
        leg = self._leg(event.leg)
        leg.contact = event.contact
        leg.p, leg.p_ns = event.p, now_ns - age_ns
        if event.contact:
            leg.contact_ns = now_ns - age_ns
            leg.arrivals.event(event.t_ns)
            if age_ns < _JUDGE_AFTER_NS:
                leg.pending.append((now_ns, event))

    def learner(self, status: LearnerStatus, now_ns: int) -> None:
        """Store a leg's status."""
        leg = self._leg(status.leg)
        leg.status, leg.status_ns = status, now_ns
        leg.contact = status.contact
        leg.arrivals.status(status)
        if leg.ticks and status.ticks < leg.ticks[-1][1]:  # the service was restarted
            leg.ticks = []
        oldest_ns = now_ns - 3_000_000_000
        leg.ticks = [pair for pair in leg.ticks if pair[0] >= oldest_ns]
        leg.ticks.append((now_ns, status.ticks))

    def state(self, leg: str, state: LegState, now_ns: int) -> None:
        """Store the state of a leg's newest tick."""
        view = self._leg(leg)
        view.p, view.p_ns = state.p, now_ns

    def truth(self, leg: str, truth: ContactTruth, now_ns: int) -> None:
        """Process a truth message of the simulator."""
        view = self._leg(leg)
        if view.truth is None:
            view.truth = _Truth()
        self._match_pending(view, now_ns)
        judged = self._service is None or self._service.instance != ""  # else it compiles yet
        view.truth.change(truth, now_ns, judged=judged)

    def service(self, status: ServiceStatus) -> None:
        """Store the service's own status."""
        self._service = status
        for leg in status.legs:
            self._leg(leg)

    def view(self, now_ns: int, *, alive: bool = True, connected: bool = True) -> View:
        """Return what is known now, legs in the order of the service's robot.toml."""
        known = list(self._service.legs) if self._service is not None else []
        order = [*known, *sorted(leg for leg in self._legs if leg not in known)]
        return View(
            legs=[self._row(name, self._legs[name], now_ns) for name in order],
            service=self._service,
            alive=alive,
            connected=connected,
        )

    def statuses(self) -> dict[str, LearnerStatus]:
        """Return the last status of every leg."""
        return {name: leg.status for name, leg in self._legs.items() if leg.status is not None}

    def pop_verdicts(self) -> list[tuple[str, Verdict]]:
        """Return and reset the verdicts since the last call, by leg; the newest of many."""
        taken: list[tuple[str, Verdict]] = []
        for name, leg in self._legs.items():
            if leg.truth is not None:
                taken += [(name, verdict) for verdict in leg.truth.verdicts]
                leg.truth.verdicts.clear()
        return taken

    def _leg(self, name: str) -> _Leg:
        return self._legs.setdefault(name, _Leg())

    def _row(self, name: str, leg: _Leg, now_ns: int) -> LegView:
        self._match_pending(leg, now_ns)
        status, truth = leg.status, leg.truth
        known = self.known.is_known(name, now_ns)
        row = LegView(
            leg=name,
            contact=leg.contact if known else None,
            # A p that is older says nothing of now.
            p=leg.p if known and now_ns - leg.p_ns < 1_000_000_000 else None,
            age_s=self.known.age_s(name, now_ns),
            contact_age_s=None if leg.contact_ns is None else (now_ns - leg.contact_ns) / 1e9,
        )
        if truth is not None:
            ordered = sorted(truth.latencies_ms)
            row = msgspec.structs.replace(
                row,
                latency_ms=truth.latencies_ms[-1] if ordered else None,
                median_latency_ms=ordered[len(ordered) // 2] if ordered else None,
                touches=truth.count,
                seen=len(ordered),
                false_alarms=truth.false_alarms,
            )
        if status is None:
            return row
        changed_ns = status.drift.since_ns
        return msgspec.structs.replace(
            row,
            status=status.status,
            contacts=status.contacts,
            unheard=leg.arrivals.unheard,
            residual_rms=status.residual_rms,
            noise_floor=status.noise_floor,
            model_version=status.model_version,
            drift=status.drift.level,
            # by the clock of its samples
            changed_s=None if changed_ns is None else max(status.t_ns - changed_ns, 0) / 1e9,
            kind=status.drift.kind,
            ticks=status.ticks,
            rate_hz=_rate(leg.ticks),
            missed=status.missed,
            restarts=status.restarts,
            rejects=status.rejects,
            withheld=status.withheld,
            note=status.note,
            stale=now_ns - leg.status_ns > 2_500_000_000,
        )

    def _match_pending(self, leg: _Leg, now_ns: int) -> None:
        if leg.truth is None:
            # Without truth there is nothing to judge by; only the newest events may yet get it.
            leg.pending = leg.pending[-4:]
            return
        ripe = [pair for pair in leg.pending if now_ns - pair[0] >= _JUDGE_AFTER_NS]
        leg.pending = [pair for pair in leg.pending if now_ns - pair[0] < _JUDGE_AFTER_NS]
        for _, event in ripe:
            leg.truth.match_event(event)
        leg.truth.give_up(now_ns)


def _rate(ticks: list[tuple[int, int]]) -> float | None:
    if len(ticks) < 2 or ticks[-1][0] == ticks[0][0]:
        return None
    return (ticks[-1][1] - ticks[0][1]) / ((ticks[-1][0] - ticks[0][0]) / 1e9)


OnContact = Callable[[str, ContactEvent | ContactTruth], None]


class Feed:
    """Subscribes to what a :class:`Watch` shows; call :meth:`view` as often as it is shown.

    Args:
        link: open; closed by its owner.
        on_contact: is given each contact event and change of truth that :meth:`view` takes in, with
            its leg, and an event for each leg whose contact is not known any more.
        states: whether to subscribe to the state of every tick, which the service sends for that.
    """

    def __init__(
        self, link: Link, on_contact: OnContact | None = None, *, states: bool = False
    ) -> None:
        self._link = link
        self._on_contact = on_contact
        self.watch = Watch()  # that is fed
        # Zenoh's thread appends, the reader pops; without a reader the oldest go.
        self._waiting: deque[Received] = deque(maxlen=20_000)
        self._alive = False
        link.watch_tokens(SERVICE_TOKEN, self._token)
        link.subscribe(SERVICE_STATUS, self._receive, history=True)
        link.subscribe(HEARTBEAT, self._receive)
        link.subscribe(ALL_CONTACT, self._receive, history=True)
        link.subscribe(ALL_LEARNER, self._receive)
        link.subscribe(ALL_TRUTH, self._receive)
        if states:
            link.subscribe(ALL_STATE, self._receive)

    def _receive(self, received: Received) -> None:
        # A larger one would only be refused, and until then be kept.
        if len(received.payload) <= MAX_PAYLOAD_BYTES:
            self._waiting.append(received)

    def view(self, now_ns: int) -> View:
        """Process what has arrived, and return what is known now; ``now_ns`` is monotonic."""
        for _ in range(len(self._waiting)):
            self._process_message(self._waiting.popleft())
        self._pass_on(self.watch.known.poll_events(now_ns))
        return self.watch.view(now_ns, alive=self._alive, connected=self._link.is_connected())

    def _process_message(self, received: Received) -> None:
        message = message_of(received)
        leg = leg_of_key(received.key)
        if isinstance(message, ServiceStatus):
            self.watch.service(message)
        elif isinstance(message, Heartbeat):
            self.watch.known.heartbeat(message, received.arrival_ns)
        elif isinstance(message, ContactEvent):
            self.watch.event(message, received.arrival_ns, _age_ns(received))
            self._pass_on(self.watch.known.event(message, received.arrival_ns))
        elif isinstance(message, LearnerStatus):
            self.watch.learner(message, received.arrival_ns)
        elif isinstance(message, LegState) and leg is not None:
            self.watch.state(leg, message, received.arrival_ns)
        elif isinstance(message, ContactTruth) and leg is not None:
            self.watch.truth(leg, message, received.arrival_ns)
            if self._on_contact is not None:
                self._on_contact(leg, message)

    def _pass_on(self, events: list[ContactEvent]) -> None:
        for event in events:
            if self._on_contact is not None:
                self._on_contact(event.leg, event)

    def _token(self, key: str, alive: bool) -> None:
        self._alive = alive


def _age_ns(received: Received) -> int:
    """Return a sample's age on arrival, ns, by the publisher's wall clock (0 if it has none)."""
    if received.published_ns is None:
        return 0
    arrived_ns = time.time_ns() - (time.monotonic_ns() - received.arrival_ns)
    return max(0, arrived_ns - received.published_ns)
