"""Runs ``robot init``: a description from a bus, a URDF, options, or all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.cli._bus import DeviceOption, devices_of
from adaptive_contact.cli._options import ForceOption, check_output, flatten, floats, option
from adaptive_contact.cli._output import print_line, print_note
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file
from adaptive_contact.robot import Leg, Robot, parse_robot
from adaptive_contact.robot.description import MAX_JOINTS
from adaptive_contact.robot.load import recorded_as
from adaptive_contact.robot.urdf import UrdfLegs, read_urdf
from adaptive_contact.robot.write import write_robot


@dataclasses.dataclass(frozen=True)
class Wishes:
    """Holds the options of ``robot init``; None where one is not given."""

    device: DeviceOption = None
    out: Annotated[Path, option("--out", "Description to write.", "FILE", short="-o")] = Path(
        "robot.toml"
    )
    joints: Annotated[
        str | None,
        option(
            "--joints",
            "Joints per leg, from the body outwards; 3 by default.  A URDF has its own.",
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
        str | None,
        option("--lengths", "Lengths of the links, m, if all legs are alike.", "M,M,..."),
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
    name: Annotated[str | None, option("--name", "Name of the robot.")] = None
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
    baud: Annotated[
        int | None,
        option(
            "--baud",
            "Baud rate; by default the usual ones are tried.",
            "BAUD",
            min=1_200,
            max=12_000_000,
        ),
    ] = None
    configure: Annotated[
        bool,
        option(
            "--configure",
            "Let servos that answer pings only answer reads (status return level 2, in the "
            "EEPROM of AX, RX, MX and XL-320).",
        ),
    ] = False
    force: ForceOption = False


@flatten
def init(*, wishes: Wishes) -> None:
    """Write a robot.toml to fill in, from a bus, from a URDF, or from both.

    With --device the bus is asked who is there; nothing is moved, and without --configure nothing
    is set.  Without a bus, for servos of any kind, joints come from --urdf or --joints, and
    --resolution and --rate are needed.
    """
    # As seen from anywhere, but links are kept: /dev/serial/by-id names an adapter for good.
    devices = {port: str(Path(path).absolute()) for port, path in devices_of(wishes.device).items()}
    out = wishes.out
    if not devices and wishes.urdf is None and wishes.joints is None:
        raise ConfigurationError(
            "which port? give --device /dev/ttyUSB0 (or left=/dev/ttyUSB0 ...); for servos on no "
            "such bus --urdf FILE --legs lf=LINK,..., or --legs lf,rf,... --joints 3, each with "
            "--rate 50 --resolution 0.00153"
        )
    check_output(out, "--out", [wishes.urdf], force=wishes.force)
    if wishes.lengths is not None and wishes.urdf is not None:
        raise ConfigurationError("--lengths and --urdf both give the geometry; leave one out")
    if wishes.urdf is None and (wishes.base or wishes.tip):
        raise ConfigurationError("--base and --tip go with --urdf FILE; give it, or leave them out")
    feet = _feet(wishes)
    names = _joint_names(wishes.joints)
    read = None if wishes.urdf is None else _read_urdf(wishes, wishes.urdf, feet)
    if devices:
        robot = _describe_from_bus(wishes, devices, tuple(feet), names, read)
    else:
        robot = _describe_from_options(wishes, tuple(feet), names, read)
    if wishes.lengths is not None:
        measured = floats(wishes.lengths)
        alike = tuple(msgspec.structs.replace(leg, lengths_m=measured) for leg in robot.legs)
        robot = msgspec.structs.replace(robot, legs=alike)
    text = write_robot(robot)
    robot = parse_robot(text, source=str(wishes.urdf or f"{out}, as the options have it"))
    if devices:
        plan_ports(robot)  # what a bridge would refuse
    write_file(out, text, advice="give another --out")
    for note in () if read is None else read.notes:
        print_note(note)
    todo = "" if robot.legs[0].chain is not None else "fill in lengths_m, then "
    sizes = " and ".join(map(str, sorted({len(leg.joints) for leg in robot.legs})))
    live = "" if devices else "--live "
    print_line(
        f"wrote {out}: {len(robot.legs)} legs of {sizes} joints; {todo}run "
        f"`adaptive-contact robot check {live}--config {out}`"
    )


# -- options -------------------------------------------------------------------------------------


def _feet(wishes: Wishes) -> dict[str, str]:
    """Return the legs of ``--legs`` with their feet's links, which are empty without a URDF."""
    text = wishes.legs
    if text is None:
        if wishes.urdf is not None:
            last = read_urdf(wishes.urdf).last_links()
            raise ConfigurationError(
                f"which links are the feet? give --legs lf=LINK,...; last links of {wishes.urdf}: "
                f"{last}"
            )
        return {}
    parts = [[piece.strip() for piece in part.partition("=")] for part in text.split(",")]
    feet = {leg: link for leg, _, link in parts}
    linked = [link for link in feet.values() if link]
    if len(feet) < len(parts) or len(set(linked)) < len(linked):
        raise ConfigurationError(f"--legs {text}: one is there twice; legs and feet must differ")
    if wishes.urdf is not None and len(linked) < len(feet):
        raise ConfigurationError(
            f"--legs {text}: a leg has no link; with --urdf give lf=LINK,..., with each foot's link"
        )
    if wishes.urdf is None and linked:
        raise ConfigurationError(
            f"--legs {text}: links go with --urdf FILE; give it, or leave out ={linked[0]}"
        )
    return feet


def _joint_names(text: str | None) -> int | tuple[str, ...]:
    """Parse ``--joints``: a number, or names."""
    if text is None:
        return 3
    if text.strip().isdigit() and 1 <= int(text) <= MAX_JOINTS:
        return int(text)
    names = tuple(part.strip() for part in text.split(","))
    named = all(name and name.isprintable() for name in names) and len(set(names)) == len(names)
    if text.strip().lstrip("+-").isdigit() or not named or len(names) > MAX_JOINTS:
        raise ConfigurationError(
            f"--joints {text}: expected 1 to {MAX_JOINTS}, or as many different names such as "
            "hip,thigh,knee"
        )
    return names


def _read_urdf(wishes: Wishes, path: Path, feet: Mapping[str, str]) -> UrdfLegs:
    if wishes.joints is not None:
        raise ConfigurationError("--joints and --urdf both give the joints; leave --joints out")
    tips = [floats(part) for part in (wishes.tip or "").split("/") if wishes.tip]
    if not all(len(point) == 3 and max(map(abs, point)) <= 5.0 for point in tips):
        raise ConfigurationError(f"--tip {wishes.tip}: expected X,Y,Z in m, such as 0,0,-0.1")
    return read_urdf(path).legs(feet, base=wishes.base, tips_m=tips)


# -- robots --------------------------------------------------------------------------------------


def _describe_from_bus(
    wishes: Wishes,
    devices: Mapping[str, str],
    ids: Sequence[str],
    names: int | tuple[str, ...],
    read: UrdfLegs | None,
) -> Robot:
    """Describe the robot whose servos answer, with a URDF's geometry where there is one."""
    from adaptive_contact.bridge.discovery import describe, find_servos, group, wanted_legs
    from adaptive_contact.bridge.handshake import USUAL_BAUDS

    wanted = () if wishes.ids is None else wanted_legs(wishes.ids)
    joints = names if isinstance(names, int) else len(names)
    if read is not None:
        joints = len(read.legs[0].joints)
    bauds = USUAL_BAUDS if wishes.baud is None else (wishes.baud,)
    found = [
        find_servos(
            port,
            path,
            bauds,
            ids=[s for leg in wanted if leg.port in (port, None) for s in leg.ids]
            if len(devices) == 1 or all(leg.port for leg in wanted)
            else (),
            configure=wishes.configure,
        )
        for port, path in devices.items()
    ]
    for line in describe(found):
        print_line(line)
    own_names = () if isinstance(names, int) else names
    robot = group(found, joints, ids, own_names, wanted=wanted)
    robot = msgspec.structs.replace(robot, name=_name(wishes, read))
    for port, settings in robot.ports.items():
        if settings.ignore:
            print_line(
                f"port {port}: servo {', '.join(map(str, settings.ignore))} is no leg's: ignored"
            )
    if wishes.rate is not None:
        robot = msgspec.structs.replace(robot, period_s=1.0 / wishes.rate)
    if wishes.resolution is not None:
        robot = msgspec.structs.replace(robot, quantum_rad=wishes.resolution)
    if read is None:
        return robot
    legs = tuple(
        msgspec.structs.replace(leg, servos=own.servos, quantum_rad=own.quantum_rad)
        for leg, own in zip(read.legs, robot.legs, strict=True)
    )
    return msgspec.structs.replace(robot, legs=legs)


def _describe_from_options(
    wishes: Wishes, ids: Sequence[str], names: int | tuple[str, ...], read: UrdfLegs | None
) -> Robot:
    """Describe a robot on no known bus."""
    rate, step = wishes.rate, wishes.resolution
    if not ids or rate is None or step is None:
        needed = {
            "--legs lf,rf,... (their names)": ids or None,
            "--rate 50 (control ticks per second)": rate,
            "--resolution 0.00153 (a step of a reading, rad; this is 12 bits over a turn)": step,
        }
        missing = [words for words, given in needed.items() if given is None]
        raise ConfigurationError(f"give {', '.join(missing)} as well")
    if read is not None:
        legs = read.legs
    else:
        own = tuple(f"joint{k + 1}" for k in range(names)) if isinstance(names, int) else names
        made = [Leg(id=leg, joints=own) for leg in ids]
        legs = tuple(msgspec.structs.replace(leg, axes=leg.joint_axes) for leg in made)
    return Robot(name=_name(wishes, read), period_s=1.0 / rate, quantum_rad=step, legs=legs)


def _name(wishes: Wishes, read: UrdfLegs | None) -> str:
    """Of the robot; a file's own, unless recordings would pass for those of one that ships."""
    own = "" if read is None or recorded_as(read.name) else read.name
    return wishes.name or own or "my-robot"
