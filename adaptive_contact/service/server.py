"""Runs the service: servo samples in, contact events out.

One worker does all the work: it takes a batch from the queue (at most one sample per leg),
hands it to the learners, and leaves the events to the publisher.  Learning, statuses and the
learners' state come after that, when no other leg's sample waits to be judged.  Everything but
:meth:`Service.run` gets its time as an argument.

Garbage is collected by hand, between ticks.  A collection holds up every thread for as long as it
takes, and Python makes one when a count says so: often in the tick of an event, in which most is
made.
"""

from __future__ import annotations

import gc
import itertools
import threading
import time
from collections import Counter, deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

import structlog

from adaptive_contact import __version__
from adaptive_contact.core.detect.stream import fault_of
from adaptive_contact.robot import Robot
from adaptive_contact.service.event_publisher import EventPublisher
from adaptive_contact.service.leg_endpoint import LegEndpoint
from adaptive_contact.service.link import Link, Publisher, Request
from adaptive_contact.service.logs import LogThrottle
from adaptive_contact.service.network_health import NetworkHealth, UnreadKeys
from adaptive_contact.service.sample_queue import Batch, SampleQueue
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.service.state.keeper import StateKeeper
from adaptive_contact.service.trace import Tracer, placed
from adaptive_contact.service.watchdog import Watchdog, give_up
from adaptive_contact.status import SERVICE_STATUS, Latency, LegFacts, ServiceStatus
from adaptive_contact.wire import (
    ALL_SERVO,
    HEARTBEAT,
    ContactEvent,
    Heartbeat,
    LegState,
    Reject,
    Rejected,
    ServoSample,
    decode,
    encode,
    model_key,
    servo_key,
    trace_key,
)
from adaptive_contact.wire.received import Received

if TYPE_CHECKING:
    from adaptive_contact.core.bank import LearnerBank
    from adaptive_contact.core.leg_learner import ContactLearner

_log = structlog.get_logger()


class Sweeper:
    """Collects the garbage of a process that is in a hurry.

    Args:
        most_objects: made since the last collection, and still there, after which one is due at
            once.
    """

    # This many new objects since the last collection, some 4 MB, are collected without a pause.
    def __init__(self, most_objects: int = 20_000) -> None:
        self._most = most_objects
        self._swept_ns = 0

    def start(self, now_ns: int) -> None:
        """Stop automatic garbage collection; objects that exist now are never examined again."""
        gc.collect()
        gc.freeze()
        gc.disable()
        self._swept_ns = now_ns

    def sweep(self, now_ns: int, *, pause: bool) -> None:
        """Collect if it is time."""
        # The learners make no cycles (0 in 150 s of six walking legs); libraries may.
        due = pause and now_ns - self._swept_ns > 60_000_000_000
        if due or gc.get_count()[0] > self._most:
            gc.collect()
            self._swept_ns = now_ns


# Period in which statuses are checked for a change; also the longest delay of a stop.
_LOOK_NS: Final = 100_000_000
# How long the status's note shows a dropped link, or a leg without room.
_REPORTED_NS: Final = 30_000_000_000
# End of a key that asks for a leg's ticks rather than for its model.
_TRACE: Final = "/trace"


class Service:
    """Runs the learners behind a link.

    Args:
        link: open; closed by its owner.
        bank: the learners.
        robot: what they were made for.
        baseline: where their models come from, for people to read.
        now_ns: monotonic.
        keeper: restores and saves the learners; closed at the end of :meth:`run`.
        sweeper: collects garbage between ticks, where that is not left to Python.
        described_only: legs that the robot lacks get no learner; their samples are not received.
    """

    def __init__(
        self,
        link: Link,
        bank: LearnerBank,
        robot: Robot,
        *,
        baseline: str | None,
        now_ns: int,
        keeper: StateKeeper | None = None,
        sweeper: Sweeper | None = None,
        described_only: bool = False,
    ) -> None:
        self._link = link
        self._bank = bank
        self._robot = robot
        self._baseline = baseline
        self._started_ns = now_ns
        self._queue: SampleQueue[Request] = SampleQueue(robot.leg_ids)
        self._endpoints: dict[str, LegEndpoint] = {}
        self._facts: dict[str, LegFacts] = {}
        self._samples = 0
        self._events = 0
        self._rejects: Counter[str] = Counter()
        self._ticks_latency = Latency()
        self._unfinished: list[int] = []  # arrivals of samples that are not learned from yet
        self._asked: list[Request] = []
        self._tracer = Tracer()
        self._untraced: list[tuple[str, ServoSample]] = []  # samples that a page asks for
        self._states: list[tuple[Publisher, LegState]] = []  # that somebody subscribes to
        self._throttle = LogThrottle()
        self._keeper = keeper
        self._sweeper = sweeper
        self._to_save: deque[tuple[int, LegEndpoint]] = deque()
        # Learners that are being made, in their order, and the joints of their legs.
        self._maker = ThreadPoolExecutor(1, "learners")
        self._made: deque[tuple[str, Future[LegEndpoint]]] = deque()
        self._making: dict[str, int] = {}
        self._full_ns: int | None = None  # when a leg was refused for which there is no room
        self._publisher = EventPublisher(lambda: link.sockets.held_ns)
        self._beats = 0
        self._watchdog = Watchdog(
            lambda: self._beats, self._publisher.busy_ns, on_stall=self._stalled, on_end=give_up
        )
        publisher = self._publisher
        link.sockets.drop_what_holds_up(publisher.busy_ns, publisher.missed)
        self._network = NetworkHealth(link, now_ns)
        self._strays = UnreadKeys(link)
        self._stray_keys: dict[str, str] = {}
        self._status = link.publisher(SERVICE_STATUS, history=1)
        self._heartbeat = link.publisher(HEARTBEAT)
        self._look_ns = self._status_ns = self._note_ns = now_ns
        self._amiss: list[bool] = []  # which complaints the last status had
        self._visited = 0
        for leg in robot.legs:
            joints, learner = len(leg.joints), bank.make(leg.id, len(leg.joints))
            bank.add(learner)
            self._endpoints[leg.id] = self._endpoint(leg.id, learner, joints, now_ns)
            self._facts[leg.id] = LegFacts.from_robot(robot, leg.id)
        # What the first sample would wait for: a codec's first of a process takes half a ms.
        bank.learn_from_tick()
        decode(encode(ServoSample(t_ns=0, seq=0, measured=[0.0], desired=[0.0])), ServoSample)
        for key in map(servo_key, robot.leg_ids) if described_only else (ALL_SERVO,):
            link.subscribe(key, self._queue.offer)
        link.queryable(model_key("*"), self._queue_request)
        link.queryable(trace_key("*"), self._queue_trace_request)
        link.token(SERVICE_TOKEN)

    def run(self, stop: threading.Event) -> None:
        """Work until ``stop`` is set; it is noticed within 0.1 s."""
        self._publisher.start()
        self._watchdog.start()
        try:
            while not stop.is_set():
                self._beats += 1
                wait_s = min(max(self._look_ns - time.monotonic_ns(), 0), _LOOK_NS) / 1e9
                # A snapshot takes milliseconds: it waits for a pause between two control ticks, if
                # there is one.
                batch = self._queue.pop_batch(0.003 if self._to_save else wait_s)
                if batch:
                    self.process_batch(batch, time.monotonic_ns())
                    # A tick's samples take at most as many rounds as there are legs, this one
                    # included.  Learning waits for the last.  If a leg's next sample is there
                    # already, the worker is behind: then statuses and saves must not wait longer.
                    legs = set(batch.samples)
                    for _ in range(max(1, len(self._endpoints) - 1)):
                        # They come one right after the other, and sending events needs the core
                        # more than learning does.
                        more = self._queue.pop_batch(0.001, query=False)
                        if not more:
                            break
                        self.process_batch(more, time.monotonic_ns())
                        if not legs.isdisjoint(more.samples):
                            break
                        legs |= more.samples.keys()
                    self.complete_batch()
                self.save(time.monotonic_ns(), pause=not batch)
                self.publish_due(time.monotonic_ns())
                if self._sweeper is not None:
                    self._sweeper.sweep(time.monotonic_ns(), pause=bool(batch))
            self._end(time.monotonic_ns())
        finally:
            self._maker.shutdown(wait=False, cancel_futures=True)
            self._watchdog.close()
            self._publisher.close()
            if self._keeper is not None:
                self._keeper.close()

    def process_batch(self, batch: Batch[Request], now_ns: int) -> None:
        """Process one batch of messages, up to its events."""
        for leg, dropped in batch.overflow.items():
            flooded = self._endpoints.get(leg)
            if flooded is None:
                self._rejects[Reject.OVERFLOW] += dropped
            else:
                flooded.learner.count(Reject.OVERFLOW, dropped)
            self._warn("samples dropped", Reject.OVERFLOW, now_ns, times=dropped, leg=leg)
        if batch.strangers:
            key = repr(batch.stranger)[:120]
            self._refuse(Reject.UNKNOWN_LEG, now_ns, batch.strangers, key=key)
        samples: dict[str, ServoSample] = {}
        for leg, raw in batch.samples.items():
            endpoint = self._endpoints.get(leg)
            if endpoint is None:
                continue
            self._samples += 1
            sample = decode(raw.payload, ServoSample, raw.encoding)
            if isinstance(sample, Rejected):
                endpoint.refused(sample, now_ns)
                self._warn("payload refused", sample.reason, now_ns, leg=leg, detail=sample.detail)
            else:
                samples[leg] = sample
        if samples:
            self._update(samples, batch.samples, now_ns)
        for leg in batch.samples.keys() - self._endpoints.keys():
            self._newcomer(leg, batch.samples[leg], now_ns)
        self._asked += batch.requests

    def complete_batch(self) -> None:
        """Publish states, learn from the batch once its events are on their way, answer queries."""
        for publisher, state in self._states:
            publisher.put(state)
        self._states.clear()
        if self._unfinished:
            self._bank.learn_from_tick()
        if self._untraced:
            self._trace()
        for request in self._asked:
            self._answer(request)
        self._asked.clear()
        done_ns = time.monotonic_ns()
        for arrival_ns in self._unfinished:
            self._ticks_latency.add(done_ns - arrival_ns)
        self._unfinished.clear()

    def save(self, now_ns: int, *, pause: bool) -> None:
        """Snapshot one leg whose save is due, in a pause between samples."""
        if self._keeper is None or not self._to_save:
            return
        since_ns, endpoint = self._to_save[0]
        if pause or now_ns - since_ns > 2_000_000_000:
            self._to_save.popleft()
            self._keeper.snapshot(endpoint, now_ns)

    def publish_due(self, now_ns: int) -> None:
        """Publish the statuses that are due, and check the network; cheap when nothing is due."""
        # One leg at a time: a status takes 0.1 ms, and an event must not wait for six of them.
        pause_ns = _LOOK_NS // max(1, len(self._endpoints))
        for _ in range(len(self._endpoints)):
            if now_ns < self._look_ns:
                break
            self._look_ns += pause_ns
            self._visit_leg(self._visited, now_ns)
            self._visited = (self._visited + 1) % len(self._endpoints)
        self._look_ns = max(self._look_ns, now_ns)
        self._network.check_network(now_ns)
        self._welcome()
        if now_ns >= self._note_ns:
            self._note_ns = now_ns + _LOOK_NS
            beats = {leg: one.heartbeat(now_ns) for leg, one in self._endpoints.items()}
            known = {leg: beat for leg, beat in beats.items() if beat is not None}
            self._heartbeat.put(Heartbeat(legs=known))
            # A complaint that comes or goes is published at once, its figures with the next status.
            amiss = [one is not None for one in self._complaints(now_ns)]
            if amiss != self._amiss:
                self._amiss, self._status_ns = amiss, now_ns
        if now_ns >= self._status_ns:
            self._status_ns = now_ns + 1_000_000_000
            endpoints = (self._endpoints.get(leg) for leg in self._robot.leg_ids)
            lonely = any(one is not None and not one.received_samples for one in endpoints)
            self._stray_keys = self._strays.check_keys(lonely=lonely, now_ns=now_ns)
            self._status.put(self.status(now_ns))

    def status(self, now_ns: int) -> ServiceStatus:
        """Return the state of the service."""
        state = None if self._keeper is None else self._keeper.facts
        return ServiceStatus(
            instance=self._network.instance,
            note="; ".join(filter(None, self._complaints(now_ns))) or None,
            events_lost=self._publisher.lost,
            slow_puts=self._publisher.slow,
            late_puts=self._publisher.late,
            cut_off=self._publisher.cut_off,
            stalls=self._watchdog.stalls,
            state=state,
            version=__version__,
            robot=self._robot.name,
            period_s=self._robot.period_s,
            baseline=self._baseline,
            legs=dict(self._facts),
            uptime_s=(now_ns - self._started_ns) / 1e9,
            samples=self._samples,
            events=self._events,
            rejects=dict(self._rejects),
            strays=self._stray_keys,
            callback_faults=self._link.callback_faults,
            tick_latency=self._ticks_latency.quantiles(),
            event_latency=self._publisher.latency.quantiles(),
        )

    def _complaints(self, now_ns: int) -> tuple[str | None, ...]:
        """Return what is wrong with the service, each cause in its own place."""
        dropped = (
            f"{self._publisher.cut_off} links dropped since the start: their subscribers hang or "
            "are gone"
            if self._publisher.dropped_within(now_ns, _REPORTED_NS)
            else None
        )
        error = None if self._keeper is None else self._keeper.facts.error
        failing = None if error is None else f"state: {error}"
        full = None
        if self._full_ns is not None and now_ns - self._full_ns < _REPORTED_NS:
            others = len(self._endpoints) + len(self._making) - len(self._robot.legs)
            full = (
                f"no room for another leg that is not described ({others} have learners): describe "
                "it, and give serve --described-only against names that are made up"
            )
        held = self._publisher.held_up(now_ns)
        return self._network.note, held, dropped, failing, full

    # -- one round ------------------------------------------------------------------------

    def _newcomer(self, leg: str, raw: Received, now_ns: int) -> None:
        """Request a learner for a leg that is not described, by its first good sample."""
        if leg in self._making:  # what comes meanwhile is not judged
            return
        read_, detail = decode(raw.payload, ServoSample, raw.encoding), ""
        if isinstance(read_, Rejected):
            reason, detail = read_.reason, read_.detail
        else:
            joints = len(read_.measured)
            fault = fault_of(read_, joints)
            if fault is None and self._bank.has_room([*self._making.values(), joints]):
                self._making[leg] = joints
                self._made.append((leg, self._maker.submit(self._make, leg, joints, now_ns)))
                return
            if fault is None:
                detail, self._full_ns = "no room for another learner", now_ns
            reason = fault or Reject.UNKNOWN_LEG
        self._samples += 1
        self._refuse(reason, now_ns, key=servo_key(leg), detail=detail)

    def _update(
        self, samples: dict[str, ServoSample], raws: dict[str, Received], now_ns: int
    ) -> None:
        for event in self._bank.detect_contacts(samples):
            self._post(event, raws[event.leg].arrival_ns)
        used = []
        for leg, sample in samples.items():
            endpoint = self._endpoints[leg]
            refused = endpoint.count_sample(sample, now_ns)
            if refused is not None:
                self._warn("payload refused", refused, now_ns, leg=leg)
                continue
            used.append((leg, sample))
            if endpoint.state.matched:
                self._states.append((endpoint.state, endpoint.learner.state))
        self._unfinished += [raws[leg].arrival_ns for leg in samples]
        if self._tracer.wanted(time.monotonic_ns()):
            self._untraced += used

    def _post(self, event: ContactEvent | None, arrival_ns: int) -> None:
        if event is None:
            return
        self._publisher.post(self._endpoints[event.leg].contact, event, arrival_ns)
        self._events += 1
        _log.debug(
            "contact" if event.contact else "withheld" if event.withheld else "release",
            leg=event.leg,
            seq=event.seq,
            score=round(event.score, 2),
        )

    def _trace(self) -> None:
        """Record the tick for a page that asks for it."""
        # Of two ticks of a leg in one go the learner knows the last.
        last = dict(self._untraced)
        for leg, sample in self._untraced:
            learner = self._endpoints[leg].learner if sample is last[leg] else None
            self._tracer.record(leg, sample, learner)
        self._untraced.clear()

    def _answer(self, request: Request) -> None:
        if request.key.endswith(_TRACE):
            legs = [leg for leg in self._endpoints if request.covers(trace_key(leg))]
            now_ns = time.monotonic_ns()
            for trace in self._tracer.answer(legs, request.parameter("after"), now_ns):
                described = self._endpoints[trace.leg].learner.leg
                request.reply(placed(trace, described), trace_key(trace.leg))
            request.close()
            return
        asked = [leg for leg in self._endpoints if request.covers(model_key(leg))]
        reports = {leg: self._endpoints[leg].report() for leg in asked}
        found = {leg: report for leg, report in reports.items() if report is not None}
        if not asked:
            known = ", ".join(self._endpoints) or "none yet"
            request.refuse(f"no such leg in {request.key}; legs are {known}")
            return
        if not found:
            request.refuse(f"{', '.join(asked)}: no model yet, still learning")
            return
        for leg, report in found.items():
            request.reply(report, model_key(leg))
        request.close()

    # -- what belongs to no round ---------------------------------------------------------

    def _make(self, leg: str, joints: int, now_ns: int) -> LegEndpoint:
        """Make what a new leg needs; not on the worker, which has no time for it."""
        # At most ten learners a second are made of legs that are not described: some 50 ms of a
        # core for 16 joints.
        time.sleep(0.1)
        return self._endpoint(leg, self._bank.make(leg, joints), joints, now_ns)

    def _endpoint(self, leg: str, learner: ContactLearner, joints: int, now_ns: int) -> LegEndpoint:
        resumes = None
        if self._keeper is not None:
            report = learner.model_report
            library = "none" if report is None else report.library or "unnamed"
            resumes = self._keeper.restore(leg, learner, library, now_ns)
        learner.request_release()
        return LegEndpoint(self._link, leg, learner, joints, now_ns, resumes)

    def _welcome(self) -> None:
        """Follow the legs whose learners are made."""
        while self._made and self._made[0][1].done():
            leg, made = self._made.popleft()
            if made.exception() is not None:  # its place stays taken, or it would be tried for ever
                _log.error("leg cannot be followed", leg=leg, exc_info=made.exception())
                continue
            endpoint, joints = made.result(), self._making.pop(leg)
            _log.info("new leg", leg=leg, joints=joints)
            names = [f"joint {i + 1}" for i in range(joints)]
            self._facts[leg] = LegFacts(joints=names, described=False)
            self._bank.add(endpoint.learner)
            self._endpoints[leg] = endpoint
            self._queue.open(leg)

    def _visit_leg(self, at: int, now_ns: int) -> None:
        endpoint = next(itertools.islice(self._endpoints.values(), at, None))
        self._post(endpoint.withdraw(now_ns), now_ns)
        changed = endpoint.publish_status(now_ns)
        if changed is not None and endpoint.received_samples:
            _log.info("leg status", leg=endpoint.leg, status=changed)
        keeper = self._keeper
        if keeper is None or not keeper.due(endpoint, now_ns):
            return
        if all(endpoint is not waiting for _, waiting in self._to_save):
            self._to_save.append((now_ns, endpoint))

    def _stalled(self, for_s: float) -> None:
        """Publish that the worker stands still; called on the watchdog's thread."""
        self._network.note = f"the worker has stood still for {for_s:.1f} s"
        self._status.put(self.status(time.monotonic_ns()))

    def _end(self, now_ns: int) -> None:
        """Save every leg, send the last events, and publish the last counts."""
        for endpoint in self._endpoints.values():
            self._post(endpoint.withdraw(now_ns, ending=True), now_ns)
            endpoint.publish_status(now_ns, anyway=True)
            if self._keeper is not None and endpoint.received_samples:
                self._keeper.snapshot(endpoint, now_ns)
        self._publisher.close()  # first: what it cannot send any more is to be reported
        self._status.put(self.status(time.monotonic_ns()))

    def _queue_request(self, request: Request) -> None:
        if not self._queue.add_request(request):
            request.refuse("too many queries at once; ask again")

    def _queue_trace_request(self, request: Request) -> None:
        if not request.key.endswith(_TRACE):  # who asks for everything looks at no page
            request.close()
        else:
            self._queue_request(request)

    def _refuse(self, reason: Reject, now_ns: int, times: int = 1, **facts: str) -> None:
        """Count what belongs to no leg."""
        self._rejects[reason] += times
        self._warn("payload refused", reason, now_ns, times=times, **facts)

    def _warn(
        self, what: str, reason: Reject, now_ns: int, *, times: int = 1, **facts: str
    ) -> None:
        kind = (what, reason, facts.get("leg"))
        self._throttle.warn(kind, now_ns, what, times=times, reason=reason.value, **facts)
