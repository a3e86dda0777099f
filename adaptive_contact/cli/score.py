"""Defines ``adaptive-contact score``: contact events against the simulator's truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import print_json, print_note
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.wire import JSON, MAX_PAYLOAD_BYTES, ContactEvent, Rejected, decode

if TYPE_CHECKING:
    from adaptive_contact.robot import Robot

# Of a file of events: some 17 hours of a hexapod that walks, and 300 MB of memory.
_MOST_LINES: Final = 500_000


def score(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="MCAP file with servo samples and truth, or a bag.",
            show_default=False,
        ),
    ],
    events: Annotated[
        Path | None,
        option(
            "--events",
            "Score these events, one ContactEvent per line, instead of the recorded ones.",
            "FILE.jsonl",
        ),
    ] = None,
    frozen: Annotated[
        bool,
        option(
            "--frozen",
            "Score replays instead: the product's, and that of its detector with the baseline "
            "never updated.",
        ),
    ] = False,
    baseline: opt.BaselineOption = None,
    json: opt.JsonOption = False,
    config: opt.ConfigOption = None,
    from_s: Annotated[float, seconds_option("--from", "Judge swings from here on.")] = 0.0,
    to_s: Annotated[float | None, seconds_option("--to", "Judge swings up to here.")] = None,
    anyway: opt.AnywayOption = False,
) -> None:
    """Print recall, latency, precision and false alarms per robot-hour of a recording."""
    from adaptive_contact.score import score_messages
    from adaptive_contact.score.tables import as_json, as_table
    from adaptive_contact.service.one_robot import OneRobot
    from adaptive_contact.service.recording import read_recording

    end_s = math.inf if to_s is None else to_s
    if not from_s < end_s:
        raise ConfigurationError(f"--from {from_s} is not before --to {end_s}; swap them")
    robot = opt.recorded_robot(config, [recording])
    if frozen and events is not None:
        raise ConfigurationError("--frozen replays the recording itself; leave out --events")
    if baseline is not None and not frozen:
        raise ConfigurationError(
            "--baseline is for --frozen: recorded events are scored as they are"
        )
    of: dict[str, list[ContactEvent] | None] = (
        _replayed(recording, robot, config, baseline)
        if frozen
        else {"": None if events is None else read_events(events)}
    )
    results = {}
    try:
        for name, given in of.items():
            source = read_recording(recording, robot)
            robots = OneRobot(source)
            results[name] = score_messages(robots, robot, given, from_s=from_s, to_s=end_s)
    except RecordingError as error:
        if robots.spoilt(robot) and not anyway:
            raise _nothing_judged(recording) from error
        cut = f" ({source.damage})" if source.damage is not None else ""
        # What reads the file has named it, or a file of the bag.
        named = str(error).startswith(str(recording))
        raise RecordingError(f"{'' if named else f'{recording}: '}{error}{cut}") from error
    finally:
        for line in (*robots.trouble(robot), *source.notes):
            print_note(f"{recording}: {line}")
    if robots.spoilt(robot) and not anyway:
        raise _nothing_judged(recording)
    if source.damage is not None:
        print_note(f"{recording}: {source.damage}")
    if json:
        about = {"recording": str(recording), "truncated": source.damage is not None}
        found = {name: as_json(result) for name, result in results.items()}
        print_json(about | (found if frozen else found[""]), indent=2)
        return
    for name, result in results.items():
        if name:
            table_console().print(f"\n{name}", style="bold")
        table_console().print(as_table(result))


def _replayed(
    recording: Path, robot: Robot, config: Path | None, baseline: Path | None
) -> dict[str, list[ContactEvent] | None]:
    """Return the events of the product, and of the detector with its baseline never updated."""
    from adaptive_contact.core.bank import LearnerBank
    from adaptive_contact.core.learn.mode import LearnerMode
    from adaptive_contact.service.one_robot import OneRobot
    from adaptive_contact.service.recording import read_recording
    from adaptive_contact.service.replay import Counts, replay_events

    learned, _ = opt.learned_of(robot, config, baseline)
    if learned is None:
        raise ConfigurationError(
            "--frozen needs a baseline, which is never updated there; make one with "
            "`adaptive-contact fit`, and give it with --baseline"
        )
    names = {"product": LearnerMode.FULL, "frozen": LearnerMode.FROZEN}
    return {
        name: list(
            replay_events(
                OneRobot(read_recording(recording, robot)),
                LearnerBank(robot, learned, mode=mode),
                Counts(),
            )
        )
        for name, mode in names.items()
    }


def _nothing_judged(recording: Path) -> RecordingError:
    return RecordingError(
        f"{recording}: nothing can be judged by its samples (see above); --anyway goes on"
    )


def read_events(path: Path) -> list[ContactEvent]:
    """Read events of a file with one JSON object per line, line by line.

    Raises:
        RecordingError: it cannot be read, a line is no event, or there are too many of them.
    """
    events: list[ContactEvent] = []
    try:
        with path.open("rb") as file:
            # One byte more than an event may have: `decode` refuses it.
            lines = iter(lambda: file.readline(MAX_PAYLOAD_BYTES + 1), b"")
            for number, line in enumerate(lines, start=1):
                if number > _MOST_LINES:
                    raise RecordingError(
                        f"{path}: has more than {_MOST_LINES} lines; give the events of one "
                        "recording, or of a part of it"
                    )
                if not line.strip():
                    continue
                event = decode(line, ContactEvent, JSON)
                if isinstance(event, Rejected):
                    raise RecordingError(
                        f"{path}, line {number}: not a contact event ({event.detail}); expected "
                        "one JSON object per line, as `adaptive-contact replay --events` writes"
                    )
                events.append(event)
    except OSError as error:
        raise RecordingError(
            f"{path}: cannot be read ({error.strerror}); give a file that "
            "`adaptive-contact replay RECORDING --events FILE` wrote"
        ) from error
    return events
