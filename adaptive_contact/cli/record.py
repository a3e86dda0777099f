"""Defines ``adaptive-contact record``: the wire into an MCAP file or several."""

from __future__ import annotations

import collections
import contextlib
import glob
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._link import open_link
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import make_stdout_optional, overwrite, print_line, print_note
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.printable import printable
from adaptive_contact.robot import load_robot


@opt.flatten
def record(
    *,
    file: Annotated[
        Path, typer.Argument(metavar="FILE.mcap", help="Recording to write.", show_default=False)
    ],
    key: Annotated[
        str, option("--key", "Zenoh key expression of what to record.", "EXPR")
    ] = "robot/**",
    seconds: Annotated[
        float | None, seconds_option("--seconds", "Stop after so long; otherwise at Ctrl-C.")
    ] = None,
    config: Annotated[
        Path | None,
        option(
            "--config",
            "Description of the robot, or a shipped one's name: adds joint states, transforms and "
            "feet for 3D panels.",
            "ROBOT.TOML",
        ),
    ] = None,
    max_bag_duration: Annotated[
        float | None,
        seconds_option(
            "--max-bag-duration", "Begin a new file after so long: FILE_0.mcap, FILE_1.mcap …"
        ),
    ] = None,
    keep: Annotated[
        int | None,
        option("--keep", "Keep the newest N files of --max-bag-duration, as a ring.", "N", min=2),
    ] = None,
    force: opt.ForceOption = False,
    network: opt.Network,
) -> None:
    """Record messages of any key until Ctrl-C, for replay, Foxglove, rerun and PlotJuggler."""
    make_stdout_optional()
    # Before anything that takes time, so that a stop during the start is clean too.
    stop = opt.stoppable()

    from adaptive_contact.service.link import check_key_expression
    from adaptive_contact.service.recording import RecordingWriter
    from adaptive_contact.service.recording.recorder import (
        Recorder,
        SplitWriter,
        part_path,
    )
    from adaptive_contact.service.recording.scene import Scene

    check_key_expression(key)
    if keep is not None and max_bag_duration is None:
        raise ConfigurationError("--keep is of several files; give --max-bag-duration, too")
    opt.check_output(file if max_bag_duration is None else part_path(file, 0), "FILE", force=force)
    if max_bag_duration is not None:
        parts = file.parent.glob(f"{glob.escape(file.stem)}_[0-9]*{glob.escape(file.suffix)}")
        opt.refuse_to_replace(parts, "FILE", force=force)
    about = {"key": key, "recorded": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
    scene = None
    if config is not None:
        robot = load_robot(config)
        about["robot"], scene = robot.name, Scene(robot)
    settings = network.client()
    with open_link(settings, stop) as link:
        started_s = time.monotonic()
        live = sys.stderr.isatty()
        with contextlib.ExitStack() as stack:
            writer: RecordingWriter | SplitWriter
            if max_bag_duration is None:
                writer = RecordingWriter(file, about, scene)
            else:
                writer = SplitWriter(file, about, scene, max_bag_duration, keep)
            stack.enter_context(writer)
            recorder = Recorder(link, writer, key)
            print_line(f"recording {key} to {file}; stop with Ctrl-C", err=True)
            recorder.run(
                stop, seconds, (lambda: _progress(recorder.counts, started_s)) if live else None
            )
    if live:
        overwrite("")
    files = writer.paths if isinstance(writer, SplitWriter) else [file]
    _report(files, key, recorder.counts, time.monotonic() - started_s)


def _kinds(counts: collections.Counter[str]) -> str:
    """Counts by the last part of the key, the most frequent first."""
    kinds: collections.Counter[str] = collections.Counter()
    for key, count in counts.items():
        kinds[key.rpartition("/")[2]] += count
    return "  ".join(f"{kind} {count}" for kind, count in kinds.most_common(8))


def _progress(counts: collections.Counter[str], started_s: float) -> None:
    elapsed = time.monotonic() - started_s
    line = f"{elapsed:7.1f} s  {counts.total()} messages  {_kinds(counts)}"
    overwrite(line)


def _report(
    files: list[Path], key: str, counts: collections.Counter[str], elapsed_s: float
) -> None:
    size_kb = sum(file.stat().st_size for file in files) / 1000
    where = str(files[0]) if len(files) == 1 else f"{files[0]} to {files[-1].name}"
    print_line(
        f"{counts.total()} messages of {len(counts)} keys in {elapsed_s:.1f} s, "
        f"{size_kb:.0f} kB in {where}"
    )
    width = max((len(printable(name)) for name in counts), default=0)
    for name in sorted(counts):
        rate = counts[name] / elapsed_s
        print_line(f"  {printable(name):{width}}  {counts[name]:8d}  {rate:7.1f} /s")
    if not counts:
        print_note(
            f"nothing was received on '{key}'; `adaptive-contact doctor` shows who publishes what"
        )
