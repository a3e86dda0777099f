"""Defines ``adaptive-contact replay``: a recording onto the wire, or through the learners."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adaptive_contact.checks.findings import Fault, explained
from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._compiling import compile_tick
from adaptive_contact.cli._link import open_link
from adaptive_contact.cli._options import option
from adaptive_contact.cli._output import print_line, print_note
from adaptive_contact.core.learn.mode import WhenAmbiguous
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.files import write_file
from adaptive_contact.robot import Robot
from adaptive_contact.wire import JSON, encode

if TYPE_CHECKING:
    from adaptive_contact.core.bank import LearnerBank
    from adaptive_contact.model.model_file import Baseline
    from adaptive_contact.service.link import LinkSettings
    from adaptive_contact.service.recording import Recording
    from adaptive_contact.service.replay import Counts


@opt.flatten
def replay(
    *,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.mcap", help="Recording to play, or a bag of ROS 2.", show_default=False
        ),
    ],
    speed: Annotated[
        str | None,
        option(
            "--speed",
            "How much faster than recorded; 'max' takes as little time as it can. [1]",
            "X|max",
        ),
    ] = None,
    events: Annotated[
        Path | None,
        option(
            "--events",
            "Use no network: feed the learners and write one contact event per line "
            "('-' for standard output).",
            "OUT.jsonl",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        option(
            "--plot",
            "Use no network: feed the learners and draw per leg what was detected and missed, "
            "and how far below the threshold.",
            "FILE.html",
        ),
    ] = None,
    baseline: opt.BaselineOption = None,
    config: opt.ConfigOption = None,
    when_ambiguous: opt.AmbiguousOption = WhenAmbiguous.WITHHOLD,
    anyway: opt.AnywayOption = False,
    everything: Annotated[
        bool, option("--all", "Also publish recorded events, status and COMMANDS.")
    ] = False,
    keep_run: Annotated[
        bool, option("--keep-run", "Keep the recorded `run` in the samples.")
    ] = False,
    force: opt.ForceOption = False,
    network: opt.Network,
) -> None:
    """Play a recording: its servo samples and truth onto the wire, or to events with --events."""
    from adaptive_contact.service.recording import is_bag, read_recording

    on_wire = {"--speed": speed, "--all": everything, "--keep-run": keep_run, **network.given}
    published = when_ambiguous is not WhenAmbiguous.WITHHOLD
    through_learners = {
        "--baseline": baseline,
        "--config": config,
        "--when-ambiguous": published,
        "--anyway": anyway,
    }
    if events is not None or plot is not None:
        _refuse(on_wire, "--events and --plot use no network; leave {} out")
        read = (file, config, baseline)
        if str(events) != "-":
            opt.check_output(events, "--events", read, force=force)
        opt.check_output(plot, "--plot", (*read, events), force=force)
        robot = opt.recorded_robot(config, [file])
        recording = read_recording(file, robot)
        learned, _ = opt.learned_of(robot, config, baseline)
        _to_events(recording, robot, events, plot, learned, when_ambiguous, anyway=anyway)
    else:
        bag = is_bag(file)
        if bag:
            del through_learners["--config"]  # says what the bag's topics are
        _refuse(through_learners, "{} is for --events, --plot; the service on the wire has its own")
        mapping = opt.recorded_robot(config, [file]) if bag else None
        factor = opt.speed_of(speed)
        settings = network.client()
        recording = read_recording(file, mapping)
        _to_wire(recording, settings, factor, everything=everything, keep_run=keep_run)


def _refuse(options: Mapping[str, object], message: str) -> None:
    given = [name for name, value in options.items() if value not in (None, False)]
    if given:
        raise ConfigurationError(message.format(" and ".join(given)))


def _to_events(
    recording: Recording,
    robot: Robot,
    out: Path | None,
    plot: Path | None,
    learned: Baseline | None,
    when_ambiguous: WhenAmbiguous,
    *,
    anyway: bool,
) -> None:
    from threadpoolctl import threadpool_limits

    from adaptive_contact.cli._replay_plot import check_plot, write_plot
    from adaptive_contact.core.bank import LearnerBank
    from adaptive_contact.service.one_robot import OneRobot
    from adaptive_contact.service.refits import WaitingRefitter
    from adaptive_contact.service.replay import Counts, TraceBank, replay_events

    if plot is not None:
        check_plot(plot)
    compile_tick()
    threadpool_limits(1)  # matrices this small only wait for each other in threads
    counts = Counts()
    written = 0
    started_s = time.perf_counter()
    # An event is 300 bytes: those of a day fit into memory, and the file is whole or not there.
    kept = io.BytesIO()
    to_stdout = str(out) == "-"
    file = sys.stdout.buffer if to_stdout else kept
    with closing(WaitingRefitter()) as refitter:
        bank = LearnerBank(robot, learned, refitter=refitter, when_ambiguous=when_ambiguous)
        robots = OneRobot(recording)
        traces = TraceBank(bank)
        records = robots if plot is None else traces.gather(robots)
        for event in replay_events(records, bank if plot is None else traces, counts):
            file.write(encode(event, JSON) + b"\n")
            written += 1
    elapsed_s = time.perf_counter() - started_s
    print_line(
        f"{written} events from {counts.samples} samples in {counts.ticks} ticks "
        f"({counts.span_s:.1f} s recorded) in {elapsed_s:.2f} s, "
        f"{counts.samples / max(elapsed_s, 1e-9):.0f} leg-ticks/s",
        err=True,
    )
    _warn(recording, counts)
    signs = _tell_legs(bank, robots.faults(robot))
    for line in robots.trouble(robot, signs):
        print_note(f"{recording.path}: {line}")
    if counts.samples == 0:
        usable = "usable " if counts.rejects else ""
        raise RecordingError(f"{recording.path}: no {usable}servo sample (robot/leg/*/servo) in it")
    if not written and robots.spoilt(robot, by_rate=True) and not anyway:
        raise RecordingError(
            f"{recording.path}: nothing can be judged by its samples (see above); --anyway goes on"
        )
    known = [bank.learner(leg) for leg in robot.leg_ids]
    if not any(learner is not None and learner.status.ticks for learner in known):
        if set(bank.legs) & set(robot.leg_ids) & robots.legs:
            raise RecordingError(f"{recording.path}: none of its samples could be used (see above)")
        raise RecordingError(
            f"{recording.path}: its legs are not those of robot '{robot.name}' "
            f"({', '.join(robot.leg_ids)}); give the --config of the robot that was recorded"
        )
    if to_stdout:
        file.flush()
    elif out is not None:
        write_file(out, kept.getvalue(), error=RecordingError)
    if plot is not None:
        write_plot(plot, traces.traces(), f"Replay of {recording.path.name}")


def _tell_legs(bank: LearnerBank, faults: Iterable[tuple[str, Fault]]) -> list[str]:
    """Describe in one line each leg that lost or refused samples, or has something to report.

    Args:
        bank: of the legs.
        faults: of their samples; what they explain is not said.

    Returns:
        Legs that say that their angles are counted otherwise.
    """
    from adaptive_contact.notes import speaks_of_angles

    known = {leg for leg, fault in faults if "leg_note" in explained(fault)}
    signs = []
    for leg in bank.legs:
        learner = bank.learner(leg)
        if learner is None:
            continue
        status = learner.status
        if speaks_of_angles(status.note or ""):
            signs.append(leg)
        missed, held, swings = status.missed, status.withheld, status.swings_withheld
        words = (
            *(f"{reason} {n}" for reason, n in status.rejects.items()),
            missed and f"{missed} samples missing",
            held and f"{held} contacts withheld while it was ambiguous",
            swings and f"contacts were withheld in {swings} of {status.swings} swings",
            (leg in signs or leg not in known) and status.note,
        )
        if any(words):
            print_note(f"leg '{leg}': {', '.join(word for word in words if word)}")
    return signs


def _to_wire(
    recording: Recording,
    settings: LinkSettings,
    speed: float | None,
    *,
    everything: bool,
    keep_run: bool,
) -> None:
    from adaptive_contact.service.one_robot import OneRobot
    from adaptive_contact.service.replay import WirePlayer

    stop = opt.stoppable()
    with open_link(settings, stop) as link:
        # Milliseconds since 1970: a later replay is a newer start.
        run = time.time_ns() // 1_000_000
        player = WirePlayer(link, speed, everything=everything, keep_run=keep_run, run=run)
        started_s = time.perf_counter()
        robots = OneRobot(recording)
        player.play(robots, stop)
        elapsed_s = time.perf_counter() - started_s
    if speed is None:
        print_note(
            "a service drops samples that come faster than it can judge them (`overflow` in "
            "`watch`); to judge a recording at full speed, use --events"
        )
    behind = f", up to {player.behind_s:.2f} s behind" if player.behind_s > 0.1 else ""
    print_line(
        f"{player.sent.total()} of {player.counts.messages} messages published on "
        f"{len(player.sent)} keys in {elapsed_s:.1f} s "
        f"({player.counts.span_s:.1f} s recorded{behind})",
        err=True,
    )
    _warn(recording, player.counts)
    for line in robots.trouble(None):
        print_note(f"{recording.path}: {line}")
    if player.sent.total() == 0 and not stop.is_set():
        raise RecordingError(
            f"{recording.path}: nothing to publish, there is no servo sample and no truth in it"
        )


def _warn(recording: Recording, counts: Counts) -> None:
    opt.print_damage(recording)
    rejected = counts.rejects.total()
    if rejected:
        reasons = ", ".join(f"{reason} {n}" for reason, n in sorted(counts.rejects.items()))
        print_note(f"{recording.path}: {rejected} samples not used: {reasons}")
