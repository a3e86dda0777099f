"""The loop that serves virtual ports.

One thread does it all: it brings the backend up to the moment, answers what has come, and sleeps
in ``select`` until the next packet, reply or physics step.

A virtual robot put together: ports and servos as a description says, over a backend.
"""

from __future__ import annotations

import gc
import math
import select
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from adaptive_contact.bridge.plan import PortPlan, protocol_of
from adaptive_contact.bridge.tables import models_named
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Port, Robot
from adaptive_contact_sim.virtual.backend import Backend
from adaptive_contact_sim.virtual.faults import FaultSchedule, FaultSpec
from adaptive_contact_sim.virtual.port import VirtualPort
from adaptive_contact_sim.virtual.servo import VirtualServo


class VirtualServer:
    """Serves virtual ports in real time."""

    def __init__(self, ports: Sequence[VirtualPort], backend: Backend) -> None:
        self.ports = tuple(ports)
        self._backend = backend
        self._start_s = 0.0

    def __enter__(self) -> VirtualServer:
        self._start_s = time.monotonic()
        for port in self.ports:
            port.open()
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports:
            port.close()

    def run(self, stop: threading.Event, seconds: float = math.inf) -> None:
        """Serve until stopped, or for so long; the ports have to be open (``with server:``)."""
        # What exists now stays: a full collection would keep the bus waiting for tens of ms.
        gc.collect()
        gc.freeze()
        while not stop.is_set() and (now_s := time.monotonic()) - self._start_s < seconds:
            for port in self.ports:  # a cable is pulled, or put back
                out = port.faults.hung_up(port.name, now_s - self._start_s)
                if out and port.is_up:
                    port.close()
                elif not out and not port.is_up:
                    port.open()
            next_s = min(self._backend.advance(now_s), now_s + 0.05)
            for port in self.ports:
                if port.is_up:
                    next_s = min(next_s, port.flush(time.monotonic()))
            masters = {port.master: port for port in self.ports if port.is_up}
            wait_s = max(next_s - time.monotonic(), 0.0)
            ready, _, _ = select.select(list(masters), [], [], wait_s)
            if ready:
                # The servos are where they are when asked, not where they were a step ago.
                self._backend.advance(time.monotonic())
            for master in ready:
                now_s = time.monotonic()
                masters[master].receive(now_s, now_s - self._start_s)
                masters[master].flush(time.monotonic())


def with_servos(robot: Robot, model: str) -> Robot:
    """A description whose servos are all of another model.

    Raises:
        ConfigurationError: there is no such model.
    """
    kind = models_named(model)[-1]  # of a family, the usual one
    legs = tuple(
        msgspec.structs.replace(
            leg,
            quantum_rad=None,
            servos=leg.servos and msgspec.structs.replace(leg.servos, model=kind.name),
        )
        for leg in robot.legs
    )
    ports = {
        name: msgspec.structs.replace(port, protocol=kind.protocol, fast=False)
        for name, port in robot.ports.items()
    }
    return msgspec.structs.replace(
        robot, legs=legs, ports=ports, quantum_rad=round(kind.step_rad, 6)
    )


def with_ports(robot: Robot, directory: Path, ports: int | None) -> Robot:
    """A description whose ports lie in a directory.

    Args:
        robot: its own ports are kept by name; one without ports gets some, legs dealt evenly.
        directory: where the links will be.
        ports: how many to make for a robot without any; None for one.

    Raises:
        ConfigurationError: there are more ports than legs, a leg has no servos, or a robot that has
            ports of its own is to get others.
    """
    if robot.ports and ports not in (None, len(robot.ports)):
        raise ConfigurationError(
            f"--ports {ports}: '{robot.name}' has ports of its own ({', '.join(robot.ports)}); "
            "leave --ports out"
        )
    ports = ports or 1
    if robot.ports:
        own = {
            name: msgspec.structs.replace(port, device=str(directory / name))
            for name, port in robot.ports.items()
        }
        return msgspec.structs.replace(robot, ports=own)
    if not 1 <= ports <= len(robot.legs):
        raise ConfigurationError(
            f"{ports} ports for {len(robot.legs)} legs; expected 1 to {len(robot.legs)}"
        )
    names = [f"port{i}" for i in range(ports)]
    legs = []
    for i, leg in enumerate(robot.legs):
        if leg.servos is None:
            raise ConfigurationError(
                f"leg '{leg.id}' of '{robot.name}' has no servos; add servos = {{ ids = [...] }}"
            )
        servos = msgspec.structs.replace(leg.servos, port=names[i * ports // len(robot.legs)])
        legs.append(msgspec.structs.replace(leg, servos=servos))
    protocol = protocol_of(robot)
    made = {name: Port(device=str(directory / name), protocol=protocol) for name in names}
    return msgspec.structs.replace(robot, legs=tuple(legs), ports=made)


def assemble(
    plans: Sequence[PortPlan],
    backend: Backend,
    order: Sequence[tuple[str, str]],
    faults: Sequence[FaultSpec],
    *,
    seed: int,
    wire_time: bool,
) -> VirtualServer:
    """Make the ports of a robot, closed.

    Args:
        plans: what is on which port.
        backend: what moves.
        order: (leg, joint) of the backend's servos.
        faults: what goes wrong, and when.
        seed: of reading noise and faults.
        wire_time: let answers take as long as on a real wire.
    """
    place = {pair: i for i, pair in enumerate(order)}
    seeds = np.random.SeedSequence(seed).spawn(2)
    noise_rng, fault_rng = (np.random.default_rng(seed) for seed in seeds)
    schedule = FaultSchedule(faults, fault_rng)
    ports = []
    for plan in plans:
        servos = [
            VirtualServo(
                joint.servo,
                joint.models[-1],  # of a family, the usual one
                backend,
                place[leg.id, joint.name],
                noise_rng,
                baud=plan.port.baud,
            )
            for leg in plan.legs
            for joint in leg.joints
        ]
        ports.append(
            VirtualPort(
                plan.name,
                Path(plan.port.device),
                servos,
                schedule,
                baud=plan.port.baud,
                wire_time=wire_time,
            )
        )
    return VirtualServer(ports, backend)


def check_faults(plans: Sequence[PortPlan], faults: Sequence[FaultSpec]) -> None:
    """Make sure that faults are of servos and ports that there are.

    Raises:
        ConfigurationError: one is not.
    """
    servos = sorted({joint.servo for plan in plans for joint in plan.joints})
    ports = [plan.name for plan in plans]
    for fault in faults:
        if fault.servo is not None and fault.servo not in servos:
            raise ConfigurationError(
                f"fault '{fault.kind}' of servo {fault.servo}: there is no such servo; ids are "
                f"{', '.join(map(str, servos))}"
            )
        if fault.port is not None and fault.port not in ports:
            raise ConfigurationError(
                f"fault '{fault.kind}' of port '{fault.port}': there is no such port; there are "
                f"{', '.join(ports)}"
            )
