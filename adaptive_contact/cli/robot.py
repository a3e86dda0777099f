"""``adaptive-contact robot``: a new robot, from its bus to a baseline."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from adaptive_contact.cli._bus import DeviceOption
from adaptive_contact.cli._options import Commands, ForceOption, flatten, option
from adaptive_contact.cli._robot_check import check
from adaptive_contact.cli._robot_learning import learn

app = Commands(help="A new robot: who is there, is it right, learn it.", no_args_is_help=True)


@dataclasses.dataclass(frozen=True)
class Wishes:
    """The options of ``robot init``; None where one is not given."""

    device: DeviceOption = None
    out: Annotated[Path, option("--out", "Description to write.", "FILE", short="-o")] = Path(
        "robot.toml"
    )
    joints: Annotated[
        str | None,
        option(
            "--joints",
            "Per leg, from the body outwards; 3 unless given.  A URDF has its own.",
            "NUMBER|NAME,NAME,...",
        ),
    ] = None
    ids: Annotated[
        str | None,
        option(
            "--ids",
            "Servos of each leg, from the body outwards, such as 2,4,6/8,10,12, or of several "
            "ports left:2,4,6/right:8,10,12; all others, such as a head's, are ignored.  Without "
            "it, all are taken in the order of their ids.",
            "ID,ID,.../ID,...",
        ),
    ] = None
    legs: Annotated[
        str | None,
        option(
            "--legs",
            "Names, in the order of the servos' ids, or of --ids; with --urdf ID=LINK,..., "
            "with each foot's link.",
            "ID,ID,...",
        ),
    ] = None
    lengths: Annotated[
        str | None, option("--lengths", "Of the links, where all legs are alike, m.", "M,M,...")
    ] = None
    urdf: Annotated[
        Path | None,
        option("--urdf", "Take joints, axes, origins and limits from this URDF.", "FILE"),
    ] = None
    base: Annotated[
        str | None,
        option(
            "--base",
            "The URDF's link that is the body, z up; the last one that all legs hang on "
            "unless given.",
            "LINK",
        ),
    ] = None
    tip: Annotated[
        str | None,
        option(
            "--tip",
            "The foot's tip in the frame of its link, m, where a URDF has no link there; one for "
            "all legs, or one each.",
            "X,Y,Z[/...]",
        ),
    ] = None
    name: Annotated[str | None, option("--name", "Of the robot.")] = None
    resolution: Annotated[
        float | None,
        option(
            "--resolution",
            "One step of a reading; read from the servos with --device.",
            "RAD",
            min=1e-6,
            max=0.2,
        ),
    ] = None
    rate: Annotated[
        float | None,
        option(
            "--rate", "Control ticks per second; 50 with --device.", "HZ", min=1.0, max=10_000.0
        ),
    ] = None
    baud: Annotated[int | None, option("--baud", "Otherwise the usual ones are tried.")] = None
    configure: Annotated[
        bool,
        option(
            "--configure",
            "Let servos that answer pings only answer reads (status return level 2, in the "
            "EEPROM of AX, RX, MX and XL-320).",
        ),
    ] = False
    force: ForceOption = False


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
