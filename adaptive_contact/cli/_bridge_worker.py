"""Runs one port's process: the bridge's loop on one side, Zenoh on the other."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from typing import Any, Literal

from adaptive_contact.bridge.loop import PortLoop
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.bridge.transport import Mailbox
from adaptive_contact.cli._link import enable_realtime, unless_stopped
from adaptive_contact.cli._output import print_line, protect_output
from adaptive_contact.cli._signals import on_signals
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.service.link import Link, LinkSettings
from adaptive_contact.service.settings import Finding
from adaptive_contact.wire import (
    BridgeStatus,
    ServoSample,
    bridge_status_key,
    command_key,
    servo_key,
)


class ZenohOutlet:
    """Publishes a port's samples and status."""

    def __init__(self, link: Link, plan: PortPlan) -> None:
        self._servo = {leg.id: link.publisher(servo_key(leg.id)) for leg in plan.legs}
        self._status = link.publisher(bridge_status_key(plan.name))

    def samples(self, samples: Mapping[str, ServoSample]) -> None:
        """Publish one control tick's samples."""
        for leg, sample in samples.items():
            self._servo[leg].put(sample)

    def status(self, status: BridgeStatus) -> None:
        """Publish how the port is."""
        self._status.put(status)

    def print_line(self, line: str) -> None:
        """Print a line for the person at the terminal."""
        _print_bridge_line(line)


def listen(link: Link, plan: PortPlan, mailbox: Mailbox) -> None:
    """Let the commands of a port's legs go into a mailbox."""
    for leg in plan.legs:

        def sink(received: Any, leg: str = leg.id) -> None:
            mailbox.store_command(leg, received.payload, received.encoding, received.arrival_ns)

        link.subscribe(command_key(leg.id), sink)


def run_port(
    plan: PortPlan,
    mode: Literal["observe", "drive"],
    settings: LinkSettings,
    run: int,
    realtime: bool = False,
    phase: float = 0.0,
) -> None:
    """Run a port until SIGTERM or SIGINT; the target of a spawned process."""
    protect_output()
    stop = threading.Event()
    on_signals(lambda *_: stop.set())
    # Before Zenoh makes its threads: a publication waits for their locks, and would otherwise
    # wait for as long as an ordinary thread that holds one is not let run.
    enable_realtime(realtime)

    def waits(finding: Finding) -> None:
        _print_bridge_line(f"port {plan.name}: {finding.line}; trying on")

    try:
        with unless_stopped(stop), Link.open(settings, on_wait=waits, stop=stop) as link:
            outlet, mailbox = ZenohOutlet(link, plan), Mailbox()
            if mode == "drive":
                listen(link, plan, mailbox)
            PortLoop(plan, mode, outlet, mailbox, run, phase=phase).run(stop)
    except AdaptiveContactError as error:
        _print_bridge_line(str(error))
        sys.exit(2)


def _print_bridge_line(line: str) -> None:
    print_line(f"adaptive-contact bridge: {line}", err=True)
