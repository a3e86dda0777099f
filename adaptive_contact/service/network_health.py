"""Watches what is around the service: router, other services, keys without a reader.

Two services on one network give every event twice, and are never wanted; nothing on the wire
stops them, so each listens for the status of others and says that they are there.

Looked at once a second by the worker, which must not wait: why a router is lost is found out on a
thread of its own, for a look-up of a name or a host that is off can take seconds.
"""

from __future__ import annotations

import secrets
import threading
from collections import deque

import structlog

from adaptive_contact.service.link import Declared, Link
from adaptive_contact.service.logs import LogThrottle
from adaptive_contact.service.settings import shown
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import MAX_PAYLOAD_BYTES, decode, meant_key, namespace_of
from adaptive_contact.wire.received import Received

_log = structlog.get_logger()


class UnreadKeys:
    """Looks for misspelt keys while a described leg has no samples, and only then.

    A leg that has samples needs no help, and a second subscription to all of them would cost.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._listening: list[Declared] = []
        self._found: dict[str, str] = {}  # filled on Zenoh's thread
        self._throttle = LogThrottle()

    def check_keys(self, *, lonely: bool, now_ns: int) -> dict[str, str]:
        """Check for keys without a reader; return each with what was probably meant."""
        if lonely and not self._listening:
            # Keys that look like those of samples.  Others, such as a camera's pictures, are not
            # asked for.
            self._listening = [
                self._link.subscribe(key, self._receive) for key in ("**/$*ervo$*", "**/servo/*")
            ]
        elif not lonely and self._listening:
            for declared in self._listening:
                declared.close()
            self._listening = []
            self._found = {}
        found = dict(self._found)
        for key, question in found.items():
            what = "a key is read by nobody"
            self._throttle.warn(key, now_ns, what, key=key, question=question)
        return found

    def _receive(self, received: Received) -> None:
        key = received.key
        if key in self._found or len(self._found) >= 8:
            return
        meant, namespace = meant_key(key), namespace_of(key)
        if meant is not None:
            self._found[key] = f"did you mean {meant}?"
        elif namespace:
            self._found[key] = f"is {namespace} the robot's --namespace?"


class NetworkHealth:
    """Watches router, sessions and other services, and logs what changes."""

    def __init__(self, link: Link, now_ns: int) -> None:
        self.note: str | None = None  # one line on what is wrong, None when all is well
        self.instance = secrets.token_hex(4)  # the service's own mark among others
        self._link = link
        self._statuses: deque[Received] = deque(maxlen=32)
        self._other: tuple[int, ServiceStatus] | None = None  # the newest, and when it came
        self._throttle = LogThrottle()
        self._due_ns = now_ns
        self._joined = link.is_connected()  # a router runs before it is let in, a client does not
        self._connected = True
        link.subscribe(SERVICE_STATUS, self._receive)

    def check_network(self, now_ns: int) -> None:
        """Check the network once a second."""
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + 1_000_000_000
        rival = self._rival(now_ns)
        if rival is not None:
            self._throttle.warn("rival", now_ns, "not alone", why=rival)
        connected = self._link.is_connected()
        where = " or ".join(map(shown, self._link.joins))
        apart = None if connected else f"no router joined at {where}; trying on"
        most, full = self._link.max_sessions, None
        if self._link.sessions() >= most:
            full = (
                f"{most} sessions are connected, as many as may be: others are refused; close "
                "some, or give serve a larger --max-sessions"
            )
            self._throttle.warn("full", now_ns, "no room for another session", why=full)
        self.note = "; ".join(filter(None, (rival, apart, full))) or None
        if connected and not self._connected:
            _log.info("router is back" if self._joined else "router joined")
        if not connected and (
            self._throttle.passes("router", now_ns) is not None or self._connected
        ):
            threading.Thread(target=self._log_cause, name="why", daemon=True).start()
        self._connected = connected
        self._joined |= connected

    def _receive(self, received: Received) -> None:
        if len(received.payload) <= MAX_PAYLOAD_BYTES:  # no service says more, and these are kept
            self._statuses.append(received)

    def _rival(self, now_ns: int) -> str | None:
        """Name another service on the network in one line, else None; ``now_ns`` is monotonic."""
        for _ in range(len(self._statuses)):
            received = self._statuses.popleft()
            status = decode(received.payload, ServiceStatus, received.encoding)
            if isinstance(status, ServiceStatus) and status.instance != self.instance:
                self._other = (received.arrival_ns, status)
        # A service sends its status once a second.
        if self._other is None or now_ns - self._other[0] >= 3_000_000_000:
            return None
        other = self._other[1]
        return (
            f"another service runs here for robot {other.robot[:32]} (up {other.uptime_s:.0f} s): "
            "every event comes twice; stop one of them, or give each robot a --namespace"
        )

    def _log_cause(self) -> None:
        what = "router lost, reconnecting" if self._joined else "router not joined yet, trying on"
        _log.warning(what, why=self._link.diagnose().line)
