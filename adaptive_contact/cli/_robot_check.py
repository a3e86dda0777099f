"""``adaptive-contact robot check``: every joint as it is now, by its bus or by its samples."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._bus import (
    DeviceOption,
    described_in,
    needs_sdk,
    plans_of,
    robot_of,
    shake_hands,
)
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import say, say_note
from adaptive_contact.errors import ConfigurationError

if TYPE_CHECKING:
    from rich.table import Table

    from adaptive_contact.bridge.plan import PortPlan
    from adaptive_contact.robot import Robot
    from adaptive_contact.wire import ServoSample

_PIPE_WIDTH: Final = 110
# How long to look at a bus, and at a source that walks.
_BUS_S: Final = 1.0
_LIVE_S: Final = 20.0
# The live table looks back so far.
_LIVE_TICKS: Final = 500


@opt.flatten
def check(
    *,
    config: opt.ConfigOption = None,
    device: DeviceOption = None,
    live: Annotated[
        bool, option("--live", "Judge the samples of any source on the wire; no bus is opened.")
    ] = False,
    picture: Annotated[
        Path | None, option("--picture", "Draw the legs as they stand now.", "FILE.svg")
    ] = None,
    seconds: Annotated[
        float | None,
        seconds_option(
            "--seconds", "How long to look: 1 unless given, 20 with --live.", least=0.2, most=600.0
        ),
    ] = None,
    network: opt.Network,
    json: Annotated[bool, option("--json", "With --live: print JSON.")] = False,
) -> None:
    """Show every joint live: angle, sign, offset, limits.  Moves nothing.

    Move joints by hand meanwhile (--seconds gives time for it, Ctrl-C ends it): the angle of a
    pitch joint grows as the leg is raised, that of a yaw joint as it is turned to the left.  With
    --live, each move is said with its joint and its way, and a robot that walks is judged by its
    motion; exit code 1 where something is wrong, 2 without a router.
    """
    stop = opt.stoppable()
    if picture is not None:
        opt.check_output(picture, "--picture")
    if live:
        if device:
            raise ConfigurationError("--live listens to the wire, --device opens a bus; give one")
        from adaptive_contact.cli._robot_live import check_live

        raise typer.Exit(
            check_live(
                robot_of(config),
                network.client(wait=False),
                _LIVE_S if seconds is None else seconds,
                stop=stop,
                picture=picture,
                json=json,
            )
        )
    if json or network.given:
        raise ConfigurationError(
            "--connect, --namespace, --zenoh-config and --json go with --live; without it, the bus "
            "is asked"
        )
    robot = robot_of(config)
    if not (robot.ports or device):
        if picture is None:
            raise ConfigurationError(
                f"{described_in(config)}: robot '{robot.name}' has no port; add [port.main] with "
                "its device, give --device /dev/ttyUSB0, or give --live to look at the samples of "
                "its source"
            )
        _draw_described(robot, picture)
        return
    _check_bus(config, device, picture, _BUS_S if seconds is None else seconds, stop)


def _draw_described(robot: Robot, picture: Path) -> None:
    """Draw a robot on no bus, of whose joints nobody tells where they are."""
    from adaptive_contact.cli._robot_picture import write_picture

    write_picture(robot, {leg.id: [0.0] * len(leg.joints) for leg in robot.legs}, picture)
    say(
        f"drawn with all joints at 0, as robot '{robot.name}' has no port; with --live it stands "
        "as its samples say",
        err=True,
    )


def _check_bus(
    config: Path | None,
    device: list[str] | None,
    picture: Path | None,
    seconds: float,
    stop: threading.Event,
) -> None:
    with needs_sdk():
        from adaptive_contact.bridge.compare import compare, read_servos
        from adaptive_contact.bridge.training import collect

    from rich.live import Live

    from adaptive_contact.cli._console import table_console

    robot = robot_of(config)
    plans = plans_of(robot, config, device)
    shake_hands(plans)
    for line in compare(read_servos(plans)):
        say_note(line)
    console = table_console(pipe_width=_PIPE_WIDTH)
    with Live(console=console, refresh_per_second=10, transient=True) as table:

        def look(so_far: dict[str, list[ServoSample]]) -> None:
            if console.is_terminal:
                recent = {leg: rows[-_LIVE_TICKS:] for leg, rows in so_far.items()}
                table.update(_joints(plans, recent))

        samples = collect(plans, seconds, stop=stop, say=say_note, look=look)
    silent = [leg.id for leg in robot.legs if not samples.get(leg.id)]
    if silent:
        raise ConfigurationError(
            f"leg {', '.join(silent)}: not all of its servos answered; see the lines above"
        )
    console.print(_joints(plans, samples))
    if picture is not None:
        from adaptive_contact.cli._robot_picture import write_picture

        write_picture(robot, {leg: rows[-1].measured for leg, rows in samples.items()}, picture)
    blank = [leg.id for leg in robot.legs if leg.chain is None]
    if blank:
        say(f"lengths_m (or origins_m) are still missing for leg {', '.join(blank)}", err=True)


def _joints(plans: Sequence[PortPlan], samples: Mapping[str, list[ServoSample]]) -> Table:
    """Every joint as it is now, and how far it was moved."""
    import numpy as np
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("leg", "joint", "id", "angle", "moved", "goal", "sign", "offset", "limits"):
        table.add_column(column, justify="left" if column in ("leg", "joint") else "right")
    for plan in plans:
        for leg in plan.legs:
            rows = samples.get(leg.id)
            if not rows:
                continue
            measured = np.degrees(np.array([row.measured for row in rows]))
            for j, joint in enumerate(leg.joints):
                limits = f"{np.degrees(joint.lower_rad):.0f}..{np.degrees(joint.upper_rad):.0f}"
                outside = not joint.lower_rad <= rows[-1].measured[j] <= joint.upper_rad
                table.add_row(
                    leg.id,
                    joint.name,
                    str(joint.servo),
                    f"{measured[-1, j]:.1f}°",
                    f"{np.ptp(measured[:, j]):.1f}°",
                    f"{np.degrees(rows[-1].desired[j]):.1f}°",
                    f"{joint.direction:+d}",
                    f"{np.degrees(joint.offset_rad):.1f}°",
                    f"{limits}°" + (" !" if outside else ""),
                )
    return table
