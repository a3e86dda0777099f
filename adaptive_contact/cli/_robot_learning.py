"""Runs ``robot learn``: swings the legs, records, fits, and judges the fit."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._bus import DeviceOption, plans_of, shake_hands
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import print_line, print_note
from adaptive_contact.errors import ConfigurationError, TooLittleDataError
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ServoSample, servo_key

if TYPE_CHECKING:
    import numpy as np

    from adaptive_contact.bridge.training import Script

# Not every free tick can be used: some are too early in a stretch to have a past.
_MORE: Final = 1.15


@opt.flatten
def learn(
    *,
    config: opt.ConfigOption = None,
    device: DeviceOption = None,
    out: opt.BaselineOutOption = Path("baseline.json"),
    drive: Annotated[
        bool,
        option(
            "--drive",
            "Let the bridge swing the legs.  Without it, your own controller has to swing "
            "them in free air meanwhile.",
        ),
    ] = False,
    live: Annotated[
        bool,
        option("--live", "Learn from the samples of any source on the wire; no bus is opened."),
    ] = False,
    yes: Annotated[bool, option("--yes", "The robot hangs free; do not ask.")] = False,
    seconds: Annotated[
        float, seconds_option("--seconds", "How long to swing.", least=1.0, most=3600.0)
    ] = 60.0,
    amplitude: Annotated[
        float,
        option("--amplitude", "Amplitude of driven swings, rad, each way.", min=0.05, max=1.5),
    ] = 0.4,
    pose: Annotated[
        str | None,
        option(
            "--pose",
            "Joint angles to swing around, as the legs stand when they walk; by default where "
            "they are.",
            "RAD,RAD,...",
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        option("--recording", "Where what is recorded goes; beside --out without it.", "FILE.mcap"),
    ] = None,
    more: Annotated[
        list[Path] | None,
        option(
            "--more",
            "Learn from this recording of an earlier run as well; repeatable.",
            "FILE.mcap",
        ),
    ] = None,
    seed: opt.SeedOption = 0,
    force: opt.ForceOption = False,
    realtime: opt.RealtimeOption = False,
    anyway: opt.AnywayOption = False,
    network: opt.Network,
    equations: opt.EquationsOption = False,
    json: opt.JsonOption = False,
) -> None:
    """Learn how the legs swing in free air, say how good that is, and write a baseline."""
    stop = opt.stoppable()
    _check_source(
        live=live,
        of_bus={"--device": device, "--drive": drive, "--pose": pose, "--realtime": realtime},
        of_wire=network.given,
    )
    from adaptive_contact.cli.fit import fit_gathered, gather

    read = [*(more or []), config]
    opt.check_output(out, "--out", read, force=force)
    kept = free_file(out) if recording is None else recording
    opt.check_output(kept, "--recording", [*read, out], force=force)
    robot = opt.described_robot(config)
    for leg in robot.legs:
        if leg.chain is None:
            raise ConfigurationError(
                f"leg '{leg.id}' has no lengths_m or origins_m, so its swings cannot be found; "
                "measure its links and fill them in"
            )
    gather(more or [], robot, refuse=not anyway)  # what is wrong in them is said first
    if live:
        from adaptive_contact.cli._robot_check import collect_live

        source = functools.partial(collect_live, robot, network.client(wait=False), stop=stop)
    else:
        from adaptive_contact.bridge.training import collect

        plans = plans_of(robot, config, device)
        home = None if pose is None else pose_of(pose, robot, plans)
        shake_hands(plans, drive=drive)
        if drive and not yes:
            around = "where they are now" if home is None else f"{', '.join(map(str, home))} rad"
            typer.confirm(
                f"The legs {' '.join(robot.leg_ids)} will swing by up to {amplitude} rad around "
                f"{around}.  Does the robot hang free, with nothing and nobody in reach?",
                abort=True,
                err=True,
            )
        scripts = swings_of(robot, plans, amplitude, seed, home) if drive else None
        does = "swinging all legs" if drive else "observing"
        own = "" if drive else ": swing every leg in free air meanwhile"
        print_note(f"{does} for {seconds:g} s{own}; Ctrl-C ends it earlier")
        source = functools.partial(
            collect, plans, scripts=scripts, realtime=realtime, stop=stop, print_line=print_note
        )
    everything: dict[str, list[ServoSample]] = {}
    # A busy computer reads fewer ticks than it was asked for: what is short is read on.
    left_s, next_s = 3.0 * seconds, seconds
    while True:
        for name, rows in source(seconds=next_s).items():
            everything.setdefault(name, []).extend(rows)
        left_s -= next_s
        keep(everything, kept, robot)
        gathered = gather([*(more or []), kept], robot, refuse=not anyway)
        try:
            fit_gathered(
                gathered,
                robot,
                out,
                f"adaptive-contact robot learn ({out.name})",
                free=True,
                bridge=not live,
                anyway=anyway,
                json=json,
                equations=equations,
            )
            break
        except TooLittleDataError as error:
            read_s = robot.period_s * max(one.samples for one in gathered.values())
            next_s = math.ceil(read_s * (_MORE * error.needed / max(error.have, 1) - 1.0))
            if 0 < next_s <= left_s and not stop.is_set():
                print_note(f"{error}: going on for {next_s} s")
                continue
            again = " ".join(f"--more {path}" for path in [*(more or []), kept])
            raise TooLittleDataError(
                f"{error}, for {next_s} s at this pace; what was recorded is in {kept}: run this "
                f"again with {again} to add to it",
                error.have,
                error.needed,
            ) from error
    print_line(f"baseline written to {out}, the recording to {kept}", err=True)


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


def pose_of(text: str, robot: Robot, plans: Sequence[PortPlan]) -> list[float]:
    """Parse the joint angles of ``--pose``, rad.

    Raises:
        ConfigurationError: it is no pose of this robot, or no leg may go there.
    """
    pose = [*opt.floats(text)]
    joints = {len(leg.joints) for leg in robot.legs}
    if joints != {len(pose)}:
        raise ConfigurationError(
            f"--pose {text}: expected {' or '.join(map(str, sorted(joints)))} angles in rad, such "
            f"as {','.join(['0.1'] * max(joints))}"
        )
    for plan in plans:
        for leg in plan.legs:
            for joint, angle in zip(leg.joints, pose, strict=True):
                if not joint.lower_rad <= angle <= joint.upper_rad:
                    raise ConfigurationError(
                        f"--pose {text}: joint '{joint.name}' of leg '{leg.id}' may go from "
                        f"{joint.lower_rad:.2f} to {joint.upper_rad:.2f} rad; give angles within"
                    )
    return pose


def swings_of(
    robot: Robot, plans: Sequence[PortPlan], amplitude: float, seed: int, home: list[float] | None
) -> dict[str, Script]:
    """Free swings of every leg, each with a stream of randomness of its own."""
    import numpy as np

    from adaptive_contact.bridge.training import free_swings

    steps = {leg.id: leg.max_step_rad for plan in plans for leg in plan.legs}
    swings: dict[str, Iterator[list[float]]] = {}  # which go on where they ended
    seeds = np.random.SeedSequence(seed).spawn(len(robot.legs))

    def script(
        leg_id: str, seed_of: np.random.SeedSequence, first: ServoSample
    ) -> Iterator[list[float]]:
        made = free_swings(
            robot.leg(leg_id),
            first.measured if home is None else home,  # the bridge comes there at an easy pace
            np.random.default_rng(seed_of),
            amplitude_rad=amplitude,
            max_step_rad=steps[leg_id],
        )
        return swings.setdefault(leg_id, made)

    return {
        leg.id: functools.partial(script, leg.id, seed_of)
        for leg, seed_of in zip(robot.legs, seeds, strict=True)
        if leg.id in steps
    }


def free_file(out: Path) -> Path:
    """Return where the recording of a run goes: beside its baseline ``out``, nothing replaced."""
    if out.exists() and not out.is_file():  # a device has no room beside it
        out = Path("learned.json")
    path, number = out.with_suffix(".mcap"), 1
    while path.exists() or path == out:
        number += 1
        path = out.with_name(f"{out.stem}-{number}.mcap")
    return path


def keep(samples: Mapping[str, Sequence[ServoSample]], path: Path, robot: Robot) -> None:
    """Write a run's samples into a recording, in the order of their time.

    Raises:
        RecordingError: it cannot be written.
    """
    from adaptive_contact.service.recording import RecordingWriter
    from adaptive_contact.service.recording.scene import Scene

    about = {"robot": robot.name, "by": "adaptive-contact robot learn"}
    rows = [(row.t_ns, leg, row) for leg, of_leg in samples.items() for row in of_leg]
    with RecordingWriter(path, about, Scene(robot)) as file:
        for t_ns, leg, row in sorted(rows, key=lambda item: item[:2]):
            file.write_message(servo_key(leg), row, t_ns)
