"""A logger: every contact, and every change of a learner or a bridge, one line each.

::

    python examples/logger.py                       # the local service
    python examples/logger.py --connect tcp/hexapod1:7447 >> contacts.log

Needs ``adaptive-contact``.
"""

from __future__ import annotations

import argparse
import datetime
import queue
import signal
import sys
import threading
from pathlib import Path

from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.printable import printable
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.settings import Finding
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    BridgeStatus,
    ContactEvent,
    LearnerStatus,
    Rejected,
    decode,
    leg_of_key,
)

BRIDGES = "robot/bridge/*/status"


def contact_line(event: ContactEvent) -> str:
    """A contact, or its end."""
    if event.withheld:
        return f"{event.leg} not known: {event.status}"
    if not event.contact:
        return f"{event.leg} released"
    late_ms = (event.t_ns - event.onset_ns) / 1e6
    return f"{event.leg} contact  score {event.score:.1f}, touched {late_ms:.0f} ms before"


def learner_line(status: LearnerStatus) -> str:
    """How a leg's learner is."""
    note = f"  ({status.note})" if status.note else ""
    return f"{status.leg} learner {status.status}, model {status.model_version}{note}"


def bridge_line(status: BridgeStatus) -> str:
    """How a bridge's port is, without its figures."""
    silent = [servo for servo, counts in status.servos.items() if counts.silent]
    alarms = [f"{s} {' '.join(c.alarms)}" for s, c in status.servos.items() if c.alarms]
    line = f"bridge {status.port} {status.state}"
    if silent:
        line += f", silent servos {', '.join(silent)}"
    if alarms:
        line += f", alarms: {'; '.join(alarms)}"
    return line


def main() -> int:
    """Log until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", action="append", help="router, such as tcp/127.0.0.1:7447")
    parser.add_argument("--namespace", help="prefix of all keys, such as hexapod1")
    parser.add_argument("--zenoh-config", type=Path, help="JSON5 file with a user or TLS")
    options = parser.parse_args()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        log(options, stop)
    except AdaptiveContactError as error:
        if stop.is_set():  # while it waited for a router
            return 0
        print(f"logger: {error}", file=sys.stderr)
        return 2
    return 0


def say(finding: Finding) -> None:
    """What stands in the way of the network."""
    print(f"logger: {finding.line}; trying on", file=sys.stderr, flush=True)


def log(options: argparse.Namespace, stop: threading.Event) -> None:
    """Print what is news until stopped."""
    inbox: queue.Queue = queue.Queue()  # callbacks only put; the loop below does the work
    last: dict[str, str] = {}
    settings = client_settings(
        options.connect or (), namespace=options.namespace, zenoh_config=options.zenoh_config
    )
    with Link.open(settings, on_wait=say, stop=stop) as link:
        # The last word on each leg comes to who joins late, too.
        link.subscribe(ALL_CONTACT, inbox.put, history=True)
        for key in (ALL_LEARNER, BRIDGES):
            link.subscribe(key, inbox.put)
        print("listening", flush=True)
        while not stop.is_set():
            try:
                received = inbox.get(timeout=0.2)
            except queue.Empty:
                continue
            kind = received.key.rpartition("/")[2]
            if kind == "contact":
                event = decode(received.payload, ContactEvent, received.encoding)
                line = None if isinstance(event, Rejected) else contact_line(event)
            elif leg_of_key(received.key) is not None:
                status = decode(received.payload, LearnerStatus, received.encoding)
                line = None if isinstance(status, Rejected) else learner_line(status)
            else:
                bridge = decode(received.payload, BridgeStatus, received.encoding)
                line = None if isinstance(bridge, Rejected) else bridge_line(bridge)
            if line is None or (kind != "contact" and last.get(received.key) == line):
                continue  # a status comes every second: only changes are news
            last[received.key] = line
            now = datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
            print(now, printable(line), flush=True)


if __name__ == "__main__":
    sys.exit(main())
