"""The running part: starts the processes, breaks them on schedule, and takes everything down.

This process is a client of the router like any other: what it hears of events and statuses is
what a gait controller would hear.  Samples and truth come from the simulator's own recording,
which no fault can touch.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from adaptive_contact.cli._child import Child
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.interfaces import Received
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    ContactEvent,
    LearnerStatus,
    ServoSample,
    decode,
    servo_key,
)

from .memory import Resident
from .plan import Fault, FaultKind, SoakPlan

__all__ = ["Broken", "Heard", "Take", "conduct"]

_CONNECTED: Final = re.compile(r"connected to ")
_START_S: Final = 60.0
_LOOK_S: Final = 0.05
_MEMORY_EVERY_S: Final = 2.0
_OUTAGE_S: Final = 1.0
_SETTLE_S: Final = 2.5
# A killed process is gone in some ms; its memory is given back first.
_DEAD_S: Final = 10.0
# A refit under way ends before its process sees that nobody waits for it; the longest is a minute.
_ORPHAN_S: Final = 90.0
_NS: Final = 1_000_000_000
_ROUTER: Final = Path(__file__).with_name("router.py")
_PAGE: Final = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Broken:
    """One fault, wall clock ns: from the kill to the moment its cause was gone."""

    kind: FaultKind
    from_ns: int
    to_ns: int


class _Orphan(NamedTuple):
    """A child process of a service that was killed, told from a later one of its id."""

    pid: int
    born: str
    killed_s: float


@dataclass
class Heard:
    """What came over the wire, with the wall clock of its arrival, ns.

    Attributes:
        events, statuses, services: with their arrival.
        lags_ns: by second of the samples' clock, least arrival of a sample minus its time.
        unreadable: payloads that are not what their key says.
    """

    events: list[tuple[int, ContactEvent]] = field(default_factory=list)
    statuses: list[tuple[int, LearnerStatus]] = field(default_factory=list)
    services: list[tuple[int, ServiceStatus]] = field(default_factory=list)
    lags_ns: dict[int, int] = field(default_factory=dict)
    unreadable: int = 0


@dataclass(frozen=True)
class Take:
    """What a run left.

    ``left_behind`` are child processes of a killed service that did not end by themselves.
    """

    recording: Path
    heard: Heard
    broken: tuple[Broken, ...]
    resident: tuple[Resident, ...]
    simulator: str
    left_behind: int = 0


def conduct(plan: SoakPlan, say: Callable[[str], None], stop: threading.Event) -> Take:
    """Run a soak.

    Args:
        plan: what happens when; its folder must exist.
        say: gets a line now and then.
        stop: ends the run early when set.

    Raises:
        AdaptiveContactError: a process failed, or ``stop`` was set.
    """
    with ExitStack() as stack:
        run = _Run(plan, stack)
        say(f"router on {run.endpoint}, service {run.service.pid}, simulator starts")
        recording = plan.out / "soak.mcap"
        walk = Child("the simulator", _walk(plan, run.endpoint, recording))
        stack.enter_context(walk)
        began_s = time.monotonic()
        faults, next_word = deque(plan.faults), 0.0
        while walk.running:
            if stop.wait(_LOOK_S):
                raise AdaptiveContactError("stopped")
            at_s = time.monotonic() - began_s
            run.look()
            if faults and at_s >= faults[0].at_s:
                fault = faults.popleft()
                run.do(fault)
                say(f"{at_s:5.0f} s  {fault.kind} killed and started again")
            if at_s >= next_word:
                next_word += 60.0
                say(f"{at_s:5.0f} s  {run.word()}")
        walk.check()
        until_s = time.monotonic() + _SETTLE_S  # the last statuses are on their way
        while time.monotonic() < until_s:
            time.sleep(_LOOK_S)  # several processes and sockets: there is no one thing to wait for
            run.look()
        return Take(
            recording,
            run.heard,
            tuple(run.broken),
            tuple(run.resident),
            walk.lines[-1] if walk.lines else "",
            run.left_behind,
        )


class _Run:
    """Router and service as they live and die, and what is heard meanwhile."""

    def __init__(self, plan: SoakPlan, stack: ExitStack) -> None:
        self.heard = Heard()
        self.broken: list[Broken] = []
        self.resident: list[Resident] = []
        self.left_behind = 0
        self._plan = plan
        self._stack = stack
        self._orphans: list[_Orphan] = []
        self._waiting: deque[Received] = deque()
        self._life = 0
        self._memory_s = 0.0
        self._router = _start_router("tcp/127.0.0.1:0")
        stack.callback(lambda: _end(self._router))
        assert self._router.stdout is not None
        self.endpoint = self._router.stdout.readline().strip()
        self.service = self._start_service()
        stack.callback(lambda: self.service.end())
        stack.callback(self._bury)
        link = stack.enter_context(Link.open(client_settings([self.endpoint], wait=False)))
        link.subscribe(ALL_CONTACT, self._waiting.append, history=True)
        link.subscribe(ALL_LEARNER, self._waiting.append)
        link.subscribe(SERVICE_STATUS, self._waiting.append, history=True)
        # All legs of a tick are sent together: one tells when the source sent them.
        link.subscribe(servo_key(shipped_robot().leg_ids[0]), self._waiting.append)

    def look(self) -> None:
        """Take in what has come, and see that all is alive."""
        for _ in range(len(self._waiting)):
            self._take(self._waiting.popleft())
        if not self.service.running:
            raise self.service.failure()
        if self._router.poll() is not None:
            raise AdaptiveContactError("the router ended by itself")
        now_s = time.monotonic()
        if now_s - self._memory_s >= _MEMORY_EVERY_S:
            self._memory_s = now_s
            after_s = now_s - self._service_began_s
            pid = self.service.pid
            workers_mb = sum(resident_mb(child) for child in children_of(pid))
            self.resident.append(Resident(self._life, after_s, resident_mb(pid), workers_mb))
            self._watch_orphans(now_s)

    def do(self, fault: Fault) -> None:
        """Break something, and start it again."""
        from_ns = time.time_ns()
        if fault.kind == "router":
            _end(self._router)
            time.sleep(_OUTAGE_S)  # the length of the outage, not a synchronisation
            self._router = _start_router(self.endpoint)
            assert self._router.stdout is not None
            self._router.stdout.readline()
        else:
            dead = self.service
            children = [(pid, born(pid)) for pid in children_of(dead.pid)]
            crash_service(dead)
            # Its output stays open as long as its children do: it is read to the end at ours.
            self._stack.callback(dead.end)
            now_s = time.monotonic()
            self._orphans += [_Orphan(pid, born, now_s) for pid, born in children if born]
            self._life += 1
            self.service = self._start_service()
        self.broken.append(Broken(fault.kind, from_ns, time.time_ns()))

    def word(self) -> str:
        """How it goes, in a line."""
        newest = {status.leg: status for _, status in self.heard.statuses[-50:]}
        missed = sum(status.missed for status in newest.values())
        promoted = sum(status.refits.promoted for status in newest.values())
        refused = sum(status.refits.refused for status in newest.values())
        memory = self.resident[-1].mb if self.resident else 0.0
        return (
            f"{len(self.heard.events)} events, {missed} samples missed, refits {promoted} "
            f"promoted {refused} refused, service {memory:.1f} MB"
        )

    def _watch_orphans(self, now_s: float) -> None:
        """See that the children of a killed service end, and end those that do not."""
        self._orphans = [one for one in self._orphans if born(one.pid) == one.born]
        late = [one for one in self._orphans if now_s - one.killed_s > _ORPHAN_S]
        self.left_behind += len(late)
        self._orphans = [one for one in self._orphans if one not in late]
        for one in late:
            _kill(one)

    def _bury(self) -> None:
        """Nothing stays behind, however early the run ends."""
        for one in self._orphans:
            _kill(one)

    def _start_service(self) -> Child:
        self._service_began_s = time.monotonic()
        state = self._plan.out / "state"
        arguments = ("serve", "--connect", self.endpoint, "--state", str(state))
        service = Child("the service", (*arguments, "--log-level", "warning"))
        try:
            service.wait_line(_CONNECTED, _START_S)
        except BaseException:  # Ctrl-C, too: nobody else knows of it yet
            service.end()
            raise
        return service

    def _take(self, received: Received) -> None:
        now_ns = time.time_ns() - (time.monotonic_ns() - received.arrival_ns)
        kind = received.key.rsplit("/", 1)[-1]
        if kind == "servo":
            sample = decode(received.payload, ServoSample, received.encoding)
            if isinstance(sample, ServoSample):
                second, lag_ns = sample.t_ns // _NS, now_ns - sample.t_ns
                lags_ns = self.heard.lags_ns
                lags_ns[second] = min(lag_ns, lags_ns.get(second, lag_ns))
                return
        elif received.key == SERVICE_STATUS:
            service = decode(received.payload, ServiceStatus, received.encoding)
            if isinstance(service, ServiceStatus):
                self.heard.services.append((now_ns, service))
                return
        elif kind == "contact":
            event = decode(received.payload, ContactEvent, received.encoding)
            if isinstance(event, ContactEvent):
                self.heard.events.append((now_ns, event))
                return
        else:
            status = decode(received.payload, LearnerStatus, received.encoding)
            if isinstance(status, LearnerStatus):
                self.heard.statuses.append((now_ns, status))
                return
        self.heard.unreadable += 1


def _walk(plan: SoakPlan, endpoint: str, recording: Path) -> tuple[str, ...]:
    drifts = [text for drift in plan.drifts for text in ("--drift", drift.option)]
    return (
        *("sim", "walk", "--gait", "tripod", "--terrain", "rough", "--stop-on", "truth"),
        *("--seconds", f"{plan.seconds:g}", "--seed", str(plan.seed), *drifts),
        *("--record", str(recording), "--connect", endpoint),
    )


def _start_router(endpoint: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(_ROUTER), endpoint]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def crash_service(service: Child) -> None:
    """Kill a service as a crash would: nothing is saved, nobody is told.

    Raises:
        AdaptiveContactError: it is not gone in time.
    """
    os.kill(service.pid, signal.SIGKILL)
    until_s = time.monotonic() + _DEAD_S
    while service.running:
        if time.monotonic() > until_s:
            raise AdaptiveContactError(f"the service lives {_DEAD_S:g} s after it was killed")
        time.sleep(0.005)  # its end is asked for; there is nothing else to wait on


def _kill(orphan: _Orphan) -> None:
    if born(orphan.pid) == orphan.born:
        with contextlib.suppress(OSError):  # it has just ended
            os.kill(orphan.pid, signal.SIGKILL)


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def born(pid: int) -> str:
    """When a process started, as the kernel tells it; empty where there is none that runs."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if fields[0] == "Z" else fields[19]


def resident_mb(pid: int) -> float:
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE / 1e6
    except (OSError, IndexError):  # it is just ending
        return float("nan")


def children_of(pid: int) -> list[int]:
    """Processes that a process has started, and theirs."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # the thread is just ending
            found += [int(child) for child in task.read_text().split()]
    return found + [one for child in found for one in children_of(child)]
