"""Keeping time: a tick every so often, without drift.

A simulation on the wire: samples and truth out, drifts and contact events in; or, without one,
the contact events of learners in this process.

Callbacks only enqueue; one loop makes ticks, answers drifts between them, and keeps time.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable
from threading import Event
from typing import TYPE_CHECKING

from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model import shipped_baseline
from adaptive_contact.wire import (
    ALL_CONTACT,
    SIM_DRIFT,
    ContactEvent,
    Drift,
    DriftReply,
    Rejected,
    decode,
    leg_of_key,
    servo_key,
    truth_key,
)
from adaptive_contact_sim.simulation import Simulation, Tick
from adaptive_contact_sim.walk import WalkSettings

if TYPE_CHECKING:
    from adaptive_contact.service.link import Link, Request
    from adaptive_contact.wire.received import Received


class Pace:
    """Waits for the next tick's moment; moments lie on a grid fixed at the start.

    Args:
        period_s: between ticks, of the wall clock; 0 for as fast as possible.
        clock: monotonic seconds.
    """

    def __init__(self, period_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._period_s = period_s
        self._clock = clock
        self._start = clock()
        self._next = self._start
        self.ticks = 0
        self.late = 0

    @property
    def elapsed_s(self) -> float:
        """Wall clock time since the start."""
        return self._clock() - self._start

    def wait(self, stop: Event) -> bool:
        """Wait until the next tick is due.

        Returns:
            False when stopped.
        """
        self.ticks += 1
        if self._period_s == 0.0:
            return not stop.is_set()
        self._next += self._period_s
        ahead = self._next - self._clock()
        if ahead > 0.0:
            return not stop.wait(ahead)
        self.late += 1
        # Further behind than this, lost time is let go instead of caught up in a burst.
        if ahead < -0.5:
            self._next = self._clock()
        return not stop.is_set()


def run_live(
    sim: Simulation,
    link: Link | None,
    *,
    seconds: float | None,
    pace: Pace,
    stop: Event,
    on_tick: Callable[[Tick], None],
    on_event: Callable[[ContactEvent], None] = lambda _: None,
) -> None:
    """Run at a pace, on an open link or without a network.

    Args:
        sim: what to run; a gait that stops on the service's word gets its contact events, without
            a network those of learners in this process.
        link: where to publish; stays open.
        seconds: of simulated time, None for until stopped.
        pace: how fast.
        stop: ends the run when set.
        on_tick: gets every tick, after it was published.
        on_event: gets every event that the gait gets, before the tick that can act on it.
    """
    ticks = math.inf if seconds is None else round(seconds / sim.settings.period_s)
    learners = InProcess(sim) if link is None and _listens(sim) else None
    with contextlib.nullcontext() if link is None else contextlib.closing(_Wire(sim, link)) as wire:
        while sim.ticks < ticks and not stop.is_set():
            for event in () if wire is None else wire.process_messages():
                on_event(event)
            tick = sim.tick()
            if wire is not None:
                wire.publish(tick)
            on_tick(tick)
            for event in () if learners is None else learners.process_tick(tick):
                on_event(event)
            if not pace.wait(stop):
                break


class InProcess:
    """The service's learners in this process: a tick's events reach the gait before its next.

    Args:
        sim: whose legs they are; they begin with its shipped baseline, as `serve` does.
        mode: what they may do to follow the legs.
    """

    def __init__(self, sim: Simulation, mode: LearnerMode = LearnerMode.FULL) -> None:
        from adaptive_contact import LearnerBank  # learners take a while to load

        robot = sim.robot.description
        self._sim = sim
        self._bank = LearnerBank(robot, shipped_baseline(robot.name), mode=mode)

    def process_tick(self, tick: Tick) -> list[ContactEvent]:
        """Process a tick's samples, and pass the events on to the gait."""
        events = self._bank.update(tick.samples)
        for event in events:
            self._sim.notify_contact(event.leg, event.contact)
        return events


class _Wire:
    """A simulation's publishers, and what others ask of it between ticks."""

    def __init__(self, sim: Simulation, link: Link) -> None:
        self._sim = sim
        legs = sim.layout.legs
        self._servo = {leg: link.publisher(servo_key(leg)) for leg in legs}
        self._truth = {
            leg: link.publisher(truth_key(leg), reliable=True, history=1) for leg in legs
        }
        # More than that has lost touch with the present; the asker's own timeout shows it.
        self._requests: deque[Request] = deque(maxlen=1024)
        self._events: deque[Received] = deque(maxlen=1024)
        self._declared = [link.queryable(SIM_DRIFT, self._requests.append)]
        if _listens(sim):
            self._declared.append(link.subscribe(ALL_CONTACT, self._events.append))

    def process_messages(self) -> list[ContactEvent]:
        """Answer requests, and pass contact events on to the gait; return those."""
        taken: list[ContactEvent] = []
        while self._requests:
            self._answer(self._requests.popleft())
        while self._events:
            received = self._events.popleft()
            event = decode(received.payload, ContactEvent, received.encoding)
            leg = leg_of_key(received.key)
            if leg is not None and not isinstance(event, Rejected):
                self._sim.notify_contact(leg, event.contact)
                taken.append(event)
        return taken

    def _answer(self, request: Request) -> None:
        """Take a drift, and answer with what now holds."""
        sim, error = self._sim, None
        if request.payload:  # without one, the request only asks what holds
            drift = decode(request.payload, Drift, request.encoding)
            if isinstance(drift, Rejected):
                error = f"not a drift: {drift.detail}; expected a Drift message"
            else:
                try:
                    sim.inject(drift)
                except ConfigurationError as refused:
                    error = str(refused)
        request.reply(
            DriftReply(ok=error is None, t_ns=sim.t_ns, holds=sim.now_holds(), error=error),
            SIM_DRIFT,
        )
        request.close()

    def publish(self, tick: Tick) -> None:
        """Publish samples and changes of the truth."""
        for leg, sample in tick.samples.items():
            self._servo[leg].put(sample)
        for change in tick.truth:
            self._truth[change.leg].put(change.message)

    def close(self) -> None:
        """End what was declared; the link stays open."""
        for declared in self._declared:
            declared.close()


def _listens(sim: Simulation) -> bool:
    """Whether the gait stops on the service's word."""
    motion = sim.settings.motion
    return isinstance(motion, WalkSettings) and motion.stop_on == "service"
