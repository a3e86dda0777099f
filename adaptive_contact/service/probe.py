"""Why a router cannot be joined: nobody there, or there and refusing.

Zenoh gives a refused client the same error as one that finds nobody (measured on 1.10.2), so
the two are told apart from outside: a TCP connection that opens says somebody listens.
"""

from __future__ import annotations

import enum
import socket
from collections.abc import Sequence
from typing import NamedTuple

from adaptive_contact.errors import LinkError
from adaptive_contact.service.settings import shown, tcp_address

__all__ = ["REMEDY", "Finding", "NoRouterError", "Reach", "probe"]


class Reach(enum.StrEnum):
    """What stands between us and a router."""

    CONNECTED = "connected"
    UNREACHABLE = "unreachable"
    REFUSING = "refusing"
    UNKNOWN = "unknown"


class Finding(NamedTuple):
    """What a probe found, and one line for a person.

    ``certain`` where trying to join would be in vain: every host has said that nobody listens.
    """

    reach: Reach
    line: str
    certain: bool = False


class NoRouterError(LinkError):
    """No router could be joined; ``finding`` says which of the reasons it seems to be."""

    def __init__(self, finding: Finding, prefix: str = "") -> None:
        super().__init__(prefix + finding.line)
        self.finding = finding


_NOBODY = "nobody listens on {}"
REMEDY = "start `adaptive-contact serve` there, or give the router's address with --connect"


def probe(endpoints: Sequence[str], *, timeout_s: float = 0.4) -> Finding:
    """Look from outside at routers that could not be joined.

    Args:
        endpoints: Zenoh endpoints, tried in order until one listens.
        timeout_s: for each; bounds the call to ``len(endpoints) * timeout_s`` and a name look-up.

    Returns:
        ``REFUSING`` where one accepts connections, ``UNREACHABLE`` where none does, ``UNKNOWN``
        where only protocols are asked for that cannot be probed (QUIC, UDP, serial).
    """
    lines: list[str] = []
    unknown = False
    certain = True
    for endpoint in endpoints:
        address, text = tcp_address(endpoint), shown(endpoint)
        if address is None:
            unknown = True
            lines.append(f"no router answers on {text} (unreachable or refusing); {REMEDY}")
            continue
        why = _tcp(address, timeout_s)
        if why is None:
            return Finding(
                Reach.REFUSING,
                f"refused: {text} accepts connections but opens no Zenoh session; it wants a user "
                "and password or TLS (--zenoh-config FILE), or has no room for another session, or "
                "it is not a Zenoh router",
            )
        lines.append(f"unreachable: {why.format(text)}; {REMEDY}")
        certain = certain and why is _NOBODY
    if not lines:
        return Finding(Reach.UNKNOWN, "no endpoint to connect to; give one with --connect")
    if unknown:
        return Finding(Reach.UNKNOWN, lines[0])
    return Finding(Reach.UNREACHABLE, lines[0], certain)


def _tcp(address: tuple[str, int], timeout_s: float) -> str | None:
    """None where the port accepts a connection, otherwise why not, with ``{}`` for its name."""
    try:
        socket.create_connection(address, timeout=timeout_s).close()
    except (socket.gaierror, UnicodeError):  # unknown, or none that could be a name
        return f"the host name '{address[0]}' of {{}} is not known"
    except TimeoutError:
        return "no answer from {} (host off, or a firewall)"
    except ConnectionRefusedError:
        return _NOBODY
    except OSError as error:
        return f"{{}} cannot be reached ({(error.strerror or str(error)).lower()})"
    return None
