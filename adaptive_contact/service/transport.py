"""Makes the Zenoh configuration of a link, and filters what Zenoh logs.

A configuration file comes first; ``DEFAULTS`` hold where it says nothing; our own settings
(mode, endpoints, namespace) always hold.  Zenoh reads such a file itself but fills in its own
defaults, which hide what the file itself says; so its keys are read here too.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import re
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import zenoh

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import read_file
from adaptive_contact.service.settings import (
    DEFAULT_ENDPOINT,
    LinkSettings,
    is_loopback,
    is_multicast,
    shown,
    tcp_address,
)

# Larger messages are dropped before they are assembled, and the link stays up (measured).  Valid
# payloads have at most 256 kB.  Zenoh's own limit is 1 GiB, per sender.
MAX_MESSAGE_BYTES: Final = 4 * 1024 * 1024

# Each session holds a descriptor, of which a process may have 1,024 unless that was raised, and a
# thread's time for whatever is sent to it.  A robot needs some ten; Zenoh's own limit is 1,000.
MAX_SESSIONS: Final = 256

_MAX_SESSIONS: Final = "transport/unicast/max_sessions"

DEFAULTS: Final[Mapping[str, object]] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    # A router otherwise waits half a second for scouting replies that cannot come.
    "scouting/delay": 0,
    # The advanced publisher's cache orders samples by time, or does not answer at all.
    "timestamping/enabled": True,
    "transport/shared_memory/enabled": False,
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    _MAX_SESSIONS: MAX_SESSIONS,
    # A subscriber that hangs blocks a contact event this long (us), then its link is dropped, one
    # link after the other.  The service drops them all within half a second (service/sockets.py);
    # this applies where that cannot work.  Short waits cut healthy links on a busy machine: 5 ms
    # cut 32 to 97 in 20 s at a load of 10 (decision 33).
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000,
    # An express message fills a batch of its own: 16 events find room before a put has to wait.
    "transport/link/tx/queue/size/interactive_high": 16,
    # Sixteen batches of 64 kB are room enough for a busy machine's pauses.
    "transport/link/tx/queue/size/data": 16,
    # Bounds one attempt to open a session, and so the delay of a Ctrl-C: Zenoh's call cannot be
    # interrupted.
    "connect/timeout_ms": 1000,
    # A link that was cut (no word from the other side) is given up after this long (ms), and
    # tried again; Zenoh's own 10 s would leave legs silent for ten seconds after a cut of one.
    "transport/link/tx/lease": 2000,
    # Bounds each such try: a SYN that is lost in the cut is repeated only after 1, 3 and 7 s.
    "transport/unicast/open_timeout": 1000,
    # Reconnects go on for ever at this pace; an outage of 4 s was over 0.34 s after its end.
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
}


class Facts(NamedTuple):
    """Holds what a configuration resulted in."""

    # listen, connect: endpoints
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    max_sessions: int  # that it takes at once


def configure(settings: LinkSettings) -> tuple[zenoh.Config, Facts]:
    """Make Zenoh's configuration.

    Raises:
        ConfigurationError: the file cannot be used, a port cannot be had, or the doors would be
            open to strangers.
    """
    path = settings.zenoh_config
    config = zenoh.Config() if path is None else _from_file(path)
    users = _users(config, path)
    said = frozenset() if path is None else _said(path, config)
    for key, value in DEFAULTS.items():
        if key not in said:
            _insert(config, key, value)
    listen = settings.listen
    if settings.mode == "router" and not listen and "listen/endpoints" not in said:
        # Zenoh's own default listens on every interface; ours does not.
        listen = (DEFAULT_ENDPOINT,)
    ours = tuple(_with_free_port(text) for text in listen)
    for key, value in _overrides(settings, ours).items():
        _insert(config, key, value)
    if settings.mode == "client" and not _endpoints(config, "connect", "client"):
        _insert(config, "connect/endpoints", [DEFAULT_ENDPOINT])
    facts = Facts(
        _endpoints(config, "listen", "router") if settings.mode == "router" else (),
        _endpoints(config, "connect", settings.mode),
        int(json.loads(config.get_json(_MAX_SESSIONS))),
    )
    for text in facts.listen:
        if not (is_loopback(text) or settings.insecure):
            _check_door(config, text, users)
    return config, facts


def router_failure(facts: Facts, error: zenoh.ZError) -> str:
    """Explain in one line why a router could not be opened, and by which option to correct it."""
    where = ", ".join(map(shown, facts.listen))
    if "Address already in use" in str(error):
        return (
            f"cannot listen on {where}: the address is in use, probably by another router; "
            "join it with --connect, or give a free one with --listen"
        )
    if facts.connect:
        joins = ", ".join(map(shown, facts.connect))
        where = f"{where}, or join {joins} (--connect)"
    return f"cannot listen on {where}: {first_line(error)}"


def first_line(error: zenoh.ZError) -> str:
    """Return Zenoh's message without source paths, and without what it quotes of a file."""
    # An endpoint's options may hold a key.
    text = re.sub(r"\b([a-z][a-z0-9_-]*/[^\s?#'\"<]+)[?#][^\"\n]*", r"\1…", str(error))
    # Zenoh quotes the line it cannot read, or the value it does not want: either may be a password.
    text = re.sub(
        r"(?m)^\s*\d*\s*\|.*$",
        "",
        re.sub(
            r"(?s)(invalid (?:type|value): \w+|unknown variant) (?:\\?\".*?\\?\"|`[^`]*`)",
            r"\1",
            text,
        ),
    )
    # It quotes the whole configuration where two of its values do not go together.
    text = re.sub(r"(?s)(Invalid configuration): \{.*", r"\1", text)
    return re.sub(r" at /\S+\.rs:\d+\.?", "", " ".join(text.split()))[:300]


def _insert(config: zenoh.Config, key: str, value: object) -> None:
    try:
        config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise ConfigurationError(f"Zenoh takes no such {key}: {first_line(error)}") from error


def _from_file(path: Path) -> zenoh.Config:
    advice = "give a Zenoh configuration with --zenoh-config (docs/security.md has some)"
    marks = [(mark in b"[{") - (mark in b"]}") for mark in read_file(path, advice)]
    if max(itertools.accumulate(marks), default=0) > 64:
        # Zenoh's parser would end the process.
        raise ConfigurationError(f"{path}: nested more than 64 deep; {advice}")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise ConfigurationError(
            f"{path}: not a usable Zenoh configuration: {first_line(error)}; correct it "
            "(docs/security.md has some that are)"
        ) from error


def _endpoints(config: zenoh.Config, side: str, mode: str) -> tuple[str, ...]:
    """Return the endpoints of one side; the configuration holds a list, or one per mode."""
    value = json.loads(config.get_json(f"{side}/endpoints"))
    if isinstance(value, dict):
        value = value.get(mode, [])
    flat = [item for part in value for item in (part if isinstance(part, list) else [part])]
    return tuple(str(text) for text in flat)


def _said(path: Path, config: zenoh.Config) -> frozenset[str]:
    """Return the settings that a file holds.

    Zenoh fills in its own defaults, so the file is read for its keys.  Of one in YAML, which Zenoh
    takes too, only what differs from those defaults is known.
    """
    try:
        found = keys_of(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):  # gone since Zenoh has read it
        found = frozenset()
    if found:
        return found
    blank = zenoh.Config()
    keys = (*DEFAULTS, "listen/endpoints")
    return frozenset(key for key in keys if config.get_json(key) != blank.get_json(key))


def _check_door(config: zenoh.Config, text: str, users: bool) -> None:
    """Refuse an endpoint whose clients need not show who they are.

    A user and password are asked for on any of them but multicast, which asks for
    nothing; mutual TLS only where TLS is used.  (Zenoh takes a list of known public keys, too, but
    lets all clients in all the same.)
    """
    if "enable_mtls=" in text.partition("#")[2]:
        raise ConfigurationError(
            f"{shown(text)} says enable_mtls after '#', which would hold over the configuration "
            "file; say it in the file"
        )
    if is_multicast(text):
        raise ConfigurationError(
            f"listening on {shown(text)} is multicast, where Zenoh asks nobody for a password or a "
            "certificate; give an address of this machine, or say --insecure"
        )
    if users:
        return
    mutual = json.loads(config.get_json("transport/link/tls/enable_mtls"))
    if mutual and text.startswith(("tls/", "quic/")):
        return
    raise ConfigurationError(
        f"listening on {shown(text)} would let anybody on that network in; give a "
        "--zenoh-config FILE with users or mutual TLS, or say --insecure"
    )


def _users(config: zenoh.Config, path: Path | None) -> bool:
    """Return whether Zenoh will ask for a user and password.

    With neither a user of its own nor one in the dictionary, it does not ask.

    Raises:
        ConfigurationError: the dictionary cannot be read; Zenoh would only say so in words of its
            own, and to a client as if there were no router.
    """
    usrpwd = json.loads(config.get_json("transport/auth/usrpwd"))
    if not usrpwd["dictionary_file"]:
        return False
    try:
        lines = Path(usrpwd["dictionary_file"]).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"the file of users that the Zenoh configuration names cannot be read: "
            f"{(error.strerror or '').lower() if isinstance(error, OSError) else 'no UTF-8'}; "
            f"correct dictionary_file in {path}, or make that file"
        ) from error
    if usrpwd["user"] and usrpwd["password"]:
        return True
    return any(all(part.strip() for part in line.split(":", 1)) and ":" in line for line in lines)


def _overrides(settings: LinkSettings, listen: tuple[str, ...]) -> dict[str, object]:
    """Return our settings as overrides; ``listen`` are their endpoints, free ports filled in."""
    table: dict[str, object] = {"mode": settings.mode}
    if settings.mode == "client":
        table["listen/endpoints"] = []  # whatever the file says: a client is no door
    elif listen:
        table["listen/endpoints"] = list(listen)
    if settings.connect:
        table["connect/endpoints"] = list(settings.connect)
    if settings.max_sessions is not None:
        table[_MAX_SESSIONS] = settings.max_sessions
    if settings.namespace is not None:
        table["namespace"] = settings.namespace
    # A router runs without the routers it joins; a client that is not let in must be informed.
    table["connect/exit_on_failure"] = settings.mode == "client"
    return table


def _with_free_port(text: str) -> str:
    """Replace port 0 of an endpoint by a port that is free now.

    Zenoh takes 0 but does not report which port it got once a namespace is set (its admin space is
    hidden then), so the port is chosen here.  Between the two another process may take it; the
    listener then fails and says so.

    Raises:
        ConfigurationError: port 0 with a host or protocol that cannot be bound here.
    """
    address = tcp_address(text)
    if address is None or address[1] != 0:
        return text
    host = address[0]
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as bound:
            bound.bind((host, 0))
            port: int = bound.getsockname()[1]
    except (OSError, UnicodeError) as error:  # a name that none can be, with two dots in a row
        why = getattr(error, "strerror", None) or str(error)
        raise ConfigurationError(
            f"cannot listen on {text}: {why.lower()}; "
            "give an address of this machine, such as tcp/127.0.0.1:0"
        ) from error
    head, _, tail = text.rpartition(":0")
    return f"{head}:{port}{tail}"


def keys_of(text: str) -> frozenset[str]:
    """Return the keys that a text in JSON5 sets, each as a path: ``transport/link/tx/lease``."""
    held = zenoh.Config()
    try:  # any map may stand there, so that Zenoh's own parser reads it
        held.insert_json5("metadata", text)
    except zenoh.ZError:
        return frozenset()
    return frozenset(_paths(json.loads(held.get_json("metadata"))))


def _paths(tree: object, before: str = "") -> Iterator[str]:
    for key, value in tree.items() if isinstance(tree, dict) else ():
        yield before + key
        yield from _paths(value, f"{before}{key}/")


class _CallbackFaults(logging.Handler):
    """Counts exceptions in callbacks; Zenoh logs them and goes on."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1


def callback_faults() -> int:
    """Count exceptions in callbacks of any session, since this process began."""
    return _faults.count


_faults = _CallbackFaults()
logging.getLogger("zenoh.handlers").addHandler(_faults)
if "RUST_LOG" in os.environ:
    # At debug the one part of Zenoh writes the whole configuration, passwords and all; the other
    # writes whole endpoints, in which a key may stand, with every connection that fails.
    os.environ["RUST_LOG"] += ",zenoh::api::session=info,zenoh::net::runtime::orchestrator=off"
    zenoh.try_init_log_from_env()
