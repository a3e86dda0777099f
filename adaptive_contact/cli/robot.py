"""``adaptive-contact robot``: a new robot, from its bus to a baseline."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from adaptive_contact.cli._options import (
    Commands,
    ConfigOption,
    ConnectOption,
    NamespaceOption,
    RealtimeOption,
    ZenohConfigOption,
    check_output,
    client,
    seconds_option,
)
from adaptive_contact.cli._output import say
from adaptive_contact.cli._sim_options import stoppable
from adaptive_contact.cli.bridge import (
    DeviceOption,
    devices_of,
    needs_sdk,
    plans_of,
    robot_of,
)
from adaptive_contact.errors import ConfigurationError, TooLittleDataError
from adaptive_contact.files import holds_content

if TYPE_CHECKING:
    from rich.table import Table

    from adaptive_contact.bridge.plan import PortPlan
    from adaptive_contact.robot import Robot
    from adaptive_contact.wire import ServoSample

__all__ = ["app"]

app = Commands(help="A new robot: who is there, is it right, learn it.", no_args_is_help=True)

_PIPE_WIDTH: Final = 110
# How long to look at a bus, and at a source that walks.
_BUS_S: Final = 1.0
_LIVE_S: Final = 20.0
# The live table looks back so far.
_LIVE_TICKS: Final = 500


@app.command()
def init(
    device: DeviceOption = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Description to write.")
    ] = Path("robot.toml"),
    joints: Annotated[
        str | None,
        typer.Option(
            "--joints",
            metavar="NUMBER|NAME,NAME,...",
            help="Per leg, from the body outwards; 3 unless given.  A URDF has its own.",
            show_default=False,
        ),
    ] = None,
    ids: Annotated[
        str | None,
        typer.Option(
            "--ids",
            metavar="ID,ID,.../ID,...",
            help="Servos of each leg, from the body outwards, such as 2,4,6/8,10,12; all others, "
            "such as a head's, are ignored.  Without it, all are taken in the order of their ids.",
            show_default=False,
        ),
    ] = None,
    legs: Annotated[
        str | None,
        typer.Option(
            "--legs",
            metavar="ID,ID,...",
            help="Names, in the order of the servos' ids, or of --ids; with --urdf ID=LINK,..., "
            "with each foot's link.",
            show_default=False,
        ),
    ] = None,
    lengths: Annotated[
        str | None,
        typer.Option(
            "--lengths",
            metavar="M,M,...",
            help="Of the links, where all legs are alike, m.",
            show_default=False,
        ),
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option(
            "--urdf",
            metavar="FILE",
            help="Take joints, axes, origins and limits from this URDF.",
            show_default=False,
        ),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            "--base",
            metavar="LINK",
            help="The URDF's link that is the body, z up; the last one that all legs hang on "
            "unless given.",
            show_default=False,
        ),
    ] = None,
    tip: Annotated[
        str | None,
        typer.Option(
            "--tip",
            metavar="X,Y,Z",
            help="The foot's tip in the frame of its link, m, where a URDF has no link there.",
            show_default=False,
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Of the robot.", show_default=False)
    ] = None,
    resolution: Annotated[
        float | None,
        typer.Option(
            "--resolution",
            metavar="RAD",
            min=1e-6,
            max=0.2,
            help="One step of a reading; told by the servos of --device.",
            show_default=False,
        ),
    ] = None,
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
    ] = None,
    baud: Annotated[
        int | None,
        typer.Option("--baud", help="Otherwise the usual ones are tried.", show_default=False),
    ] = None,
    configure: Annotated[
        bool,
        typer.Option(
            "--configure",
            help="Let servos that answer pings only answer reads (status return level 2, in the "
            "EEPROM of AX, RX, MX and XL-320).",
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file.")] = False,
) -> None:
    """Write a robot.toml to fill in, from a bus, from a URDF, or from both.

    With --device the bus is asked who is there; nothing is moved, and without --configure nothing
    is set.  Without a bus, for servos of
    any kind, joints come from --urdf or --joints, and --resolution and --rate are asked for where
    they are not given.
    """
    from adaptive_contact.cli._robot_init import Wishes, write_description

    write_description(
        Wishes(
            devices=devices_of(device),
            out=out,
            joints=joints,
            ids=ids,
            legs=legs,
            lengths=lengths,
            urdf=urdf,
            base=base,
            tip=tip,
            name=name,
            resolution=resolution,
            rate=rate,
            baud=baud,
            configure=configure,
            force=force,
        )
    )


@app.command()
def check(
    config: ConfigOption = None,
    device: DeviceOption = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live", help="Judge the samples of any source on the wire; no bus is opened."
        ),
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            metavar="FILE.svg",
            help="Draw the legs as they stand now.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        seconds_option(
            "--seconds",
            least=0.2,
            most=600.0,
            help="How long to look: 1 unless given, 20 with --live.",
            show_default=False,
        ),
    ] = None,
    connect: ConnectOption = None,
    namespace: NamespaceOption = None,
    zenoh_config: ZenohConfigOption = None,
    json: Annotated[bool, typer.Option("--json", help="With --live: print JSON.")] = False,
) -> None:
    """Show every joint live: angle, sign, offset, limits.  Moves nothing.

    Move joints by hand meanwhile (--seconds gives time for it, Ctrl-C ends it): the angle of a
    pitch joint grows as the leg is raised, that of a yaw joint as it is turned to the left.  With
    --live, each move is said with its joint and its way, and a robot that walks is judged by its
    motion; exit code 1 where something is wrong, 2 without a router.
    """
    stop = stoppable()
    if picture is not None:
        check_output(picture, "--picture")
    if live:
        if device:
            raise ConfigurationError("--live listens to the wire, --device opens a bus; give one")
        from adaptive_contact.cli._robot_live import check_live

        raise typer.Exit(
            check_live(
                robot_of(config),
                client(connect, namespace, zenoh_config, wait=False),
                _LIVE_S if seconds is None else seconds,
                stop=stop,
                picture=picture,
                json=json,
            )
        )
    if json or connect or namespace or zenoh_config:
        raise ConfigurationError(
            "--connect, --namespace, --zenoh-config and --json go with --live; without it, the bus "
            "is asked"
        )
    robot = robot_of(config)
    if not (robot.ports or device):
        if picture is None:
            raise ConfigurationError(
                f"robot '{robot.name}' has no port; add [port.main] with its device, "
                "give --device /dev/ttyUSB0, or give --live to look at the samples of its source"
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
        from adaptive_contact.bridge.collect import collect
        from adaptive_contact.bridge.compare import compare, read_servos

    from rich.live import Live

    from adaptive_contact.cli._console import table_console

    robot, plans = _planned(config, device)
    _shake_hands(plans)
    for line in compare(read_servos(plans)):
        _say(line)
    console = table_console(pipe_width=_PIPE_WIDTH)
    with Live(console=console, refresh_per_second=10, transient=True) as table:

        def look(so_far: dict[str, list[ServoSample]]) -> None:
            if console.is_terminal:
                recent = {leg: rows[-_LIVE_TICKS:] for leg, rows in so_far.items()}
                table.update(_joints(plans, recent))

        samples = collect(plans, seconds, stop=stop, say=_say, look=look)
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


@app.command("learn")
def learn_(
    config: ConfigOption = None,
    device: DeviceOption = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Where the baseline goes.")
    ] = Path("baseline.json"),
    drive: Annotated[
        bool,
        typer.Option(
            "--drive",
            help="Let the bridge swing the legs.  Without it, your own controller has to swing "
            "them in free air meanwhile.",
        ),
    ] = False,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Learn from the samples of any source on the wire; no bus is opened.",
        ),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="The robot hangs free; do not ask.")] = False,
    seconds: Annotated[
        float, seconds_option("--seconds", least=1.0, most=3600.0, help="How long to swing.")
    ] = 60.0,
    amplitude: Annotated[
        float,
        typer.Option("--amplitude", min=0.05, max=1.5, help="Of driven swings, rad, each way."),
    ] = 0.4,
    pose: Annotated[
        str | None,
        typer.Option(
            "--pose",
            metavar="RAD,RAD,...",
            help="Joint angles to swing around, as the legs stand when they walk; where they are "
            "found without it.",
            show_default=False,
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            "--recording",
            metavar="FILE.mcap",
            help="Where what is recorded goes; beside --out without it.",
            show_default=False,
        ),
    ] = None,
    more: Annotated[
        list[Path] | None,
        typer.Option(
            "--more",
            metavar="FILE.mcap",
            help="Learn from this recording of an earlier run as well; repeatable.",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
    realtime: RealtimeOption = False,
    connect: ConnectOption = None,
    namespace: NamespaceOption = None,
    zenoh_config: ZenohConfigOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Learn how the legs swing in free air, say how good that is, and write a baseline."""
    stop = stoppable()
    _check_source(
        live=live,
        of_bus={"--device": device, "--drive": drive, "--pose": pose, "--realtime": realtime},
        of_wire={"--connect": connect, "--namespace": namespace, "--zenoh-config": zenoh_config},
    )
    from adaptive_contact.cli import _robot_learning as learning
    from adaptive_contact.cli.fit import (
        check_conventions,
        check_streams,
        gather,
        print_training,
        refuse_useless,
    )
    from adaptive_contact.fit.verdict import verdict
    from adaptive_contact.model.model_file import save_baseline

    check_output(out, "--out")
    kept = learning.free_file(out) if recording is None else recording
    check_output(kept, "--recording")
    if holds_content(kept):
        raise ConfigurationError(f"{kept} is there already; give another --recording")
    robot = robot_of(config)
    for leg in robot.legs:
        if leg.chain is None:
            raise ConfigurationError(
                f"leg '{leg.id}' has no lengths_m or origins_m, so its swings cannot be told; "
                "measure its links and fill them in"
            )
    gathered = gather(more or [], robot, refuse=False)
    if live:
        from adaptive_contact.cli._robot_live import collect_live

        link = client(connect, namespace, zenoh_config, wait=False)
        samples = collect_live(robot, link, seconds, stop=stop)
    else:
        with needs_sdk():
            from adaptive_contact.bridge.collect import collect

        plans = plans_of(robot, config, device)
        home = None if pose is None else learning.pose_of(pose, robot, plans)
        _shake_hands(plans, drive=drive)
        if drive and not yes:
            around = "where they are now" if home is None else f"{', '.join(map(str, home))} rad"
            typer.confirm(
                f"The legs {' '.join(robot.leg_ids)} will swing by up to {amplitude} rad around "
                f"{around}.  Does the robot hang free, with nothing and nobody in reach?",
                abort=True,
                err=True,
            )
        scripts = learning.swings_of(robot, plans, amplitude, seed, home) if drive else None
        samples = collect(plans, seconds, scripts=scripts, realtime=realtime, stop=stop, say=_say)
    for line in learning.losses(samples):
        _say(line)
    learning.keep(samples, kept, robot)
    for name, rows in samples.items():
        for sample in rows:
            gathered[name].take_sample(sample)
    # A run of seconds on a bus is too short to refuse by; the verdict on the fit decides.
    check_streams(robot, samples, {}, refuse=False)
    check_conventions(robot, gathered, bridge=not live)
    try:
        training = learning.fit_samples(
            robot, gathered, f"adaptive-contact robot learn ({out.name})"
        )
    except TooLittleDataError as error:
        again = " ".join(f"--more {path}" for path in [*(more or []), kept])
        raise TooLittleDataError(
            f"{error}; what was recorded is in {kept}: run this again with {again} to add to it",
            error.have,
            error.needed,
        ) from error
    refuse_useless(robot, training)
    save_baseline(training.baseline, out)
    print_training(training, robot, json=json)
    for line in verdict(robot, training):
        say(line, err=json)
    say(f"baseline written to {out}, the recording to {kept}", err=True)


def _check_source(
    *, live: bool, of_bus: Mapping[str, object], of_wire: Mapping[str, object]
) -> None:
    """Refuse options of the other source of samples."""
    given = [name for name, value in (of_bus if live else of_wire).items() if value]
    if given and live:
        raise ConfigurationError(
            f"--live listens to the wire, {', '.join(given)} is the bridge's; your own controller "
            "swings the legs: leave it out"
        )
    if given:
        raise ConfigurationError(
            f"{', '.join(given)} goes with --live; without it, the bus is asked"
        )


def _planned(config: Path | None, device: list[str] | None) -> tuple[Robot, tuple[PortPlan, ...]]:
    robot = robot_of(config)
    return robot, plans_of(robot, config, device)


def _shake_hands(plans: tuple[PortPlan, ...], *, drive: bool = False) -> None:
    from adaptive_contact.bridge.handshake import check_ports

    findings = check_ports(plans, drive=drive)
    for line in findings.advice:
        _say(line)
    findings.raise_errors()


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


def _say(line: str) -> None:
    say(f"adaptive-contact: {line}", err=True)
