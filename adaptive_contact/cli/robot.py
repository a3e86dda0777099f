"""``adaptive-contact robot``: a new robot, from its bus to a baseline."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from adaptive_contact.cli._options import ConfigOption
from adaptive_contact.cli._sim_options import stoppable
from adaptive_contact.cli.bridge import (
    DeviceOption,
    RealtimeOption,
    devices_of,
    needs_sdk,
    robot_of,
)
from adaptive_contact.errors import ConfigurationError, IdentificationError

if TYPE_CHECKING:
    from rich.table import Table

    from adaptive_contact.adapt.training import Training
    from adaptive_contact.bridge.collect import Script
    from adaptive_contact.bridge.plan import PortPlan
    from adaptive_contact.robot import Robot
    from adaptive_contact.wire import ServoSample

__all__ = ["app"]

app = typer.Typer(help="A new robot: who is there, is it right, learn it.", no_args_is_help=True)

# A model is good where it errs little more than readings do; half a step of noise and the step's
# own rounding are 0.58 steps, of two readings (the change from one to the next) 0.82.
_NOISE_STEPS: Final = 0.82
_GOOD, _FAIR = 2.5, 4.0
# Free ticks per term of the library at which held-out error has settled.
_ENOUGH_ROWS: Final = 12
# Slopes within this of each other are as good as one.
_ALIKE: Final = 1.2
_LEAST_TICKS: Final = 12
# Ticks read in whole and in time, below which it is said; swings are cut to pieces by then.
_ENOUGH_READ: Final = 0.97
_PIPE_WIDTH: Final = 110
# The live table looks back so far.
_LIVE_TICKS: Final = 500


@app.command()
def init(
    device: DeviceOption = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Description to write.")
    ] = Path("robot.toml"),
    joints: Annotated[int, typer.Option("--joints", min=1, max=16, help="Per leg.")] = 3,
    legs: Annotated[
        str | None,
        typer.Option(
            "--legs",
            metavar="ID,ID,...",
            help="Names, in the order of the servos' ids.",
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
    name: Annotated[str, typer.Option("--name", help="Of the robot.")] = "my-robot",
    baud: Annotated[
        int | None,
        typer.Option("--baud", help="Otherwise the usual ones are tried.", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file.")] = False,
) -> None:
    """Ask the bus who is there, and write a robot.toml to fill in.  Moves and sets nothing."""
    import msgspec

    with needs_sdk():
        from adaptive_contact.bridge.survey import (
            describe,
            find_servos,
            group,
            steepness,
            write_robot,
        )
        from adaptive_contact.bridge.tables import BAUDS

    # As seen from anywhere, but links are kept: /dev/serial/by-id names an adapter for good.
    devices = {port: str(Path(path).absolute()) for port, path in devices_of(device).items()}
    if not devices:
        raise ConfigurationError(
            "which port? give --device /dev/ttyUSB0 (or left=/dev/ttyUSB0 ...)"
        )
    if out.exists() and not force:
        raise ConfigurationError(f"{out} is there already; give another --out, or --force")
    if baud is not None and baud not in BAUDS:
        raise ConfigurationError(
            f"baud {baud} is not supported; expected one of {', '.join(map(str, BAUDS))}"
        )
    bauds = () if baud is None else (baud,)
    found = [
        find_servos(port, path, *((bauds,) if bauds else ())) for port, path in devices.items()
    ]
    for line in describe(found):
        typer.echo(line)
    robot = group(found, joints, tuple(legs.split(",")) if legs else ())
    robot = msgspec.structs.replace(robot, name=name)
    if lengths is not None:
        measured = _lengths(lengths, joints)
        alike = tuple(msgspec.structs.replace(leg, lengths_m=measured) for leg in robot.legs)
        robot = msgspec.structs.replace(robot, legs=alike)
    slopes = steepness(found)
    if slopes and max(slopes.values()) > _ALIKE * min(slopes.values()):
        told = ", ".join(f"{model} {slope:g}" for model, slope in slopes.items())
        typer.echo(f"slopes differ ({told} rad): slope_rad is between them, which is near enough")
    try:
        out.write_text(write_robot(robot), encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"{out}: cannot be written ({error.strerror}); give another --out"
        ) from error
    todo = "" if lengths is not None else "fill in lengths_m, then "
    typer.echo(
        f"wrote {out}: {len(robot.legs)} legs of {joints} joints; {todo}run "
        f"`adaptive-contact robot check --config {out}`"
    )


def _lengths(text: str, joints: int) -> tuple[float, ...]:
    try:
        lengths = tuple(float(part) for part in text.split(","))
    except ValueError:
        lengths = ()
    if len(lengths) != joints or not all(0.0 < length <= 5.0 for length in lengths):
        raise ConfigurationError(
            f"--lengths {text}: expected {joints} lengths in m, such as "
            f"{','.join(['0.1'] * joints)}"
        )
    return lengths


@app.command()
def check(
    config: ConfigOption = None,
    device: DeviceOption = None,
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
        float, typer.Option("--seconds", min=0.2, max=600.0, help="How long to look.")
    ] = 1.0,
) -> None:
    """Show every joint live: angle, sign, offset, limits.  Moves nothing.

    Move joints by hand meanwhile (--seconds gives time for it, Ctrl-C ends it): the angle of a
    pitch joint grows as the leg is raised, that of a yaw joint as it is turned to the left.
    """
    stop = stoppable()
    with needs_sdk():
        from adaptive_contact.bridge.collect import collect

    from rich.console import Console
    from rich.live import Live

    robot, plans = _shake_hands(config, device)
    console = Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH)
    with Live(console=console, refresh_per_second=10, transient=True) as live:

        def look(so_far: dict[str, list[ServoSample]]) -> None:
            if console.is_terminal:
                recent = {leg: rows[-_LIVE_TICKS:] for leg, rows in so_far.items()}
                live.update(_joints(plans, recent))

        samples = collect(plans, seconds, stop=stop, say=_say, look=look)
    silent = [leg.id for leg in robot.legs if not samples.get(leg.id)]
    if silent:
        raise ConfigurationError(
            f"leg {', '.join(silent)}: not all of its servos answered; see the lines above"
        )
    console.print(_joints(plans, samples))
    if picture is not None:
        from adaptive_contact.cli._robot_picture import draw

        if all(leg.lengths_m is None for leg in robot.legs):
            raise ConfigurationError(
                "no leg has lengths_m, so there is nothing to draw; measure one"
            )
        last = {leg: rows[-1].measured for leg, rows in samples.items()}
        picture.write_text(draw(robot, last), encoding="utf-8")
        typer.echo(f"drew {picture}")
    blank = [leg.id for leg in robot.legs if leg.lengths_m is None]
    if blank:
        typer.echo(f"lengths_m are still missing for leg {', '.join(blank)}", err=True)


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
    yes: Annotated[bool, typer.Option("--yes", help="The robot hangs free; do not ask.")] = False,
    seconds: Annotated[
        float, typer.Option("--seconds", min=1.0, max=3600.0, help="How long to swing.")
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
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
    realtime: RealtimeOption = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Learn how the legs swing in free air, say how good that is, and write a baseline."""
    stop = stoppable()
    with needs_sdk():
        from adaptive_contact.bridge.collect import collect

    from adaptive_contact.adapt.baseline import save_baseline
    from adaptive_contact.cli.fit import print_training

    robot, plans = _shake_hands(config, device)
    for leg in robot.legs:
        if leg.lengths_m is None:
            raise ConfigurationError(
                f"leg '{leg.id}' has no lengths_m, so its swings cannot be told; measure its links "
                "and fill them in"
            )
    if drive and not yes:
        typer.confirm(
            f"The legs {' '.join(robot.leg_ids)} will swing by up to {amplitude} rad.  Does the "
            "robot hang free, with nothing and nobody in reach?",
            abort=True,
            err=True,
        )
    home = None if pose is None else _pose(pose, robot)
    scripts = _scripts(robot, plans, amplitude, seed, home) if drive else None
    samples = collect(plans, seconds, scripts=scripts, realtime=realtime, stop=stop, say=_say)
    for line in _losses(samples):
        _say(line)
    training = _fit(robot, samples, out.name)
    save_baseline(training.baseline, out)
    print_training(training, robot, json=json)
    for line in _verdict(robot, training):
        typer.echo(line, err=json)
    typer.echo(f"baseline written to {out}", err=True)


def _pose(text: str, robot: Robot) -> list[float]:
    try:
        pose = [float(part) for part in text.split(",")]
    except ValueError:
        pose = []
    joints = {len(leg.joints) for leg in robot.legs}
    if joints != {len(pose)} or not all(abs(angle) <= 2 * math.pi for angle in pose):
        raise ConfigurationError(
            f"--pose {text}: expected {' or '.join(map(str, sorted(joints)))} angles in rad, such "
            f"as {','.join(['0.1'] * max(joints))}"
        )
    return pose


def _shake_hands(
    config: Path | None, device: list[str] | None
) -> tuple[Robot, tuple[PortPlan, ...]]:
    from adaptive_contact.bridge.handshake import check_ports
    from adaptive_contact.bridge.plan import plan_ports

    robot = robot_of(config)
    plans = plan_ports(robot, devices_of(device))
    findings = check_ports(plans)
    for line in findings.advice:
        _say(line)
    findings.raise_errors()
    return robot, plans


def _scripts(
    robot: Robot,
    plans: Sequence[PortPlan],
    amplitude: float,
    seed: int,
    home: list[float] | None,
) -> dict[str, Script]:
    """Free swings of every leg, each with a stream of randomness of its own."""
    import functools

    import numpy as np

    from adaptive_contact.bridge.freeswing import free_swings

    steps = {leg.id: leg.max_step_rad for plan in plans for leg in plan.legs}
    seeds = np.random.SeedSequence(seed).spawn(len(robot.legs))

    def script(
        leg_id: str, seed_of: np.random.SeedSequence, first: ServoSample
    ) -> Iterator[list[float]]:
        return free_swings(
            robot.leg(leg_id),
            first.measured if home is None else home,  # the bridge comes there at an easy pace
            np.random.default_rng(seed_of),
            amplitude_rad=amplitude,
            max_step_rad=steps[leg_id],
        )

    return {
        leg.id: functools.partial(script, leg.id, seed_of)
        for leg, seed_of in zip(robot.legs, seeds, strict=True)
        if leg.id in steps
    }


def _fit(robot: Robot, samples: Mapping[str, list[ServoSample]], name: str) -> Training:
    from adaptive_contact.adapt.gather import LegGatherer
    from adaptive_contact.adapt.training import learn

    gatherers = {leg.id: LegGatherer(leg, robot.period_s) for leg in robot.legs}
    for leg, rows in samples.items():
        for sample in rows:
            gatherers[leg].take_sample(sample)
    streams = {
        leg: [
            stretch
            for stretch in gatherer.stretches(free=True)
            # Lost ticks cut a stream to pieces; what is shorter than a swing teaches nothing.
            if (stretch.swing & stretch.sound).sum() > _LEAST_TICKS
        ]
        for leg, gatherer in gatherers.items()
        if gatherer.samples
    }
    if not any(streams.values()):
        raise IdentificationError(
            "no leg was swung; swing them in free air while this runs, or let --drive do it"
        )
    return learn(robot, streams, origin=f"adaptive-contact robot learn ({name})")


def _losses(samples: Mapping[str, list[ServoSample]]) -> list[str]:
    """Legs of which too little was read to learn from, and what to do about it."""
    lines = []
    for leg, rows in samples.items():
        if not rows:
            continue
        whole = sum(row.valid is None for row in rows) / (rows[-1].seq - rows[0].seq + 1)
        if whole < _ENOUGH_READ:
            lines.append(
                f"leg {leg}: only {100 * whole:.0f} % of its ticks were read in whole and in time; "
                "end other work on this computer, give --realtime, or check cable and power"
            )
    return lines


def _verdict(robot: Robot, training: Training) -> list[str]:
    """How good every leg was learned, in words, and what to do about it."""
    import numpy as np

    lines = []
    for leg, figures in training.figures.items():
        noise = _NOISE_STEPS * robot.quantum(leg)
        worst = float(np.max(figures.held_out_rms)) / noise
        wanted = _ENOUGH_ROWS * figures.library_size
        if figures.rows < wanted:
            more = wanted / max(figures.rows, 1)
            word = f"too little: {figures.rows} of {wanted} free ticks; swing {more:.1f} x as long"
        elif worst <= _GOOD:
            word = "good"
        elif worst <= _FAIR:
            word = "usable; longer and more varied swings may help"
        else:
            word = "poor; check lengths, signs, servo.slope_rad, and that nothing was touched"
        lines.append(f"leg {leg}: {word} (errs by {worst:.1f} x the noise of its readings)")
    return lines


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
    typer.echo(f"adaptive-contact: {line}", err=True)
