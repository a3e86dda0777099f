"""Runs the gateway between ROS 2 (rmw_zenoh) and the service: two sessions, three threads.

::

    ROS 2  --state, command-->  [inbox]  --ServoSample-->  service
    ROS 2  <--Bool, values----  [outbox] <--events, heartbeats-- service
    ROS 2  <--diagnostics-----  [once a second] <--------  LearnerStatus

Contacts have a thread and a queue of their own, so that no flood of messages holds one up.  The
thread that reads messages waits for nothing else: what is to be said goes to the third thread, as
a terminal may stand still.
"""

from __future__ import annotations

import collections
import contextlib
import gc
import itertools
import queue
import threading
import time
from collections.abc import Callable
from typing import Final

from adaptive_contact.errors import LinkError
from adaptive_contact.robot import Robot
from adaptive_contact.ros2 import rmw
from adaptive_contact.ros2.intake import Intake
from adaptive_contact.ros2.problems import Complaints, Reason
from adaptive_contact.ros2.report import Report
from adaptive_contact.ros2.ticks import Origin
from adaptive_contact.ros2.types import Types
from adaptive_contact.service.known_contacts import KnownContacts
from adaptive_contact.service.link import Declared, Link, Publisher, Received
from adaptive_contact.service.settings import REMEDY, Finding
from adaptive_contact.status import message_of
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    ALL_STATE,
    HEARTBEAT,
    ContactEvent,
    Heartbeat,
    LearnerStatus,
    LegState,
    ServoSample,
    leg_of_key,
    servo_key,
)

# A controller state of 64 legs has 20 kB.
MAX_BYTES: Final = 256 * 1024
# Messages of one topic that may wait; at 100 Hz more than half a second.
WAITING: Final = 64
_LOOK_S: Final = 0.1
_SERVICE_GONE_S: Final = 3.0


def shown_of_ros(finding: Finding) -> str:
    """Describe what stands in the way of ROS 2's router, and what to do about it."""
    remedy = (
        "start rmw_zenohd there (ros2 run rmw_zenoh_cpp rmw_zenohd), or give its address with "
        "--ros-connect"
    )
    return finding.line.replace(REMEDY, remedy)


class Inbox:
    """Queues messages by topic; of each topic the newest ones are kept."""

    def __init__(self, topics: tuple[str, ...]) -> None:
        self._dropped: collections.Counter[str] = collections.Counter()
        self._waiting: dict[str, collections.deque[tuple[rmw.Address, Received]]] = {
            topic: collections.deque() for topic in topics
        }
        self._order: collections.deque[str] = collections.deque()
        self._awake = threading.Condition()

    def add(self, received: Received) -> None:
        """Add a message, where it is one of a topic that is read; called on Zenoh's threads."""
        address = rmw.address_of(received.key)
        if address is None or address.topic not in self._waiting:
            return
        with self._awake:
            waiting = self._waiting[address.topic]
            waiting.append((address, received))
            if len(waiting) <= WAITING:
                self._order.append(address.topic)
                self._awake.notify()
            else:
                waiting.popleft()
                self._dropped[address.topic] += 1

    def get(self, timeout_s: float) -> tuple[rmw.Address, Received] | None:
        """Return the next message; None where none comes in time."""
        with self._awake:
            if not self._awake.wait_for(lambda: self._order, timeout_s):
                return None
            return self._waiting[self._order.popleft()].popleft()

    def pop_dropped(self) -> dict[str, int]:
        """Return and reset the number of dropped messages, by topic."""
        with self._awake:
            dropped, self._dropped = dict(self._dropped), collections.Counter()
        return dropped


class _RosPublisher:
    def __init__(
        self, link: Link, node: rmw.Node, number: int, address: rmw.Address, *, latched: bool = True
    ) -> None:
        token = node.endpoint_token("MP", number, address, rmw.LATCHED if latched else rmw.STREAM)
        self._id = rmw.publisher_id(token)
        self._seq = itertools.count(1)
        key = rmw.topic_key(node.domain, address)
        self._publisher: Publisher = link.latched(key) if latched else link.publisher(key)
        self._token = link.token(token)

    @property
    def matched(self) -> bool:
        """Return whether somebody subscribes; True of a latched topic, where it is unknown."""
        return self._publisher.matched

    def put(self, payload: bytes) -> None:
        attachment = rmw.Attachment(next(self._seq), time.time_ns(), self._id)
        # rmw_zenoh declares no encoding, which is this.
        self._publisher.put_raw(payload, "zenoh/bytes", rmw.encode_attachment(attachment))


class Gateway:
    """Relays between ROS 2 and the service until it is stopped.

    Args:
        robot: its description, with ``[ros2]``.
        service: link to the service's router.
        ros: link to ROS 2's router.
        run: of the samples, larger at each start.
        print_line: called with one line for the operator.

    Attributes:
        topics: that are read, and the types that each may have.
        complaints: counts of what was not used.
        relayed: samples published.

    Raises:
        ConfigurationError: the description names nothing of ROS 2.
    """

    def __init__(
        self, robot: Robot, service: Link, ros: Link, run: int, print_line: Callable[[str], None]
    ) -> None:
        settings = robot.ros2
        self._print_line = print_line
        self._service, self._ros = service, ros
        self.complaints = Complaints()
        self.relayed = 0
        self.events = 0
        self.intake = Intake(robot, run, self._complain)
        assert settings is not None  # Intake has refused it
        self._types = Types(settings.distro)
        self.topics = self.intake.topics(truth=False)
        self._report = Report(self._types, settings.node, robot.name, robot.leg_ids)
        self._node = rmw.Node(settings.domain, ros.id, settings.node)
        self._legs = frozenset(robot.leg_ids)
        self._inbox = Inbox(tuple(self.topics))
        self._contacts: queue.SimpleQueue[Received | None] = queue.SimpleQueue()
        self._known = KnownContacts()
        self._heard_s: float | None = None  # when the last heartbeat came
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._learners: dict[str, LearnerStatus] = {}
        self._asked_states: Declared | None = None  # subscription, while somebody in ROS 2 has one
        self._numbers = itertools.count(1)
        self._shown: set[str] = set()
        self._samples = {leg: service.publisher(servo_key(leg)) for leg in self.intake.legs}

    @property
    def publishes(self) -> str:
        """Describe the topics that are written, for the operator."""
        topics = [address.topic for address in self._report.contacts.values()]
        some = ", ".join(topics[:2]) + (", …" if len(topics) > 2 else "")
        rest = (self._report.values, self._report.states, self._report.diagnostics)
        return ", ".join([some, *(address.topic for address in rest)])

    def run(self, stop: threading.Event) -> None:
        """Declare everything, and relay until ``stop`` is set."""
        self._declare()
        gc.collect()
        gc.freeze()
        workers = [
            threading.Thread(target=target, args=(stop,), name=name, daemon=True)
            for target, name in ((self._outward, "contacts"), (self._housekeeping, "diagnostics"))
        ]
        for worker in workers:
            worker.start()
        try:
            while not stop.is_set():
                got = self._inbox.get(_LOOK_S)
                if got is not None:
                    self._inward(*got)
        except LinkError:
            if not stop.is_set():
                raise
        finally:
            stop.set()
            self._contacts.put(None)
            for worker in workers:
                worker.join(2.0)

    # -- declarations ------------------------------------------------------------------------------

    def _declare(self) -> None:
        node, ros, report = self._node, self._ros, self._report
        ros.token(node.token)
        numbers = self._numbers
        self._of_leg = {
            leg: _RosPublisher(ros, node, next(numbers), address)
            for leg, address in report.contacts.items()
        }
        self._values = _RosPublisher(ros, node, next(numbers), report.values)
        self._diagnostics = _RosPublisher(ros, node, next(numbers), report.diagnostics)
        self._states = _RosPublisher(ros, node, next(numbers), report.states, latched=False)
        for topic, types in self.topics.items():
            ros.subscribe(rmw.any_type(node.domain, topic), self._inbox.add)
            if len(types) == 1:
                self._show(rmw.Address(topic, types[0], self._types.hash_of(types[0])))
        self._service.subscribe(HEARTBEAT, self._contacts.put)
        self._service.subscribe(ALL_CONTACT, self._contacts.put, history=True)
        self._service.subscribe(ALL_LEARNER, self.store_status)

    def _show(self, address: rmw.Address) -> None:
        """Declare subscriptions to the graph; of several types, the one that is received."""
        if address.topic not in self._shown:
            self._shown.add(address.topic)
            number = next(self._numbers)
            self._ros.token(self._node.endpoint_token("MS", number, address, rmw.STREAM))

    def store_status(self, received: Received) -> None:
        """Store the newest status of a leg's learner, for the diagnostics."""
        status = message_of(received)
        if isinstance(status, LearnerStatus) and status.leg in self._legs:
            self._learners[status.leg] = status

    # -- ROS 2 to the service ----------------------------------------------------------------------

    def _inward(self, address: rmw.Address, received: Received) -> None:
        topic = address.topic
        if len(received.payload) > MAX_BYTES:
            self._complain(
                topic,
                "too_large",
                f"a message of {len(received.payload)} bytes, at most {MAX_BYTES}; not used",
            )
            return
        message = self.intake.read(
            self._types.decode, topic, address.type, address.hash, received.payload
        )
        if message is None:
            return
        self._show(address)
        attached = rmw.decode_attachment(received.attachment)
        if attached is None:
            origin = Origin(b"", None, received.published_ns or time.time_ns())
        else:
            origin = Origin(attached.publisher, attached.seq, attached.time_ns)
        for leg, sample in self.intake.convert(topic, address.type, message, origin):
            if isinstance(sample, ServoSample):
                self._samples[leg].put(sample)
                self.relayed += 1

    def _complain(self, topic: str, reason: Reason, detail: str) -> None:
        line = self.complaints.count(topic, reason, detail, time.monotonic())
        if line is not None and self._lines.qsize() < 256:
            self._lines.put(line)

    # -- the service to ROS 2 ----------------------------------------------------------------------

    def _outward(self, stop: threading.Event) -> None:
        while not stop.is_set():
            received = None
            with contextlib.suppress(queue.Empty):
                received = self._contacts.get(timeout=_LOOK_S)
            self._relay(received, stop)
        self._known.heartbeat(Heartbeat(legs={}), 0)  # from now on ROS 2 gets no word of any leg
        self._relay(None, stop)

    def _relay(self, received: Received | None, stop: threading.Event) -> None:
        """Pass on what has arrived, and what follows from time passing."""
        now_ns = time.monotonic_ns()
        message = None if received is None else message_of(received)
        events: list[ContactEvent] = []
        if isinstance(message, Heartbeat) and received is not None:
            self._heard_s = time.monotonic()
            self._known.heartbeat(message, received.arrival_ns)
        elif isinstance(message, ContactEvent) and message.leg in self._of_leg:
            self.events += 1
            events = self._known.event(message, now_ns)
        events += self._known.poll_events(now_ns)
        try:
            if isinstance(message, LegState) and received is not None:
                leg = leg_of_key(received.key)
                whole = self._report.state(leg, message) if leg in self._of_leg else None
                if whole is not None:
                    self._states.put(whole)
            for event in events:
                changed = self._report.change(event)
                if changed is not None:
                    self._of_leg[event.leg].put(changed)
            if events or received is None or received.key == HEARTBEAT:
                ages_s = {leg: self._known.age_s(leg, now_ns) for leg in self._of_leg}
                sampled = {leg: age_s for leg, age_s in ages_s.items() if age_s is not None}
                self._values.put(self._report.all_legs(sampled, self._valid(now_ns)))
        except LinkError as error:
            if not stop.is_set():
                self._print_line(str(error))

    def _valid(self, now_ns: int) -> frozenset[str]:
        return frozenset(leg for leg in self._legs if self._known.is_known(leg, now_ns))

    def _housekeeping(self, stop: threading.Event) -> None:
        begun_s = time.monotonic()
        # After this long without a sample of a leg it is said, and again after ten times as long.
        silent_s = begun_s + 5.0
        reported: str | None = None
        while not stop.wait(1.0):
            for _ in range(self._lines.qsize()):
                self._print_line(self._lines.get())
            for topic, times in self._inbox.pop_dropped().items():
                for _ in range(times):
                    self._complain(
                        topic,
                        "overflow",
                        f"more messages than can be read; the oldest of {WAITING} are dropped: "
                        "publish at the control rate",
                    )
            now_s = time.monotonic()
            silent = self.intake.silent if now_s >= silent_s else ()
            if silent:
                silent_s = now_s + 50.0
                self._print_line(
                    f"no sample of legs {', '.join(silent)} yet; compare the topics of robot.toml "
                    "with `ros2 topic list -t`"
                )
            trouble = self._trouble(now_s - begun_s)
            if trouble != reported:
                reported = trouble
                self._print_line(trouble or "the service and ROS 2 are there")
            try:
                # The states of all legs are asked for while somebody in ROS 2 subscribes to them.
                if self._states.matched and self._asked_states is None:
                    self._asked_states = self._service.subscribe(ALL_STATE, self._contacts.put)
                elif self._asked_states is not None and not self._states.matched:
                    self._asked_states.close()
                    self._asked_states = None
                self._diagnostics.put(self.diagnosis(trouble))
            except LinkError:
                if not stop.is_set():
                    continue

    def _trouble(self, up_s: float) -> str | None:
        """Describe what prevents relaying; None where nothing does."""
        if not self._ros.is_connected():
            return f"ROS 2 cannot be reached: {shown_of_ros(self._ros.diagnose())}; trying on"
        if not self._service.is_connected():
            return f"the service cannot be reached: {self._service.diagnose().line}; trying on"
        heard_s = self._heard_s
        if up_s > _SERVICE_GONE_S and (
            heard_s is None or time.monotonic() - heard_s > _SERVICE_GONE_S
        ):
            return f"no service publishes {HEARTBEAT}; run `adaptive-contact serve`"
        return None

    def diagnosis(self, trouble: str | None) -> bytes:
        """Encode what ``/diagnostics`` shows; ``trouble`` is the gateway's own."""
        learners = dict(self._learners)
        counts: dict[str, object] = {"samples": self.relayed, "events": self.events}
        counts |= {
            f"{topic} {reason}": times
            for (topic, reason), times in list(self.complaints.counts.items())
        }
        valid = self._valid(time.monotonic_ns())
        return self._report.diagnose(time.time_ns(), learners, valid, counts, trouble)
