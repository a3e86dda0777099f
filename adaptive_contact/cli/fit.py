"""Defines ``adaptive-contact fit``: a baseline from recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from adaptive_contact.checks.findings import REFUSED_FOR, SPOILS, Finding, name_legs
from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._options import option
from adaptive_contact.cli._output import print_json, print_line, print_note
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ContactTruth, Rejected, ServoSample, decode, leg_of_key

if TYPE_CHECKING:
    from adaptive_contact.fit.recordings import LegGatherer
    from adaptive_contact.fit.train import Stretch, Training
    from adaptive_contact.service.worth import Worth

# Free ticks, of all legs together, from which a tail's quantile at 10⁻⁶ is worth its name.
MANY_TICKS: Final = 20_000


def fit(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...",
            help="MCAP files or bags of ROS 2 with free swings; touches are left out, by the truth "
            "where it is recorded, else by what stands out.",
            show_default=False,
        ),
    ],
    out: opt.BaselineOutOption = Path("baseline.json"),
    config: opt.ConfigOption = None,
    free: Annotated[
        bool, option("--free", "Nothing was touched: without truth, use the swings to their ends.")
    ] = False,
    equations: opt.EquationsOption = False,
    force: opt.ForceOption = False,
    anyway: opt.AnywayOption = False,
    json: opt.JsonOption = False,
) -> None:
    """Learn a contact-free model of every recorded leg, and say how good it is."""
    opt.check_output(out, "--out", [*recordings, config], force=force)
    robot = opt.recorded_robot(config, recordings)
    gathered = gather(recordings, robot, refuse=not anyway)
    origin = f"adaptive-contact fit {' '.join(path.name for path in recordings)}"
    fit_gathered(
        gathered, robot, out, origin, free=free, anyway=anyway, json=json, equations=equations
    )
    print_line(f"baseline written to {out}", err=True)


def fit_gathered(
    gathered: Gathered,
    robot: Robot,
    out: Path,
    origin: str,
    *,
    free: bool,
    bridge: bool = False,
    anyway: bool,
    json: bool,
    equations: bool,
) -> None:
    """Fit what was gathered, say how good it is, and write the baseline.

    Args:
        gathered: samples and truth, by leg.
        robot: its description.
        out: file of the baseline.
        origin: one line on where the samples come from.
        free: swings without truth touched nothing.
        bridge: see :func:`check_conventions`.
        anyway: write it even if it seems useless.
        json: print JSON.
        equations: print them, too.

    Raises:
        TooLittleDataError: there is too little to learn from.
        IdentificationError: it cannot be learned from.
    """
    from threadpoolctl import threadpool_limits

    from adaptive_contact.cli._verdict import unusable, verdict
    from adaptive_contact.fit.train import learn
    from adaptive_contact.model.model_file import save_baseline

    check_conventions(robot, gathered, bridge=bridge, refuse=not anyway)
    streams = {leg: legs.stretches(free=free) for leg, legs in gathered.items() if legs.samples}
    with threadpool_limits(1):  # matrices this small only wait for each other in threads
        training = learn(
            robot,
            streams,
            origin=origin,
            progress=lambda leg: print_line(f"fitting leg {leg}", err=True),
        )
        worth = try_out(robot, streams, training)
    for reason in training.skipped.values():
        print_note(f"left out: {reason}")
    for leg_id, known in training.figures.items():
        if known.touched:
            print_note(
                f"leg '{leg_id}': the foot seems to have touched in "
                f"{known.touched} of {known.swings} swings; {known.outliers} ticks are left out: "
                "record free swings, or with truth, to learn from all of them"
            )
        if not known.determined:
            print_note(
                f"leg '{leg_id}': its motions are too few, or too alike, to determine all terms; "
                "what is known of any leg stands in for the rest: record more motions, at every "
                "speed that the leg will have"
            )
    ticks = min(tail.ticks for tail in training.baseline.tails)
    if ticks < MANY_TICKS:
        print_note(
            f"the thresholds rest on {ticks} free ticks, expected {MANY_TICKS}: "
            "they are cautious, and soft contacts will be missed; record more swings"
        )
    why = unusable(robot, training)
    if why is not None:
        print_note(why)
        if not anyway:
            print_note("no baseline was written; --anyway writes it all the same")
            raise typer.Exit(1)
    save_baseline(training.baseline, out)
    print_training(training, robot, json=json, equations=equations, worth=worth)
    for line in verdict(robot, training, worth):
        print_line(line, err=json)


def try_out(
    robot: Robot, streams: Mapping[str, Sequence[Stretch]], training: Training
) -> dict[str, Worth]:
    """Fit the first part of the recordings, and try that on the rest; by leg, empty where short."""
    from adaptive_contact.errors import IdentificationError
    from adaptive_contact.fit.train import learn
    from adaptive_contact.service.worth import split, worth

    parts = {leg: split(streams[leg]) for leg in training.figures}
    print_line("trying it on stops in swings that are held out", err=True)
    try:
        first = learn(robot, {leg: part for leg, (part, _) in parts.items()}, origin="held out")
    except IdentificationError:
        return {}
    return worth(robot, first.baseline, {leg: part for leg, (_, part) in parts.items()})


class Gathered(dict[str, "LegGatherer"]):
    """Holds what was gathered, by leg.

    Attributes:
        limits: what was found of joints beyond their limits; a leg's signs may explain it.
    """

    def __init__(self, legs: Mapping[str, LegGatherer]) -> None:
        super().__init__(legs)
        self.limits: list[Finding] = []


def gather(recordings: list[Path], robot: Robot, *, refuse: bool = True) -> Gathered:
    """Gather every leg's samples and truth of several recordings, one after the other.

    What is wrong with a recording's streams is said, as ``doctor`` says it of live ones.

    Raises:
        ConfigurationError: no tick of a recording shows how a leg moves.
    """
    from adaptive_contact.fit.recordings import LegGatherer
    from adaptive_contact.service.one_robot import OneRobot
    from adaptive_contact.service.recording import read_recording

    legs = Gathered({leg.id: LegGatherer(leg, robot.period_s) for leg in robot.legs})
    strangers: set[str] = set()
    causes: dict[str, set[str]] = {}
    for number, path in enumerate(recordings):
        recording = read_recording(path, robot)
        if any(path.samefile(other) for other in recordings[:number]):
            raise ConfigurationError(f"{path} is given twice; give every recording once")
        samples: dict[str, list[ServoSample]] = {}
        refused: dict[str, list[Rejected]] = {}
        robots = OneRobot(recording)
        for record in robots:
            leg_id = leg_of_key(record.key)
            leg = legs.get(leg_id or "")
            if leg_id is None or leg is None:
                if leg_id is not None and record.key.endswith("/servo"):
                    strangers.add(leg_id)
                continue
            if record.key.endswith("/servo"):
                sample = decode(record.payload, ServoSample, record.encoding)
                if isinstance(sample, Rejected):
                    refused.setdefault(leg_id, []).append(sample)
                else:
                    samples.setdefault(leg_id, []).append(sample)
                    leg.add_sample(sample)
            elif record.key.endswith("/truth"):
                truth = decode(record.payload, ContactTruth, record.encoding)
                if not isinstance(truth, Rejected):
                    leg.add_truth(truth)
        opt.print_damage(recording)
        for line in robots.trouble(None):
            print_note(f"{path}: {line}")
        of = f"{path}: " if len(recordings) > 1 else ""
        for finding in check_streams(robot, samples, refused, legs.limits, of=of, refuse=refuse):
            for name in finding.legs:
                causes.setdefault(name, set()).add(finding.cause)
    if strangers:
        absent = [name for name, leg in legs.items() if not leg.samples]
        print_note(
            f"not used: {name_legs(sorted(strangers))}, which robot "
            f"'{robot.name}' lacks"
            + (f"; it has {name_legs(absent)}, of which there are no samples" if absent else "")
            + "; give the --config of the robot that was recorded"
        )
    _tell_unused(legs, causes, robot.period_s)
    if causes and not any(leg.samples for leg in legs.values()):
        names = ", ".join(str(path) for path in recordings)
        raise RecordingError(f"{names}: no sample can be used, for the reasons above")
    return legs


def _tell_unused(
    legs: Mapping[str, LegGatherer], causes: Mapping[str, set[str]], period_s: float
) -> None:
    """Print one line on samples that were left out, except those whose cause was printed."""
    left_out: dict[str, dict[str, int]] = {}
    for name, leg in legs.items():
        found = causes.get(name, set())
        known = {reason for cause in found for reason in REFUSED_FOR.get(cause, ())}
        for reason, times in leg.rejects.items():
            if reason not in known:
                left_out.setdefault(str(reason), {})[name] = times
        if leg.off_rate and not found & {"period", "time_unit", "seq"}:
            why = f"not {1e3 * period_s:.1f} ms apart (period_s of robot.toml)"
            left_out.setdefault(why, {})[name] = leg.off_rate
    for why, times_of in left_out.items():
        total = sum(times_of.values())
        print_note(f"{name_legs(times_of)}: {total} samples not used: {why}")


def check_streams(
    robot: Robot,
    samples: Mapping[str, Sequence[ServoSample]],
    refused: Mapping[str, Sequence[Rejected]],
    limits: list[Finding],
    *,
    of: str = "",
    refuse: bool = True,
) -> list[Finding]:
    """Say what is wrong with recorded streams, one line a cause.

    Args:
        robot: that they are taken for.
        samples: by leg.
        refused: payloads that could not be read.
        limits: takes what is not said yet, see :class:`Gathered`.
        of: what comes before each line.
        refuse: end the command where nothing can be learned; else it is only said.

    Raises:
        ConfigurationError: something is wrong with every tick, so that there is nothing to learn.
    """
    from adaptive_contact.checks.legcheck import check_recording

    spoilt: dict[str, None] = {}
    found = check_recording(robot, samples, refused)
    for finding in found:
        if finding.cause == "limits":
            limits.append(finding)
            continue
        print_finding(finding, of)
        if finding.level == "error" and finding.cause in SPOILS:
            spoilt.update(dict.fromkeys(finding.legs))
    if spoilt and refuse:
        raise ConfigurationError(
            f"{name_legs(spoilt)}: the readings are not those of the robot '{robot.name}' (above); "
            "nothing is learned from them: correct the source or robot.toml and record again, or "
            "give --anyway"
        )
    return found


def print_finding(finding: Finding, of: str = "") -> None:
    """Print one thing that is wrong, after what it is of."""
    legs = f"{name_legs(finding.legs)}: " if finding.legs else ""
    print_note(f"{of}{finding.level}: {legs}{finding.what}; {finding.remedy}")


def check_conventions(
    robot: Robot, gathered: Gathered, *, bridge: bool = False, refuse: bool = True
) -> None:
    """Refuse to learn legs whose signs, order or zeros are not those of their description.

    Args:
        robot: its description.
        gathered: by leg.
        bridge: the samples come from a bridge, whose signs stand in ``[leg.servos]``, and whose
            robot hangs free.
        refuse: end the command where there is such a leg; else it is only said.

    Raises:
        ConfigurationError: there is such a leg; a wrong yaw alone, or a zero that is little off, is
            said only.
    """
    from adaptive_contact.checks.leg_ids import check_recorded_ids
    from adaptive_contact.fit.recordings import compare_conventions

    for leg, line in check_recorded_ids(
        robot, {leg: one.last_run() for leg, one in gathered.items()}
    ).items():
        print_note(f"leg '{leg}': {line}")
    grave, found = [], set()
    for finding in compare_conventions(robot, gathered, hangs=bridge):
        advice = finding.servo_advice(robot.leg(finding.leg)) if bridge else finding.advice
        line = f"leg '{finding.leg}': {finding.message}: {advice}"
        print_note(line)
        found.add(finding.leg)
        if finding.grave:
            grave.append(finding.leg)
    for entry in gathered.limits:
        if found.isdisjoint(entry.legs):
            print_finding(entry)
    if grave and refuse:
        raise ConfigurationError(
            f"leg {', '.join(grave)}: signs, order or zeros of the angles are not those of "
            "robot.toml (above); nothing is learned from them: correct robot.toml and run this "
            "again, or give --anyway"
        )


def print_training(
    training: Training,
    robot: Robot,
    *,
    json: bool,
    equations: bool,
    worth: Mapping[str, Worth] | None = None,
) -> None:
    """Show the thresholds, after every leg's equations where they are wanted; or all as JSON."""
    thresholds = training.baseline.thresholds(robot.detector.false_alarms_per_hour)
    if json:
        text = {
            "figures": training.figures,
            "thresholds": thresholds.tolist(),
            "held_out": {leg: one._asdict() for leg, one in (worth or {}).items()},
            "equations": {
                leg: known.model.equations() for leg, known in training.baseline.legs.items()
            },
        }
        print_json(text, indent=2)
        return

    console = table_console()
    for leg, entry in training.baseline.legs.items() if equations else ():
        console.print(f"{leg} (rad)", style="bold")
        for line in entry.model.equations():
            console.print("  " + line, soft_wrap=True)
        console.print()
    aim = robot.detector.false_alarms_per_hour
    console.print(
        f"thresholds for {aim:g} false alarm(s) per robot-hour, windows of 1, 2, 3 ticks: "
        + ", ".join(f"{h:.1f}" for h in thresholds)
    )
