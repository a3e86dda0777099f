"""Options of ``adaptive-contact sim``, and what its commands share."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import typer

from adaptive_contact.cli._options import seconds_option
from adaptive_contact.cli._output import say, say_waiting
from adaptive_contact.errors import ConfigurationError, LinkError, MissingExtraError

if TYPE_CHECKING:
    from adaptive_contact_sim import (
        PoseSettings,
        RunPlan,
        Scenario,
        SimulationSettings,
        WalkSettings,
    )

__all__ = [
    "BogusOption",
    "DriftOption",
    "DroppedOption",
    "OfflineOption",
    "PreviewOption",
    "ReactOption",
    "RecordOption",
    "RenderOption",
    "RepeatedOption",
    "RobotSeedOption",
    "ScenarioOption",
    "SecondsOption",
    "SeedOption",
    "SpeedOption",
    "ViewOption",
    "base_of",
    "execute",
    "given",
    "needs_simulator",
    "robot_of",
    "speed_of",
    "stoppable",
]

M = TypeVar("M", "PoseSettings", "WalkSettings")

_MAX_SPEED: Final = 1000.0
_RUN: Final = "Run"
_OUT: Final = "Output"
_ROBOT: Final = "Robot"

ScenarioOption = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        metavar="NAME|FILE.toml",
        help="Start from a shipped scenario (`sim list`) or a file; options change it.",
        rich_help_panel=_RUN,
    ),
]
SecondsOption = Annotated[
    float | None,
    seconds_option(
        "--seconds", help="Simulated time; otherwise until Ctrl-C.", rich_help_panel=_RUN
    ),
]
SpeedOption = Annotated[
    str | None,
    typer.Option(
        "--speed",
        metavar="X|max",
        help="Times real time, or as fast as possible. [1, max with --offline]",
        rich_help_panel=_RUN,
    ),
]
SeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, help="Of the run. [0]", rich_help_panel=_RUN)
]
RobotSeedOption = Annotated[
    int | None,
    typer.Option(
        "--robot-seed", min=0, help="Which robot of its kind. [0]", rich_help_panel=_ROBOT
    ),
]
DriftOption = Annotated[
    list[str] | None,
    typer.Option(
        "--drift",
        metavar="SPEC",
        help="Such as friction:leg=rf,joint=femur,value=4,shape=ramp,duration=60@20s; repeatable.",
        rich_help_panel=_ROBOT,
    ),
]
DroppedOption = Annotated[
    float | None,
    typer.Option("--dropped", help="Probability of a reading not to come.", rich_help_panel=_ROBOT),
]
RepeatedOption = Annotated[
    float | None,
    typer.Option("--repeated", help="Probability of a stale reading.", rich_help_panel=_ROBOT),
]
BogusOption = Annotated[
    float | None,
    typer.Option("--bogus", help="Probability of a reading of -pi.", rich_help_panel=_ROBOT),
]
PreviewOption = Annotated[
    int | None,
    typer.Option("--preview", help="Goals told ahead in samples, ticks.", rich_help_panel=_ROBOT),
]
ReactOption = Annotated[
    float | None,
    typer.Option(
        "--react-ms",
        help="From a touch to the leg's stop. [walk 60, pose never]",
        rich_help_panel=_ROBOT,
    ),
]
OfflineOption = Annotated[bool, typer.Option("--offline", help="No network.", rich_help_panel=_OUT)]
RecordOption = Annotated[
    Path | None,
    typer.Option("--record", metavar="FILE.mcap", help="Write a recording.", rich_help_panel=_OUT),
]
RenderOption = Annotated[
    Path | None,
    typer.Option(
        "--render",
        metavar="FILE",
        help="Write a film (.gif, .mp4) or the last picture (.png); needs no display.",
        rich_help_panel=_OUT,
    ),
]
ViewOption = Annotated[bool, typer.Option("--view", help="Open a window.", rich_help_panel=_OUT)]


@contextlib.contextmanager
def needs_simulator() -> Iterator[None]:
    """Around imports of the simulator: a missing mujoco is told in one line."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "mujoco":
            raise
        raise MissingExtraError("the simulator", "sim") from error


def given(**options: Any) -> dict[str, Any]:
    """The options that were given."""
    return {name: value for name, value in options.items() if value is not None}


def stoppable() -> threading.Event:
    """An event that SIGINT and SIGTERM set; a second signal ends the process at once."""
    stop = threading.Event()

    def on_signal(*_: object) -> None:
        if stop.is_set():
            os._exit(1)
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    return stop


def base_of(name: str | None, kind: type[M]) -> tuple[Scenario, M]:
    """The scenario to start from, and its motion; without a name, the defaults of that motion.

    Raises:
        ConfigurationError: the scenario cannot be used, or is of another motion.
    """
    from adaptive_contact_sim import PoseSettings, load_scenario, parse_scenario

    mode = "pose" if kind is PoseSettings else "walk"
    scenario = (
        parse_scenario(f'mode = "{mode}"', name="default") if name is None else load_scenario(name)
    )
    motion = scenario.settings.motion
    if not isinstance(motion, kind):
        found = "pose" if isinstance(motion, PoseSettings) else "walk"
        raise ConfigurationError(
            f"scenario '{scenario.name}' is for `sim {found}`, not `sim {mode}`; use that command"
        )
    return scenario, motion


def robot_of(
    settings: SimulationSettings,
    seed: int | None,
    robot_seed: int | None,
    drift: list[str] | None,
    dropped: float | None,
    repeated: float | None,
    bogus: float | None,
    preview: int | None,
) -> SimulationSettings:
    """Settings with the options given that both modes have.

    Raises:
        ConfigurationError: an option is out of range, or a drift cannot be read.
    """
    from adaptive_contact_sim import parse_drift

    return dataclasses.replace(
        settings,
        encoder=dataclasses.replace(
            settings.encoder, **given(dropped=dropped, repeated=repeated, bogus=bogus)
        ),
        drift=settings.drift + tuple(parse_drift(text) for text in drift or ()),
        **given(seed=seed, robot_seed=robot_seed, preview_ticks=preview),
    )


def speed_of(text: str | None, *, offline: bool) -> float | None:
    """Times real time, None for as fast as possible.

    Raises:
        ConfigurationError: neither a factor nor ``max``.
    """
    if text == "max" or (text is None and offline):
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


def execute(plan: RunPlan, stop: threading.Event) -> None:
    """Run a plan, and say how it went."""
    from adaptive_contact_sim import run

    try:
        report = run(plan, stop, on_wait=say_waiting, on_start=_start)
    except LinkError:
        if stop.is_set():
            return
        raise
    outcome = report.outcome
    factor = outcome.simulated_s / max(outcome.elapsed_s, 1e-9)
    touches = "  ".join(f"{leg} {count}" for leg, count in report.touches.items())
    late = f", {outcome.late} late" if plan.speed is not None else ""
    say(
        f"simulated {outcome.simulated_s:.1f} s in {outcome.elapsed_s:.1f} s "
        f"({factor:.1f} x real time), {outcome.ticks} ticks{late}; touches: {touches}"
    )
    for path in (plan.record, plan.render):
        if path is not None:
            say(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
    if report.note is not None:
        say(f"adaptive-contact: {report.note}", err=True)
    sys.stdout.flush()


def _start(line: str) -> None:
    say(f"adaptive-contact sim: {line}; stop with Ctrl-C")
    sys.stdout.flush()
