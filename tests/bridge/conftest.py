"""Virtual buses in a thread, opened by the real DynamixelSDK."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive_contact.bridge import handshake
from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.loop import PortLoop
from adaptive_contact.bridge.plan import PortPlan, plan_ports
from adaptive_contact.bridge.tables import models_named
from adaptive_contact.bridge.transport import Mailbox
from adaptive_contact.robot import Robot
from adaptive_contact.wire import MSGPACK, BridgeStatus, Command, ServoSample, encode
from adaptive_contact_sim.virtual import (
    FaultSchedule,
    VirtualPort,
    VirtualServer,
    VirtualServo,
    parse_fault,
)

sys.path.insert(0, str(Path(__file__).parent))  # the helpers beside the tests
import os

import described
from anybus import serve
from described import Serve
from kinematic import KinematicBackend

from programs import Program
from waiting import until

PERIOD_S = 0.02


@pytest.fixture(autouse=True)
def _few_ids(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look for servos 0 to 30 only: an id without a servo costs the wait for its ping.

    Commands that are processes of their own look for all.
    """
    monkeypatch.setattr(handshake, "ALL_IDS", range(31))
    monkeypatch.setattr(handshake, "BEYOND", 2)


Check = Callable[[Any], Any]


@dataclasses.dataclass
class Rig:
    """A robot on a virtual port, served by a thread."""

    robot: Robot
    plans: tuple[PortPlan, ...]
    backend: KinematicBackend
    faults: FaultSchedule
    port: VirtualPort

    def fault(self, *texts: str) -> None:
        """Put these faults in force, from now on, and no others."""
        self.faults.specs = tuple(parse_fault(text) for text in texts)

    def servo(self, servo: int) -> VirtualServo:
        return next(s for s in self.port.servos if s.id == servo)


class Catcher:
    """An outlet that keeps everything, and can be waited on.

    Ticks without a leg are left out: on a busy computer a servo may be heard a tick later.
    """

    def __init__(self, legs: int) -> None:
        self._legs = legs
        self.ticks: list[dict[str, ServoSample]] = []
        self.statuses: list[BridgeStatus] = []
        self.lines: list[str] = []
        self.status = self.statuses.append
        self.print_line = self.lines.append

    def samples(self, samples: Mapping[str, ServoSample]) -> None:
        if len(samples) == self._legs:
            self.ticks.append(dict(samples))

    def wait(self, true: Callable[[Catcher], Any], timeout_s: float = 40.0) -> None:
        until(
            lambda: true(self),
            lambda: f"{len(self.ticks)} ticks, {self.lines}, {self.statuses[-1:]}",
            timeout_s,
        )

    def go_on(self, ticks: int, feed: Callable[[Check], Check] = lambda true: true) -> None:
        """Wait for so many ticks more."""
        before = len(self.ticks)
        self.wait(feed(lambda _: len(self.ticks) >= before + ticks))


@pytest.fixture
def served() -> Iterator[Callable[[VirtualServer], None]]:
    """Serves virtual servers from threads, which end with the test."""
    stop, threads = threading.Event(), list[threading.Thread]()
    with contextlib.ExitStack() as stack:

        def start(server: VirtualServer) -> None:
            stack.enter_context(server)
            threads.append(threading.Thread(target=server.run, args=(stop,), daemon=True))
            threads[-1].start()

        yield start
        stop.set()
        for thread in threads:
            thread.join(5.0)


@pytest.fixture
def rig(tmp_path: Path, served: Callable[[VirtualServer], None]) -> Callable[..., Rig]:
    """Makes rigs."""

    def make(
        model: str | list[str],
        protocol: int | str,
        *,
        legs: int = 2,
        noise_steps: float = 0.0,
        wire_time: bool = False,
        seed: int = 7,
        **port: object,
    ) -> Rig:
        device = tmp_path / "p0"
        ids = [(range(3 * i + 1, 3 * i + 4), model) for i in range(legs)]
        port = {"protocol": protocol, "timeout_ms": 10, **port}
        robot = described.robot(device, *ids, name="p0", limit_rad=1.0, **port)
        plans = plan_ports(robot)
        backend = KinematicBackend(3 * legs)
        rng = np.random.default_rng(seed)
        faults = FaultSchedule([], rng)
        servos = [
            VirtualServo(
                joint.servo,
                models_named(joint.model.name)[0],
                backend,
                joint.servo - 1,
                rng,
                noise_steps=noise_steps,
                baud=plans[0].port.baud,
            )
            for joint in plans[0].joints
        ]
        made = VirtualPort("p0", device, servos, faults, wire_time=wire_time)
        served(VirtualServer([made], backend))
        return Rig(robot, plans, backend, faults, made)

    return make


@pytest.fixture
def opened() -> Iterator[Callable[[Rig], Bus]]:
    """Opens the first port of a rig, patiently: this computer may be busy."""
    with contextlib.ExitStack() as stack:

        def open_(rig: Rig) -> Bus:
            bus = stack.enter_context(contextlib.closing(Bus("p0", rig.plans[0].port)))
            bus.open()
            bus.port.timeout_ms = max(bus.port.timeout_ms, 100.0)
            return bus

        yield open_


class Running:
    """A loop on a thread."""

    def __init__(self, rig: Any, mode: Any, catcher: Any) -> None:
        self.rig, self.catcher = rig, catcher
        self.mailbox = Mailbox()
        self.loop = PortLoop(rig.plans[0], mode, catcher, self.mailbox, run=11)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.loop.run, args=(self._stop,), daemon=True)
        self._thread.start()

    def command(self, leg: str, *desired: float, preview: list[list[float]] | None = None) -> None:
        payload = encode(Command(desired=list(desired), preview=preview))
        self.mailbox.store_command(leg, payload, MSGPACK, time.monotonic_ns())

    def commanding(
        self, desired: Sequence[float], preview: list[list[float]] | None = None
    ) -> Callable[[Check], Check]:
        """Make of what is waited for the same, with a command to the first leg before each look.

        The command is read anew each time, so that it may be changed in place.
        """

        def feed(true: Check) -> Check:
            def check(catcher: Any) -> Any:
                self.command("l0", *desired, preview=preview)
                return true(catcher)

            return check

        return feed

    def lose_servo_and_cable(self, servo: int) -> None:
        """A servo falls silent, then the cable is pulled and put back; the servo stays silent."""
        known = [one != servo for one in (1, 2, 3)]
        self.rig.fault(f"silent:id={servo}")
        self.catcher.wait(lambda c: c.ticks[-1]["l0"].valid == known)
        self.rig.fault(f"silent:id={servo}", "hangup:@0+1000000")
        self.catcher.wait(lambda c: any("is gone" in line for line in c.lines))
        self.rig.fault(f"silent:id={servo}")
        self.catcher.wait(lambda c: any("is back" in line for line in c.lines))

    def end(self) -> None:
        self._stop.set()
        self._thread.join(5.0)
        assert not self._thread.is_alive()


@pytest.fixture
def ended() -> Iterator[Callable[[Any], Any]]:
    """Ends with the test what has begun."""
    with contextlib.ExitStack() as begun:

        def keep(one: Any) -> Any:
            begun.callback(one.end)
            return one

        yield keep


@pytest.fixture
def run(rig: Callable, ended: Callable) -> Callable[..., Running]:

    def start(mode: str, ticks: int = 0, **kind: Any) -> Running:
        """A loop that has run for some ticks."""
        made = rig(**kind)
        running: Running = ended(Running(made, mode, Catcher(len(made.plans[0].legs))))
        running.catcher.wait(lambda c: len(c.ticks) >= ticks)
        return running

    return start


@pytest.fixture
def bus(tmp_path: Path, served: Callable[[VirtualServer], None]) -> Serve:
    """Serve the servos of SPECs (see ``anybus``) on a port."""

    def make(*specs: str, where: str = "bus") -> tuple[Path, Sequence[VirtualServo]]:
        (tmp_path / where).mkdir()
        server, _ = serve(tmp_path / where, specs)
        served(server)
        return tmp_path / where / "port0", server.ports[0].servos

    return make


@pytest.fixture
def start(program: Callable[..., Program], tmp_path: Path) -> Callable[..., Program]:
    """Start a command of ours, or an example, in the test's folder."""
    own = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}

    def begin(*words: str) -> Program:
        module = () if words[0].endswith(".py") else ("-m", "adaptive_contact")
        return program(*module, *words, cwd=tmp_path, env=own)

    return begin
