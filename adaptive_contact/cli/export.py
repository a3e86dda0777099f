"""Defines ``adaptive-contact export``: a recording for pandas, sheets, ROS 2, Foxglove."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Final, Literal

import typer

from adaptive_contact.cli._options import (
    ForceOption,
    check_output,
    option,
    recorded_robot,
    refuse_to_replace,
)
from adaptive_contact.cli._output import print_line, print_note
from adaptive_contact.cli.score import read_events
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import load_robot
from adaptive_contact.robot.load import recorded_as

# csv: a folder of tables; bag: a bag of ROS 2; mcap: a recording.
ExportFormat = Literal["csv", "bag", "mcap"]
_SHOWN: Final = 8  # reasons


def export(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.mcap", help="Recording to read.", show_default=False)
    ],
    to: Annotated[
        ExportFormat,
        option(
            "--to",
            "csv: a folder with a table per message; bag: a bag of ROS 2 with contacts and"
            " joint states; mcap: a recording as `record` of today writes it.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        option("--out", "File or folder [FILE-csv, FILE-mcap.mcap …].", "OUT", short="-o"),
    ] = None,
    config: Annotated[
        Path | None,
        option(
            "--config",
            "Description of the robot, or a shipped one's name: of a bag's topics and joints, and"
            " to draw the robot in an mcap.",
            "ROBOT.TOML",
        ),
    ] = None,
    events: Annotated[
        Path | None,
        option("--events", "Events for the bag, as `replay --events` writes them.", "FILE.jsonl"),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Convert a recording for other programs; nothing is resampled or renamed."""
    from adaptive_contact.service.recording import read_recording
    from adaptive_contact.service.recording.export import export_recording

    if out is None:
        out = file.with_name(f"{file.stem}-{to}{'.mcap' if to == 'mcap' else ''}")
    _check(file, out, to, force)
    if config is not None and to == "csv":
        raise ConfigurationError(f"--config is of a bag or an mcap; leave it out of {to}")
    if events is not None and to != "bag":
        raise ConfigurationError(f"--events is of a bag; leave it out of {to}")
    robot = None if config is None else load_robot(config)
    if to == "bag" and robot is None:
        robot = recorded_robot(None, [file])
    elif to == "mcap" and robot is None:
        name = read_recording(file).about.get("robot")
        robot = None if name is None else recorded_as(name)
        if name is not None and robot is None:
            print_note(f"{file}: robot '{name}' is not drawn in {out}; --config draws it")
    given = None if events is None else read_events(events)
    recording = read_recording(file, robot)
    started_s = time.perf_counter()
    exported = export_recording(recording, out, to, robot, given)
    elapsed_s = time.perf_counter() - started_s
    for path, count in exported.files.items():
        print_line(f"{path}: {count} messages, {path.stat().st_size / 1000:.0f} kB", err=True)
    print_line(
        f"{exported.span_s:.1f} s recorded in {elapsed_s:.2f} s "
        f"({exported.span_s / max(elapsed_s, 1e-9):.0f} x real time)",
        err=True,
    )
    if recording.damage is not None:
        print_line(f"adaptive-contact: {file}: {recording.damage}", err=True)
    for (key, why), count in exported.left_out.most_common(_SHOWN):
        print_line(f"adaptive-contact: {file}: {count} messages on {key} left out: {why}", err=True)
    if len(exported.left_out) > _SHOWN:
        more = len(exported.left_out) - _SHOWN
        print_line(f"adaptive-contact: and {more} more such keys or reasons", err=True)


def _check(file: Path, out: Path, to: ExportFormat, force: bool) -> None:
    """Refuse an output that would lose content.

    Raises:
        ConfigurationError: it would, or cannot be written.
    """
    if to == "bag":
        if out.exists():
            raise ConfigurationError(f"{out} exists already; give another --out, or remove it")
    elif to == "mcap":
        check_output(out, "--out", [file], force=force)
    elif out.exists() and not out.is_dir():
        raise ConfigurationError(f"{out} is no folder; {to} takes one, with a table per message")
    else:
        refuse_to_replace(out.glob(f"*.{to}"), "--out", force=force)
