"""``adaptive-contact robot``: a new robot, from its bus to a baseline."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact.cli._bus import DeviceOption
from adaptive_contact.cli._options import Commands, flatten
from adaptive_contact.cli._robot_check import check
from adaptive_contact.cli._robot_learning import learn

__all__ = ["Wishes", "app"]

app = Commands(help="A new robot: who is there, is it right, learn it.", no_args_is_help=True)


@dataclasses.dataclass(frozen=True)
class Wishes:
    """The options of ``robot init``; None where one is not given."""

    device: DeviceOption = None
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Description to write.")
    ] = Path("robot.toml")
    joints: Annotated[
        str | None,
        typer.Option(
            "--joints",
            metavar="NUMBER|NAME,NAME,...",
            help="Per leg, from the body outwards; 3 unless given.  A URDF has its own.",
            show_default=False,
        ),
    ] = None
    ids: Annotated[
        str | None,
        typer.Option(
            "--ids",
            metavar="ID,ID,.../ID,...",
            help="Servos of each leg, from the body outwards, such as 2,4,6/8,10,12; all others, "
            "such as a head's, are ignored.  Without it, all are taken in the order of their ids.",
            show_default=False,
        ),
    ] = None
    legs: Annotated[
        str | None,
        typer.Option(
            "--legs",
            metavar="ID,ID,...",
            help="Names, in the order of the servos' ids, or of --ids; with --urdf ID=LINK,..., "
            "with each foot's link.",
            show_default=False,
        ),
    ] = None
    lengths: Annotated[
        str | None,
        typer.Option(
            "--lengths",
            metavar="M,M,...",
            help="Of the links, where all legs are alike, m.",
            show_default=False,
        ),
    ] = None
    urdf: Annotated[
        Path | None,
        typer.Option(
            "--urdf",
            metavar="FILE",
            help="Take joints, axes, origins and limits from this URDF.",
            show_default=False,
        ),
    ] = None
    base: Annotated[
        str | None,
        typer.Option(
            "--base",
            metavar="LINK",
            help="The URDF's link that is the body, z up; the last one that all legs hang on "
            "unless given.",
            show_default=False,
        ),
    ] = None
    tip: Annotated[
        str | None,
        typer.Option(
            "--tip",
            metavar="X,Y,Z",
            help="The foot's tip in the frame of its link, m, where a URDF has no link there.",
            show_default=False,
        ),
    ] = None
    name: Annotated[
        str | None, typer.Option("--name", help="Of the robot.", show_default=False)
    ] = None
    resolution: Annotated[
        float | None,
        typer.Option(
            "--resolution",
            metavar="RAD",
            min=1e-6,
            max=0.2,
            help="One step of a reading; read from the servos with --device.",
            show_default=False,
        ),
    ] = None
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            min=1.0,
            max=10_000.0,
            help="Control ticks per second; 50 with --device.",
            show_default=False,
        ),
    ] = None
    baud: Annotated[
        int | None,
        typer.Option("--baud", help="Otherwise the usual ones are tried.", show_default=False),
    ] = None
    configure: Annotated[
        bool,
        typer.Option(
            "--configure",
            help="Let servos that answer pings only answer reads (status return level 2, in the "
            "EEPROM of AX, RX, MX and XL-320).",
        ),
    ] = False
    force: Annotated[bool, typer.Option("--force", help="Replace the file.")] = False


@app.command()
@flatten
def init(*, wishes: Wishes) -> None:
    """Write a robot.toml to fill in, from a bus, from a URDF, or from both.

    With --device the bus is asked who is there; nothing is moved, and without --configure nothing
    is set.  Without a bus, for servos of any kind, joints come from --urdf or --joints, and
    --resolution and --rate are asked for where they are not given.
    """
    from adaptive_contact.cli._robot_init import write_description

    write_description(wishes)


app.command("check")(check)
app.command("learn")(learn)
