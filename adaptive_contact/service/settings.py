"""Defines how a process joins the network, and why a router cannot be joined.  No zenoh.

The service embeds a router on loopback; every other command is a client of it.  Peers do not
relay for one another behind a hub (measured, ``docs/decisions``), so ``peer`` is not offered.

Zenoh gives a refused client the same error as one that finds no listener (measured on 1.10.2), so
the two are distinguished from outside: a TCP connection that opens shows a listener.
"""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

from adaptive_contact.errors import ConfigurationError, LinkError, reason_of
from adaptive_contact.wire import JSON, MSGPACK

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

# Liveliness tokens live in a key space of their own; these do not collide with the wire's keys.
SERVICE_TOKEN: Final = "robot/service"
# A leg is silent, and what was known of it is not any more, this long after its last sample.
SILENT_AFTER_S: Final = 0.5

_PROTOCOLS: Final = ("tcp", "tls", "quic", "udp", "ws", "unixsock-stream", "vsock", "serial")
_OVER_TCP: Final = ("tcp", "tls", "ws")
_HOST_PORT = re.compile(r"(?P<host>\[[0-9A-Fa-f:.%a-z]+\]|[^\[\]:/\s]+):(?P<port>\d{1,5})\Z")


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Describes how to join the network; checked when made.

    Raises:
        ConfigurationError: in one line, what was found and what is expected.
    """

    # `router` embeds one (the service), `client` joins one (everything else)
    mode: Literal["router", "client"] = "client"
    listen: tuple[str, ...] = ()  # endpoints of the embedded router; port 0 takes a free one
    connect: tuple[str, ...] = ()  # endpoints of the routers to join
    namespace: str | None = None  # prefix of every key outside this process, None for none
    encoding: str = MSGPACK  # of what this process publishes, MSGPACK or JSON
    wait: bool = True  # whether a client waits for its router, or raises when it is not there
    # a Zenoh configuration file (JSON5) merged under these settings
    zenoh_config: Path | None = None
    insecure: bool = False  # listen beyond loopback without authentication of clients
    # that a router takes at once, None for the file's or the default
    max_sessions: int | None = None

    def __post_init__(self) -> None:
        if (
            self.namespace is not None
            and re.match(
                r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}(/[A-Za-z0-9][A-Za-z0-9_.-]{0,63}){0,7}\Z",
                self.namespace,
            )
            is None
        ):
            raise ConfigurationError(
                f"namespace '{self.namespace}' cannot be part of a key; expected letters, digits, "
                "'_', '.' or '-' and single slashes in between, such as hexapod1 or lab/hexapod1"
            )
        if self.encoding not in (MSGPACK, JSON):
            raise ConfigurationError(
                f"encoding '{self.encoding}' is unknown; expected {MSGPACK} or {JSON}"
            )
        if self.mode == "client" and self.listen:
            raise ConfigurationError("a client does not listen; leave --listen out")


def router_settings(
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    *,
    namespace: str | None = None,
    json: bool = False,
    zenoh_config: Path | None = None,
    insecure: bool = False,
    max_sessions: int | None = None,
) -> LinkSettings:
    """Make the service's settings: an embedded router, or a client if only ``connect`` is given.

    Endpoints are as typed (see :func:`endpoint`); no ``listen`` means loopback, port 7447.

    Raises:
        ConfigurationError: an endpoint or the namespace cannot be used.
    """
    joins_only = bool(connect) and not listen
    default = () if joins_only or zenoh_config is not None else (DEFAULT_ENDPOINT,)
    return LinkSettings(
        mode="client" if joins_only else "router",
        listen=tuple(endpoint(text) for text in listen) or default,
        connect=tuple(endpoint(text) for text in connect),
        namespace=namespace,
        encoding=JSON if json else MSGPACK,
        zenoh_config=zenoh_config,
        insecure=insecure,
        max_sessions=max_sessions,
    )


def client_settings(
    connect: Sequence[str] = (),
    *,
    namespace: str | None = None,
    json: bool = False,
    wait: bool = True,
    zenoh_config: Path | None = None,
) -> LinkSettings:
    """Make the settings of a client, by default of the local router.

    Raises:
        ConfigurationError: an endpoint or the namespace cannot be used.
    """
    default = () if zenoh_config is not None else (DEFAULT_ENDPOINT,)
    return LinkSettings(
        mode="client",
        connect=tuple(endpoint(text) for text in connect) or default,
        namespace=namespace,
        encoding=JSON if json else MSGPACK,
        wait=wait,
        zenoh_config=zenoh_config,
    )


def endpoint(text: str) -> str:
    """Complete an endpoint as a person types it.

    Args:
        text: ``tcp/192.168.1.7:7447``, or without the protocol, or without the port.

    Returns:
        A Zenoh endpoint, ``protocol/address``.

    Raises:
        ConfigurationError: it cannot be read as one.
    """
    text = text.strip()
    protocol, slash, address = text.partition("/")
    if not slash:
        protocol, address = "tcp", text
    if protocol not in _PROTOCOLS:
        raise ConfigurationError(
            f"endpoint '{shown(text)}': unknown protocol '{shown(protocol)}'; expected one of "
            f"{', '.join(_PROTOCOLS)}, such as {DEFAULT_ENDPOINT}"
        )
    if protocol in _OVER_TCP or protocol in ("udp", "quic"):
        # Zenoh's own options follow '?' or '#'; they are its business.
        plain = re.split(r"[?#]", address, maxsplit=1)[0]
        if re.fullmatch(r"[^\[\]:/\s]+|\[[0-9A-Fa-f:.%a-z]+\]", plain):
            address = f"{plain}:7447{address[len(plain) :]}"
            plain = f"{plain}:7447"
        match = _HOST_PORT.match(plain)
        if match is None or int(match["port"]) > 65535:
            raise ConfigurationError(
                f"endpoint '{shown(text)}' is not HOST:PORT; expected something like "
                f"{DEFAULT_ENDPOINT}"
            )
    elif not address:
        raise ConfigurationError(f"endpoint '{shown(text)}' has no address after '{protocol}/'")
    return f"{protocol}/{address}"


def shown(locator: str) -> str:
    """Remove what follows ``?`` and ``#`` in an endpoint: it can hold a private key."""
    return re.split(r"[?#]", locator, maxsplit=1)[0]


def shown_path(path: Path) -> str:
    """Decode a path for messages: its bytes need not be UTF-8."""
    return os.fsencode(path).decode(errors="replace")


def _host_port(locator: str) -> tuple[str, int] | None:
    """Return host and port of an endpoint; None where it has none."""
    address = re.split(r"[?#]", locator.partition("/")[2], maxsplit=1)[0]
    match = _HOST_PORT.match(address)
    return None if match is None else (match["host"].strip("[]"), int(match["port"]))


def tcp_address(locator: str) -> tuple[str, int] | None:
    """Return host and port of an endpoint that runs over TCP; None for other protocols."""
    return _host_port(locator) if locator.partition("/")[0] in _OVER_TCP else None


def is_loopback(locator: str) -> bool:
    """Return whether an endpoint can be reached from this machine only."""
    found = _host_port(locator)
    unix = locator.startswith("unixsock-stream/")
    return unix or (found is not None and is_loopback_host(found[0]))


def is_loopback_host(host: str) -> bool:
    """Return whether a host is this machine, reached by nobody else."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name: it may resolve to anything
        return False


def is_multicast(locator: str) -> bool:
    """Return whether members of a multicast group reach an endpoint, and it reaches them.

    Zenoh looks up what is no plain address, ``0xe00000e1`` or a name, and so does this.
    """
    protocol, _, address = locator.partition("/")
    if protocol != "udp":  # multicast is spoken over nothing else
        return False
    host = re.split(r"[?#]", address, maxsplit=1)[0].rpartition(":")[0].strip("[]")
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError):  # no address: Zenoh cannot listen there either
        return False
    return any(ipaddress.ip_address(where[0]).is_multicast for *_, where in found)


def leg_token(leg: str) -> str:
    """Return the key of a leg's liveliness token."""
    return f"robot/leg/{leg}"


# What stands between a client and its router.
Reach = Literal["connected", "unreachable", "refusing", "unknown"]


class Finding(NamedTuple):
    """Holds what a probe found, and one line for the operator.

    ``certain`` where trying to join would be in vain: every host has said that it has no listener.
    """

    reach: Reach
    line: str
    certain: bool = False


class NoRouterError(LinkError):
    """Reports that no router could be joined; ``finding`` has the likely reason."""

    def __init__(self, finding: Finding, prefix: str = "") -> None:
        super().__init__(prefix + finding.line)
        self.finding = finding


_NOBODY = "nobody listens on {}"
REMEDY = "start `adaptive-contact serve` there, or give the router's address with --connect"


def probe(endpoints: Sequence[str], *, timeout_s: float = 0.4) -> Finding:
    """Probe routers that could not be joined, without Zenoh.

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
                "refusing",
                f"refused: {text} accepts connections but opens no Zenoh session; it wants a user "
                "and password or TLS (--zenoh-config FILE), or has no room for another session, or "
                "it is not a Zenoh router",
            )
        lines.append(f"unreachable: {why.format(text)}; {REMEDY}")
        certain = certain and why is _NOBODY
    if not lines:
        return Finding("unknown", "no endpoint to connect to; give one with --connect")
    if unknown:
        return Finding("unknown", lines[0])
    return Finding("unreachable", lines[0], certain)


def _tcp(address: tuple[str, int], timeout_s: float) -> str | None:
    """Return why a port refuses a connection, with ``{}`` for its name; None if it accepts."""
    try:
        socket.create_connection(address, timeout=timeout_s).close()
    except (socket.gaierror, UnicodeError):  # unknown, or none that could be a name
        return f"the host name '{address[0]}' of {{}} is not known"
    except TimeoutError:
        return "no answer from {} (host off, or a firewall)"
    except ConnectionRefusedError:
        return _NOBODY
    except OSError as error:
        return f"{{}} cannot be reached ({reason_of(error)})"
    return None
