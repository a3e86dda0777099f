"""The running part: starts the processes, breaks them on schedule, and takes everything down.

This process is a client of the router like any other: what it hears of events and statuses is
what a gait controller would hear.  Samples and truth come from the simulator's own recording,
which no fault can touch.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import psutil

from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    NS_PER_S,
    ContactEvent,
    LearnerStatus,
    Message,
    ServoSample,
    decode,
    servo_key,
)
from adaptive_contact.wire.received import Received
from programs import ROUTER, Program

from .memory import Resident

# A first start compiles, for minutes on a slow computer.
_START_S: Final = 600.0
_LOOK_S: Final = 0.05
_MEMORY_EVERY_S: Final = 2.0
_OUTAGE_S: Final = 1.0
_SETTLE_S: Final = 2.5
# A killed process is gone in some ms; its memory is given back first.
_DEAD_S: Final = 10.0
# A refit under way ends before its process sees that nobody waits for it; the longest is a minute.
_ORPHAN_S: Final = 90.0


class Broken(NamedTuple):
    """One fault, wall clock ns: from the kill to the moment its cause was gone."""

    kind: FaultKind
    from_ns: int
    to_ns: int


class Heard:
    """What came over the wire, with the wall clock of its arrival, ns.

    Attributes:
        events, statuses, services: with their arrival.
        lags_ns: by second of the samples' clock, least arrival of a sample minus its time.
        unreadable: payloads that are not what their key says.
    """

    def __init__(self, link: Link) -> None:
        self.events = list[tuple[int, ContactEvent]]()
        self.statuses = list[tuple[int, LearnerStatus]]()
        self.services = list[tuple[int, ServiceStatus]]()
        self.lags_ns: dict[int, int] = {}
        self.unreadable = list[object]()
        take = self._taking
        link.subscribe(ALL_CONTACT, take(ContactEvent, self.events.append), history=True)
        link.subscribe(ALL_LEARNER, take(LearnerStatus, self.statuses.append))
        link.subscribe(SERVICE_STATUS, take(ServiceStatus, self.services.append), history=True)
        # All legs of a tick are sent together: one tells when the source sent them.
        link.subscribe(servo_key(shipped_robot().leg_ids[0]), take(ServoSample, self._lag))

    def _taking(self, kind: type[Message], keep: Callable[[Any], None]) -> Callable[..., None]:
        def take(received: Received) -> None:
            now_ns = time.time_ns() - (time.monotonic_ns() - received.arrival_ns)
            message = decode(received.payload, kind, received.encoding)
            if isinstance(message, kind):
                keep((now_ns, message))
            else:
                self.unreadable.append(message)

        return take

    def _lag(self, sent: tuple[int, ServoSample]) -> None:
        now_ns, sample = sent
        second, lag_ns = sample.t_ns // NS_PER_S, now_ns - sample.t_ns
        self.lags_ns[second] = min(lag_ns, self.lags_ns.get(second, lag_ns))


class Take(NamedTuple):
    """What a run left.

    ``left_behind`` are child processes of a killed service that did not end by themselves.
    """

    recording: Path
    heard: Heard
    broken: list[Broken]
    resident: list[Resident]
    simulator: str
    left_behind: int


def conduct(plan: SoakPlan) -> Take:
    """Run a soak; the folder of its plan must exist."""
    with ExitStack() as stack:
        run = _Run(plan, stack)
        pid = run.service.process.pid
        print(f"router on {run.endpoint}, service {pid}, simulator starts", flush=True)
        recording = plan.out / "soak.mcap"
        walk = stack.enter_context(
            contextlib.closing(Program(*_walk(plan, run.endpoint, recording)))
        )
        began_s = time.monotonic()
        faults = deque(plan.faults)
        while walk.process.poll() is None:
            time.sleep(_LOOK_S)  # several processes and sockets: there is no one thing to wait for
            at_s = time.monotonic() - began_s
            run.look()
            if faults and at_s >= faults[0].at_s:
                fault = faults.popleft()
                run.do(fault)
                print(f"{at_s:5.0f} s  {fault.kind} killed and started again", flush=True)
        assert walk.wait() == 0, walk.lines[-5:]
        until_s = time.monotonic() + _SETTLE_S  # the last statuses are on their way
        while time.monotonic() < until_s:
            time.sleep(_LOOK_S)
            run.look()
        left_behind = run.bury(_ORPHAN_S)
        return Take(recording, run.heard, run.broken, run.resident, walk.lines[-1], left_behind)


class _Run:
    """Router and service as they live and die, and what is heard meanwhile."""

    def __init__(self, plan: SoakPlan, stack: ExitStack) -> None:
        self.broken: list[Broken] = []
        self.resident: list[Resident] = []
        self._plan = plan
        self._dead: list[Program] = []
        self._orphans: list[psutil.Process] = []
        self._router = Program("-c", ROUTER, "tcp/127.0.0.1:0")
        stack.callback(lambda: self._router.close())
        self.endpoint = self._router.wait_line("^tcp/").string
        self.service = self._start_service()
        stack.callback(lambda: self.service.close())
        stack.callback(self.bury, 0.0)
        self.service.wait_line("connected to ", _START_S)
        link = stack.enter_context(Link.open(client_settings([self.endpoint], wait=False)))
        self.heard = Heard(link)

    def look(self) -> None:
        """See that all is alive, and how much memory it takes now and then."""
        for one in (self.service, self._router):
            assert one.process.poll() is None, one.lines[-5:]
        after_s = time.monotonic() - self._service_began_s
        life = len(self._dead)
        last = self.resident[-1] if self.resident else Resident(-1, 0.0, 0.0)
        if last.life != life or after_s - last.after_s >= _MEMORY_EVERY_S:
            rss = psutil.Process(self.service.process.pid).memory_info().rss
            self.resident.append(Resident(life, after_s, rss / 1e6))

    def do(self, fault: Fault) -> None:
        """Break something, and start it again."""
        from_ns = time.time_ns()
        if fault.kind == "router":
            self._router.process.kill()
            self._router.close()
            time.sleep(_OUTAGE_S)  # the length of the outage, not a synchronisation
            self._router = Program("-c", ROUTER, self.endpoint)
            self._router.wait_line("^tcp/")
        else:
            dead = self.service.process
            self._orphans += psutil.Process(dead.pid).children(recursive=True)
            dead.kill()  # as a crash would: nothing is saved, nobody is told
            dead.wait(_DEAD_S)
            self._dead.append(self.service)
            self.service = self._start_service()
            self.service.wait_line("connected to ", _START_S)
        self.broken.append(Broken(fault.kind, from_ns, time.time_ns()))

    def bury(self, patience_s: float) -> int:
        """End the children of killed services that have not ended by themselves; how many."""
        _, living = psutil.wait_procs(self._orphans, patience_s)
        for one in living:
            with contextlib.suppress(psutil.NoSuchProcess):  # it has just ended
                one.kill()
        for one in self._dead:  # its output stays open as long as its children do
            one.close()
        return len(living)

    def _start_service(self) -> Program:
        self._service_began_s = time.monotonic()
        words = ("-m", "adaptive_contact", "serve", "--connect", self.endpoint)
        state = self._plan.out / "state"
        return Program(*words, "--state", state, "--log-level", "warning")


def _walk(plan: SoakPlan, endpoint: str, recording: Path) -> tuple[str, ...]:
    drifts = [text for drift in plan.drifts for text in ("--drift", drift.option)]
    return (
        *("-m", "adaptive_contact", "sim", "walk", "--gait", "tripod"),
        *("--terrain", "rough", "--stop-on", "truth"),
        *("--seconds", f"{plan.seconds:g}", "--seed", str(plan.seed), *drifts),
        *("--record", str(recording), "--connect", endpoint),
    )


# -- What happens when, in a soak of any length

FaultKind = Literal["router", "service"]

# Events must be right again so long after the end of a cause.
RECOVERY_S: Final = 2.0
# Memory is judged after so long: buffers fill, and the first refits load their libraries.
WARM_UP_S: Final = 180.0
_WARM_UP_SHARE: Final = 0.15
_RAMP_SHARE: Final = 0.05


class Fault(NamedTuple):
    """Something that is killed and started again, s after the walk began."""

    kind: FaultKind
    at_s: float


class Drifting(NamedTuple):
    """A change of a leg, as the simulator's ``--drift`` takes it, s of simulated time."""

    spec: str
    at_s: float
    duration_s: float

    @property
    def option(self) -> str:
        """For the command line."""
        return f"{self.spec}@{self.at_s:g}s"


@dataclass(frozen=True)
class SoakPlan:
    """A soak.

    Attributes:
        out: folder of what it writes.
        minutes: of walking, in real time.
        seed: of the walk.
    """

    out: Path = Path("out/soak")
    minutes: float = 30.0
    seed: int = 0

    @property
    def seconds(self) -> float:
        """Of walking."""
        return 60.0 * self.minutes

    @property
    def warm_up_s(self) -> float:
        """Of each life of the service."""
        return min(WARM_UP_S, _WARM_UP_SHARE * self.seconds)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Two routers and one service, well apart."""
        shares: tuple[tuple[FaultKind, float], ...] = (
            ("router", 0.3),
            ("service", 0.55),
            ("router", 0.8),
        )
        return tuple(Fault(kind, share * self.seconds) for kind, share in shares)

    @property
    def drifts(self) -> tuple[Drifting, ...]:
        """Steps and ramps of one leg after the other, and of all of them."""
        ramp_s = round(_RAMP_SHARE * self.seconds, 1)
        ramp = f"shape=ramp,duration={ramp_s:g}"
        changes: tuple[tuple[str, float, float], ...] = (
            ("mass:leg=rf,joint=all,value=0.03", 0.12, 0.0),
            (f"friction:leg=lm,joint=all,value=2,{ramp}", 0.2, ramp_s),
            ("friction:leg=rr,joint=femur,value=3", 0.4, 0.0),
            (f"supply:leg=all,joint=all,value=10.5,{ramp}", 0.47, ramp_s),
            ("mass:leg=rf,joint=all,value=0", 0.65, 0.0),
            ("friction:leg=rr,joint=femur,value=1", 0.72, 0.0),
            (f"supply:leg=all,joint=all,value=12,{ramp}", 0.88, ramp_s),
        )
        return tuple(
            Drifting(spec, round(share * self.seconds, 1), duration)
            for spec, share, duration in changes
        )
