"""Defines options that several commands share."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import os
import signal
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from adaptive_contact.cli._output import print_note
from adaptive_contact.cli._signals import on_signals
from adaptive_contact.core.learn.mode import WhenAmbiguous
from adaptive_contact.durations import DURATIONS, seconds_of
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import holds_content, why_not_writable
from adaptive_contact.robot import Robot, load_robot, shipped_robot
from adaptive_contact.robot.load import is_shipped, recorded_as
from adaptive_contact.service.settings import (
    DEFAULT_ENDPOINT,
    LinkSettings,
    client_settings,
    shown_path,
)

if TYPE_CHECKING:
    from adaptive_contact.model import Baseline
    from adaptive_contact.service.recording import Recording


def flatten(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of its groups, in the places of these.

    A group is a parameter whose type is a dataclass, and whose fields are options: each becomes an
    option of the command, which is called with the dataclass made of them.

    Args:
        command: as typer takes it, but for its groups.
    """
    groups: dict[str, type] = {}
    options: list[inspect.Parameter] = []
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        kind = parameter.annotation
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            groups[parameter.name] = kind
            options += inspect.signature(kind, eval_str=True).parameters.values()
        else:
            options.append(parameter)

    @functools.wraps(command)
    def run(**given: Any) -> None:
        made = {
            name: kind(**{field.name: given.pop(field.name) for field in dataclasses.fields(kind)})
            for name, kind in groups.items()
        }
        command(**given, **made)

    named = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    # Typer reads it from there; mypy knows no attributes of functions.
    run.__signature__ = inspect.Signature(named)  # type: ignore[attr-defined]
    return run


def option(
    name: str, text: str = "", metavar: str | None = None, *, short: str = "", **settings: Any
) -> Any:
    """Declare an option of a command.

    Args:
        name: with its dashes.
        text: its help, which says what a default of None stands for.
        metavar: of its value.
        short: its other name, such as ``-o``.
        settings: further ones of :func:`typer.Option`; ``panel`` is that of the help.
    """
    names = (name, short) if short else (name,)
    panel = settings.pop("panel", None)
    # Square brackets are no markup here: a default, such as [hexapod], stands in them.
    shown = text.replace("[", "\\[") or None
    return typer.Option(*names, help=shown, metavar=metavar, rich_help_panel=panel, **settings)


def seconds_option(
    name: str, text: str, *, least: float = 0.0, most: float = math.inf, **settings: Any
) -> Any:
    """Declare an option that is a duration; its value is a float.

    Args:
        name: with its dashes.
        text: its help.
        least: s.
        most: s; what lies outside is refused in one line.
        settings: further ones of :func:`option`.
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
        text = f"{text.rstrip('.')}, {least:g} to {most:g} s."
    return option(name, text, "DURATION", parser=parse, **settings)


NETWORK: Final = "Network"
_MAX_SPEED: Final = 1000.0


@dataclasses.dataclass(frozen=True)
class Network:
    """Holds the options of every command that joins a router; see :func:`flatten`."""

    connect: Annotated[
        list[str] | None,
        option(
            "--connect",
            f"Router to join, such as {DEFAULT_ENDPOINT} (the default is that one); repeatable.",
            "ENDPOINT",
            panel=NETWORK,
        ),
    ] = None
    namespace: Annotated[
        str | None,
        option(
            "--namespace",
            "Prefix of all keys, one per robot on a shared network, such as hexapod1.",
            "NAME",
            panel=NETWORK,
        ),
    ] = None
    zenoh_config: Annotated[
        Path | None,
        option(
            "--zenoh-config",
            "Zenoh configuration file (JSON5) for TLS, users and access control.",
            "FILE",
            panel=NETWORK,
        ),
    ] = None

    @property
    def given(self) -> dict[str, object]:
        """Return the options that were given, by name."""
        options = {
            "--connect": self.connect,
            "--namespace": self.namespace,
            "--zenoh-config": self.zenoh_config,
        }
        return {name: value for name, value in options.items() if value}

    def client(self, *, json: bool = False, wait: bool = True) -> LinkSettings:
        """Return the settings of a command that joins a router.

        Raises:
            ConfigurationError: an endpoint or the namespace cannot be used.
        """
        return client_settings(
            self.connect or (),
            namespace=self.namespace,
            json=json,
            wait=wait,
            zenoh_config=self.zenoh_config,
        )


JsonPayloadOption = Annotated[bool, option("--json", "Publish JSON payloads instead of msgpack.")]
JsonOption = Annotated[bool, option("--json", "Print JSON instead of a table.")]
EquationsOption = Annotated[bool, option("--equations", "Print every leg's equations, too.")]
ForceOption = Annotated[bool, option("--force", "Replace files that are there already.")]
AnywayOption = Annotated[
    bool, option("--anyway", "Continue even if samples seem useless, or of another robot.")
]
SeedOption = Annotated[int, option("--seed", "Seed of random numbers.", min=0)]
ProcessesOption = Annotated[int, option("--processes", "Runs worked on at a time.", min=1, max=64)]
BaselineOutOption = Annotated[
    Path, option("--out", "Where the baseline goes (JSON).", "FILE", short="-o")
]
ConfigOption = Annotated[
    Path | None,
    option(
        "--config",
        "Description of the robot, or a shipped one's name; without it, the hexapod.",
        "ROBOT.TOML",
    ),
]
BaselineOption = Annotated[
    Path | None,
    option("--baseline", "Model file to start from, made by `fit` or `robot learn`.", "FILE"),
]
StateOption = Annotated[
    Path | None,
    option(
        "--state",
        "Where learned state is kept; by default $XDG_STATE_HOME/adaptive-contact, or "
        "~/.local/state/adaptive-contact.",
        "DIR",
    ),
]
AmbiguousOption = Annotated[
    WhenAmbiguous,
    option(
        "--when-ambiguous",
        "Withhold contacts of an ambiguous leg where it cannot be judged; withhold all of "
        "them; or publish them.",
    ),
]
RealtimeOption = Annotated[
    bool, option("--realtime", "Run before all ordinary processes (needs a permission).")
]


def stoppable() -> threading.Event:
    """Provide an event that signals to end set; a second one ends the process at once.

    But for SIGHUP, which a terminal that is closed often sends twice.
    """
    stop = threading.Event()

    def on_signal(number: int, _: object) -> None:
        if stop.is_set() and number != signal.SIGHUP:
            os._exit(1)
        stop.set()

    on_signals(on_signal)
    return stop


def speed_of(text: str | None) -> float | None:
    """Return times real time, 1 unless given; None for as fast as possible.

    Raises:
        ConfigurationError: neither a factor nor ``max``.
    """
    if text == "max":
        return None
    try:
        factor = 1.0 if text is None else float(text.removesuffix("x"))
    except ValueError:
        factor = 0.0
    if not 0.0 < factor <= _MAX_SPEED:  # false for NaN, too
        raise ConfigurationError(
            f"--speed {text}: expected a factor above 0, up to {_MAX_SPEED:.0f}, or max"
        )
    return factor


def floats(text: str) -> tuple[float, ...]:
    """Return the numbers between commas; none where one is no finite number."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return values if all(map(math.isfinite, values)) else ()


def check_output(
    path: Path | None, option: str, inputs: Sequence[Path | None] = (), *, force: bool
) -> None:
    """Make sure that a file can be written later, before any work is done for it.

    Args:
        path: of the file; None is not written.
        option: that names it.
        inputs: what the command reads, and its other outputs; None where one is not given.
        force: replace what is there.

    Raises:
        ConfigurationError: its folder is not there or not writable, or it is a folder itself, or
            an input or another file would be lost.
    """
    if path is None:
        return
    for other in filter(None, inputs):
        if path.is_file() and other.exists() and path.samefile(other):
            raise ConfigurationError(f"{path} is what the command reads; give another {option}")
        if path == other and not path.exists():
            raise ConfigurationError(f"{path} is given twice; give another {option}")
    why = why_not_writable(path)
    if why is not None:
        raise ConfigurationError(f"{path}: cannot be written ({why}); give another {option}")
    refuse_to_replace([path], option, force=force)


def refuse_to_replace(paths: Iterable[Path], option: str, *, force: bool) -> None:
    """Refuse to write over files, unless that is wanted.

    Raises:
        ConfigurationError: one is there.
    """
    for path in paths:
        if holds_content(path) and not force:
            raise ConfigurationError(
                f"{path} exists already; give another {option}, or --force to replace it"
            )


def print_damage(recording: Recording) -> None:
    """Print what the last pass over a recording met, a line each."""
    lines = recording.notes if recording.damage is None else (recording.damage, *recording.notes)
    for line in lines:
        print_note(f"{recording.path}: {line}")


def described_robot(config: Path | None) -> Robot:
    """Load the robot of ``--config``, or the hexapod; report a robot.toml here that is unused."""
    if config is not None:
        return load_robot(config)
    robot = shipped_robot()
    unused = _unused_here()
    if unused:
        print_note(f"no --config: the robot is the shipped '{robot.name}'{unused}")
    return robot


def _unused_here() -> str:
    """Return the end of a line on a robot.toml of this folder, which is not used.

    The folder is no part of the command: after `cd`, another robot would be served.
    """
    if not Path("robot.toml").is_file():
        return ""
    return "; this folder's robot.toml is not used, --config robot.toml takes it"


def learned_of(
    robot: Robot, config: Path | None, baseline: Path | None
) -> tuple[Baseline | None, str | None]:
    """Load what was learned of a robot, by ``--baseline`` or as it ships; return its origin too."""
    from adaptive_contact.model.model_file import load_baseline, shipped_baseline

    if baseline is not None:
        return load_baseline(baseline), shown_path(baseline)
    shipped = config is None or is_shipped(config)
    learned = shipped_baseline(robot.name) if shipped else None
    return learned, None if learned is None else f"shipped with {robot.name}"


def recorded_robot(config: Path | None, recordings: Sequence[Path]) -> Robot:
    """Return the robot that recordings are taken for; reported where it is a shipped one.

    Raises:
        ConfigurationError: a recording is of another robot, by its own word.
    """
    from adaptive_contact.service.recording import is_bag, read_recording

    if config is not None:
        return load_robot(config)
    robot: Robot | None = None
    for path in recordings:
        if is_bag(path):
            read_recording(path)  # says that a bag needs a --config
        name = read_recording(path).about.get("robot")
        if name is None:
            continue
        known = recorded_as(name)
        if known is None:
            raise ConfigurationError(
                f"{path}: recorded from robot '{name}', which does not ship; give the --config of "
                f"'{name}'{_unused_here()}"
            )
        if robot is not None and known != robot:
            raise ConfigurationError(
                f"{path}: recorded from robot '{name}', and others from '{robot.name}'; give "
                "recordings of one robot"
            )
        robot = known
    robot = robot or shipped_robot()
    print_note(
        f"no --config: taken for the shipped robot '{robot.name}' "
        f"({', '.join(robot.leg_ids)}; {robot.period_s * 1e3:g} ms){_unused_here()}"
    )
    return robot
