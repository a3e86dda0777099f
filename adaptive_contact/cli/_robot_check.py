"""Runs ``robot check``: every joint as it is now, by its bus or by its samples."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._bus import (
    DeviceOption,
    described_in,
    plans_of,
    shake_hands,
)
from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import print_json, print_line, print_note
from adaptive_contact.errors import ConfigurationError, needs
from adaptive_contact.robot import Robot
from adaptive_contact.service.settings import LinkSettings
from adaptive_contact.wire import ALL_SERVO, Rejected, ServoSample, decode, leg_of_key
from adaptive_contact.wire.received import Received

if TYPE_CHECKING:
    from adaptive_contact.checks.livecheck import LegView, LiveCheck, LiveReport


def check_live(
    robot: Robot,
    settings: LinkSettings,
    seconds: float,
    *,
    stop: threading.Event,
    json: bool,
) -> tuple[int, dict[str, list[float]]]:
    """Look for a while, or until ``stop`` is set, then judge; ``json`` prints the report alone.

    Returns:
        The exit code: 0 where nothing is worse than a note, else 1; each leg's newest reading,
        (J,) rad.

    Raises:
        NoRouterError: there is no router.
    """
    from adaptive_contact.service.link import Link, listen

    with needs("robot check --live", "doctor", "numpy"):
        from adaptive_contact.checks.livecheck import LiveCheck

    check, console = LiveCheck(robot), table_console(pipe_width=120)
    with Link.open(settings) as link:
        if not json:
            print_line(
                "Move one joint after the other by hand.  Another joint is named: the order of "
                "joints, or of ids, is wrong.  The foot goes the other way: that joint's sign is "
                "wrong.",
                err=True,
            )
        with _shown(check, console, quiet=json) as refresh:
            elapsed = listen(
                link, ALL_SERVO, seconds, check.process_message, stop=stop, on_poll=refresh
            )
    report = check.report(elapsed)
    if json:
        print_json(report)
    else:
        _print(report, console)
    return report.exit_code, {leg.leg: [j.angle_rad for j in leg.joints] for leg in report.legs}


def collect_live(
    robot: Robot, settings: LinkSettings, seconds: float, *, stop: threading.Event
) -> dict[str, list[ServoSample]]:
    """Collect the samples of a robot's legs, as the wire has them, in the order of arrival.

    Raises:
        NoRouterError: there is no router.
        ConfigurationError: no samples of these legs came.
    """
    from adaptive_contact.service.link import Link, listen

    kept: dict[str, list[ServoSample]] = {leg: [] for leg in robot.leg_ids}
    strangers: set[str] = set()

    def add_sample(received: Received) -> None:
        leg = leg_of_key(received.key)
        sample = decode(received.payload, ServoSample, received.encoding)
        if leg is None or isinstance(sample, Rejected):
            return
        if leg in kept:
            kept[leg].append(sample)
        else:
            strangers.add(leg)

    with Link.open(settings) as link:
        print_line(
            f"listening for {seconds:g} s: swing every leg in free air meanwhile; Ctrl-C ends it "
            "earlier",
            err=True,
        )
        listen(link, ALL_SERVO, seconds, add_sample, stop=stop)
    if not any(kept.values()):
        others = f", only of leg {', '.join(sorted(strangers))}" if strangers else ""
        raise ConfigurationError(
            f"no samples of leg {', '.join(robot.leg_ids)} came in {seconds:g} s{others}; "
            "publish robot/leg/LEG/servo meanwhile (docs/messages.md), and see "
            "`adaptive-contact doctor`"
        )
    return kept


@contextlib.contextmanager
def _shown(
    check: LiveCheck, console: Console, *, quiet: bool = False
) -> Iterator[Callable[[], None]]:
    """Print moves as they come, below them every joint where this is a terminal.

    Yields:
        What is to be called now and then; it does nothing where ``quiet``.
    """
    printed, redrawn = 0, 0.0
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def refresh() -> None:
            nonlocal printed, redrawn
            if quiet:
                return
            for line in check.moves[printed:]:
                console.print(line, soft_wrap=True)
            printed = len(check.moves)
            if console.is_terminal and time.monotonic() - redrawn >= 0.2:
                redrawn = time.monotonic()
                live.update(legs_table(check.legs(), console.width), refresh=True)

        yield refresh


def _print(report: LiveReport, console: Console) -> None:
    from adaptive_contact.cli.doctor import print_findings

    if report.legs:
        console.print(legs_table(report.legs, console.width))
    for line in report_lines(report):
        console.print(Text(line))
    print_findings(report.findings, console)
    if report.exit_code == 0:
        console.print(Text("nothing looks wrong", style="green"))


def report_lines(report: LiveReport) -> list[str]:
    """Format what the motion has shown, and what it cannot."""
    by_hand = report.by_hand
    said = (
        (report.confirmed, False, "signs, order and zeros: as the motion says, leg {}"),
        (
            report.confirmed,
            True,
            "signs: as the motion says, leg {}; order and zeros of such a chain no motion "
            "confirms: move joints by hand, and compare",
        ),
        (
            report.open,
            False,
            "signs, order and zeros: not confirmed by the motion of leg {} (it takes some 20 s of "
            "walking, and lengths_m); move joints by hand, and compare",
        ),
        (
            report.open,
            True,
            "signs, order and zeros of leg {}: not confirmed by the motion, as the mirror image "
            "of such a chain may walk as well (docs/robot.md); move joints by hand, and compare",
        ),
    )
    lines = [
        words.format(" ".join(of))
        for legs, hand, words in said
        if (of := [leg for leg in legs if (leg in by_hand) is hand])
    ]
    for sign, where in (
        (-1, "below their commands: so it is where they hang"),
        (1, "above their commands: so it is where they stand"),
    ):
        sags = {leg.leg: 1e3 * sign * (leg.above_m or 0.0) for leg in report.legs}
        # What a leg at rest gives way by, mm; less is friction and rounding.
        given = {leg: sag for leg, sag in sags.items() if sag >= 1.0}
        if given:
            lines.append(
                f"at rest, by the description, feet of leg {' '.join(given)} are "
                f"{min(given.values()):.0f} to {max(given.values()):.0f} mm {where}"
            )
    if report.flatness is not None:
        off = 1e3 * abs(report.flatness.off_m)
        whose = report.flatness.leg
        lines.append(
            f"on a level floor: the foot of {whose} would be {off:.0f} mm "
            f"{'above' if report.flatness.off_m > 0 else 'below'} the plane of the others"
            if whose is not None
            else f"on a level floor: one of the feet would be {off:.0f} mm off the others' plane"
        )
    return lines


def legs_table(legs: Sequence[LegView], width: int) -> Table:
    """Format every joint as it is now, and where the foot is, in a number of columns."""
    import numpy as np

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    columns = ["leg", "Hz", "joint", "wire", "angle", "range", "goal", "sign", "limits", "foot"]
    # A terminal narrower than this has no room for the foot.
    for column in columns[: 10 if width >= 96 else 9]:
        # Where there is little room, names are broken, and no number is.
        table.add_column(
            column,
            justify="left" if column in ("leg", "joint", "foot") else "right",
            no_wrap=column not in ("joint", "foot"),
            min_width=10 if column == "joint" else None,
            overflow="fold",
        )
    for leg in legs:
        where = _foot(leg)
        for j, joint in enumerate(leg.joints):
            low, high = np.degrees([joint.low_rad, joint.high_rad])
            limits = ""
            if joint.limits_rad is not None:
                least, most = np.degrees(joint.limits_rad)
                limits = f"{least:.0f}..{most:.0f}°" + (" !" if joint.outside else "")
            row = [
                leg.leg if j == 0 else "",
                "" if j or leg.rate_hz is None else f"{leg.rate_hz:.1f}",
                f"{joint.joint} ({joint.axis})",
                f"{joint.wire_rad:+.2f}",
                f"{np.degrees(joint.angle_rad):+.1f}°",
                f"{low:+.0f}..{high:+.0f}°",
                f"{np.degrees(joint.goal_rad):+.1f}°",
                f"{joint.direction:+d}",
                limits,
                where[j] if j < len(where) else "",
            ]
            table.add_row(*row[: len(table.columns)])
    return table


def _foot(leg: LegView) -> list[str]:
    """Format where the foot is, in three lines beside the joints."""
    lines = []
    if leg.height_m is not None and leg.reach_m is not None:
        side = "below" if leg.height_m < 0 else "above"
        lines.append(f"{abs(leg.height_m) * 1e3:.0f} mm {side} the axis")
        lines.append(f"{leg.reach_m * 1e3:.0f} mm out")
    if leg.forward_m is not None and leg.left_m is not None:
        ahead = "ahead" if leg.forward_m >= 0 else "behind"
        side = "left" if leg.left_m >= 0 else "right"
        lines.append(
            f"{abs(leg.forward_m) * 1e3:.0f} mm {ahead}, {abs(leg.left_m) * 1e3:.0f} mm {side}"
        )
    return lines


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
    force: opt.ForceOption = False,
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
    opt.check_output(picture, "--picture", [config], force=force)
    if live:
        if device:
            raise ConfigurationError("--live listens to the wire, --device opens a bus; give one")
        robot = opt.described_robot(config)
        code, angles = check_live(
            robot,
            network.client(wait=False),
            20.0 if seconds is None else seconds,
            stop=stop,
            json=json,
        )
    elif json or network.given:
        raise ConfigurationError(
            "--connect, --namespace, --zenoh-config and --json go with --live; without it, the bus "
            "is asked"
        )
    else:
        robot, code = opt.described_robot(config), 0
        if robot.ports or device:
            angles = _check_bus(robot, config, device, 1.0 if seconds is None else seconds, stop)
        elif picture is None:
            raise ConfigurationError(
                f"{described_in(config)}: robot '{robot.name}' has no port; add [port.main] with "
                "its device, give --device /dev/ttyUSB0, or give --live to look at the samples of "
                "its source"
            )
        else:
            angles = {leg.id: [0.0] * len(leg.joints) for leg in robot.legs}
            print_line(
                f"drawn with all joints at 0, as robot '{robot.name}' has no port; with --live it "
                "stands as its samples say",
                err=True,
            )
    if picture is not None:
        from adaptive_contact.cli._robot_picture import write_picture

        write_picture(robot, angles, picture)
    raise typer.Exit(code)


def _check_bus(
    robot: Robot,
    config: Path | None,
    device: list[str] | None,
    seconds: float,
    stop: threading.Event,
) -> dict[str, list[float]]:
    """Look at the joints by the bus; each leg's newest reading, (J,) rad."""
    from adaptive_contact.bridge.compare import compare, read_servos
    from adaptive_contact.bridge.training import collect

    plans = plans_of(robot, config, device)
    shake_hands(plans)
    for line in compare(read_servos(plans)):
        print_note(line)
    with needs("robot check", "doctor", "numpy"):
        from adaptive_contact.checks.livecheck import LiveCheck

    check, console = LiveCheck(robot), table_console(pipe_width=120)
    taken: Counter[str] = Counter()
    with _shown(check, console) as refresh:

        def add_samples(so_far: dict[str, list[ServoSample]]) -> None:
            for leg, rows in so_far.items():
                for row in rows[taken[leg] :]:
                    check.add_sample(leg, row)
                taken[leg] = len(rows)
            refresh()

        samples = collect(plans, seconds, stop=stop, print_line=print_note, on_samples=add_samples)
        add_samples(samples)
    silent = [leg.id for leg in robot.legs if not samples.get(leg.id)]
    if silent:
        raise ConfigurationError(
            f"leg {', '.join(silent)}: not all of its servos answered; see the lines above"
        )
    console.print(legs_table(check.legs(), console.width))
    blank = [leg.id for leg in robot.legs if leg.chain is None]
    if blank:
        print_line(
            f"lengths_m (or origins_m) are still missing for leg {', '.join(blank)}", err=True
        )
    return {leg: rows[-1].measured for leg, rows in samples.items()}
