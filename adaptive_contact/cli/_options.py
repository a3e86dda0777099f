"""Options that several commands share, so that each is spelled and explained once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from adaptive_contact.cli._output import say
from adaptive_contact.durations import DURATIONS, seconds_of
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import why_not_writable
from adaptive_contact.service.settings import DEFAULT_ENDPOINT, LinkSettings, client_settings

if TYPE_CHECKING:
    from adaptive_contact.robot import Robot
    from adaptive_contact.service.recording import Recording

__all__ = [
    "AmbiguousOption",
    "BaselineOption",
    "Commands",
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
    "recorded_robot",
    "say_damage",
    "seconds_option",
]


def _without_types_of_flags(params: list[Any]) -> list[Any]:
    """Options whose help shows no ``<bool>`` behind a flag, which takes no value."""
    for param in params:
        if getattr(param, "is_flag", False):
            param.metavar = ""
    return params


class _Command(TyperCommand):
    def get_params(self, ctx: Any) -> list[Any]:
        return _without_types_of_flags(super().get_params(ctx))


class _Group(TyperGroup):
    def get_params(self, ctx: Any) -> list[Any]:
        return _without_types_of_flags(super().get_params(ctx))


class Commands(typer.Typer):
    """A group of commands whose help shows flags without a type.

    Args:
        settings: as of :class:`typer.Typer`.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(cls=_Group, **settings)

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Any], Any]:
        """Add a command, as :meth:`typer.Typer.command` does."""
        return super().command(name, cls=_Command, **settings)


def seconds_option(
    *names: str,
    help: str,  # noqa: A002 - typer's name
    least: float = 0.0,
    most: float = math.inf,
    **settings: Any,
) -> Any:
    """An option that is a duration, in seconds.

    Args:
        names: as of :func:`typer.Option`.
        help: likewise.
        least: s.
        most: s; what lies outside is refused in one line.
        settings: further ones of :func:`typer.Option`.

    Returns:
        The option; its value is a float.
    """

    def parse(given: str | float) -> float:
        seconds = seconds_of(str(given))
        if seconds is None:
            raise typer.BadParameter(f"'{given}' is no duration; expected {DURATIONS}")
        if not least <= seconds <= most:
            between = f"{least:g} s or more" if most == math.inf else f"{least:g} to {most:g} s"
            raise typer.BadParameter(f"'{given}' is {seconds:g} s; expected {between}")
        return seconds

    if most < math.inf:
        help = f"{help.rstrip('.')}, {least:g} to {most:g} s."  # noqa: A001
    return typer.Option(*names, metavar="DURATION", parser=parse, help=help, **settings)


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
MaxSessionsOption = Annotated[
    int | None,
    typer.Option(
        "--max-sessions",
        metavar="N",
        min=2,
        max=10_000,
        help="Sessions that the embedded router takes at once (default 256, or what "
        "--zenoh-config says); others are refused.",
        show_default=False,
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


def say_damage(recording: Recording) -> None:
    """Say what the last pass over a recording met, a line each."""
    lines = recording.notes if recording.damage is None else (recording.damage, *recording.notes)
    for line in lines:
        say(f"adaptive-contact: {recording.path}: {line}", err=True)


def recorded_robot(config: Path | None, recordings: Sequence[Path]) -> Robot:
    """The robot that recordings are taken for; said where it is the shipped one.

    Raises:
        ConfigurationError: a recording is of another robot, by its own word.
    """
    from adaptive_contact.robot import load_robot, shipped_robot
    from adaptive_contact.service.recording import is_bag, read_recording

    if config is not None:
        return load_robot(config)
    robot = shipped_robot()
    for path in recordings:
        if is_bag(path):
            read_recording(path)  # says that a bag needs a --config
        name = read_recording(path).about.get("robot", robot.name)
        if name != robot.name:
            raise ConfigurationError(
                f"{path}: recorded from robot '{name}', and without --config the shipped "
                f"'{robot.name}' is meant; give the --config of '{name}'"
            )
    say(
        f"adaptive-contact: no --config: taken for the shipped robot '{robot.name}' "
        f"({', '.join(robot.leg_ids)}; {robot.period_s * 1e3:g} ms)",
        err=True,
    )
    return robot
