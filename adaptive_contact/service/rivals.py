"""Other services that answer for the same legs.

Two services on one network give every event twice, and are never wanted; nothing on the wire
stops them, so each listens for the status of others and says that they are there.
"""

from __future__ import annotations

import secrets
from collections import deque
from typing import Final

from adaptive_contact.service.link import Link
from adaptive_contact.service.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.service.traffic import Received
from adaptive_contact.wire import MAX_PAYLOAD_BYTES, decode

__all__ = ["Rivals"]

# A service speaks once a second.
_GONE_AFTER_NS: Final = 3_000_000_000
_REMEMBERED: Final = 8


class Rivals:
    """Listens for other services.

    Args:
        link: open.

    Attributes:
        instance: our own mark, to be told in our own status.
    """

    def __init__(self, link: Link) -> None:
        self.instance = secrets.token_hex(4)
        self._heard: deque[Received] = deque(maxlen=4 * _REMEMBERED)
        self._seen: dict[str, tuple[int, ServiceStatus]] = {}
        link.subscribe(SERVICE_STATUS, self._hear)

    def _hear(self, received: Received) -> None:
        if len(received.payload) <= MAX_PAYLOAD_BYTES:  # no service says more, and these are kept
            self._heard.append(received)

    def note(self, now_ns: int) -> str | None:
        """One line where another service is there, otherwise None; ``now_ns`` is monotonic."""
        for _ in range(len(self._heard)):
            received = self._heard.popleft()
            status = decode(received.payload, ServiceStatus, received.encoding)
            if isinstance(status, ServiceStatus) and status.instance != self.instance:
                self._seen.pop(status.instance, None)
                self._seen[status.instance] = (received.arrival_ns, status)
                if len(self._seen) > _REMEMBERED:  # somebody makes them up
                    del self._seen[next(iter(self._seen))]
        self._seen = {
            mark: seen for mark, seen in self._seen.items() if now_ns - seen[0] < _GONE_AFTER_NS
        }
        if not self._seen:
            return None
        _, other = next(reversed(self._seen.values()))
        return (
            f"another service runs here for robot {other.robot[:32]} (up {other.uptime_s:.0f} s): "
            "every event comes twice; stop one of them, or give each robot a --namespace"
        )
