"""Options that several commands share, so that each is spelled and explained once."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import why_not_writable
from adaptive_contact.service.settings import DEFAULT_ENDPOINT, LinkSettings, client_settings

__all__ = [
    "AmbiguousOption",
    "BaselineOption",
    "ConfigOption",
    "ConnectOption",
    "InsecureOption",
    "JsonOption",
    "JsonPayloadOption",
    "ListenOption",
    "LogJsonOption",
    "LogLevel",
    "LogLevelOption",
    "NamespaceOption",
    "NoStateOption",
    "RealtimeOption",
    "StateOption",
    "WhenAmbiguous",
    "ZenohConfigOption",
    "check_output",
    "client",
]


class WhenAmbiguous(StrEnum):
    """What becomes of the contacts of an ambiguous leg; by value that of `adapt`."""

    WITHHOLD = "withhold"
    STRICT = "strict"
    PUBLISH = "publish"


class LogLevel(StrEnum):
    """How much a command says."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


_NETWORK = "Network"

ConnectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--connect",
        metavar="ENDPOINT",
        help=f"Router to join, such as {DEFAULT_ENDPOINT} (the default is that one); repeatable.",
        show_default=False,
        rich_help_panel=_NETWORK,
    ),
]
ListenOption = Annotated[
    list[str] | None,
    typer.Option(
        "--listen",
        metavar="ENDPOINT",
        help=f"Where the embedded router listens (default {DEFAULT_ENDPOINT}); port 0 takes a free "
        "one; repeatable.",
        show_default=False,
        rich_help_panel=_NETWORK,
    ),
]
NamespaceOption = Annotated[
    str | None,
    typer.Option(
        "--namespace",
        metavar="NAME",
        help="Prefix of all keys, one per robot on a shared network, such as hexapod1.",
        show_default=False,
        rich_help_panel=_NETWORK,
    ),
]
ZenohConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--zenoh-config",
        metavar="FILE",
        help="Zenoh configuration file (JSON5) for TLS, users and access control.",
        show_default=False,
        rich_help_panel=_NETWORK,
    ),
]
InsecureOption = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Listen beyond loopback although nobody has to authenticate.",
        rich_help_panel=_NETWORK,
    ),
]
JsonPayloadOption = Annotated[
    bool,
    typer.Option("--json", help="Publish JSON payloads instead of msgpack."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="ROBOT.TOML",
        help="Description of the robot; without it, the shipped hexapod.",
        show_default=False,
    ),
]
BaselineOption = Annotated[
    Path | None,
    typer.Option(
        "--baseline",
        metavar="FILE",
        help="Model file to start from, made by `adaptive-contact fit`.",
        show_default=False,
    ),
]
StateOption = Annotated[
    Path | None,
    typer.Option(
        "--state",
        metavar="DIR",
        help="Where learned state is kept; by default $XDG_STATE_HOME/adaptive-contact, or "
        "~/.local/state/adaptive-contact.",
        show_default=False,
    ),
]
NoStateOption = Annotated[
    bool, typer.Option("--no-state", help="Neither restore nor keep what is learned.")
]
AmbiguousOption = Annotated[
    WhenAmbiguous,
    typer.Option(
        "--when-ambiguous",
        help="Withhold contacts of an ambiguous leg where it cannot be judged; withhold all of "
        "them; or publish them.",
    ),
]
LogLevelOption = Annotated[
    LogLevel,
    typer.Option("--log-level", help="Least level that is logged.", rich_help_panel="Logging"),
]
LogJsonOption = Annotated[
    bool,
    typer.Option("--log-json", help="Log one JSON object per line.", rich_help_panel="Logging"),
]
RealtimeOption = Annotated[
    bool,
    typer.Option("--realtime", help="Run before all ordinary processes (needs the right to)."),
]


def client(
    connect: list[str] | None,
    namespace: str | None,
    zenoh_config: Path | None = None,
    *,
    json: bool = False,
    wait: bool = True,
) -> LinkSettings:
    """Settings of a command that joins a router, from its options.

    Raises:
        ConfigurationError: an endpoint or the namespace cannot be used.
    """
    return client_settings(
        connect or (), namespace=namespace, json=json, wait=wait, zenoh_config=zenoh_config
    )


def check_output(path: Path, option: str) -> None:
    """Make sure that a file can be written later, before any work is done for it.

    Raises:
        ConfigurationError: its folder is not there or not writable, or it is a folder itself.
    """
    why = why_not_writable(path)
    if why is not None:
        raise ConfigurationError(f"{path}: cannot be written ({why}); give another {option}")
