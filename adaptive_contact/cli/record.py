"""``adaptive-contact record``: what goes over the wire, into an MCAP file."""

from __future__ import annotations

import collections
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._link import leave, open_link
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import make_stdout_optional, overwrite, say, say_note
from adaptive_contact.printable import printable


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
    force: opt.ForceOption = False,
    network: opt.Network,
) -> None:
    """Record messages of any key, byte for byte, until Ctrl-C."""
    make_stdout_optional()
    # Before anything that takes time, so that a stop during the start is clean too.
    stop = opt.stoppable()

    from adaptive_contact.service.recording import RecordingWriter
    from adaptive_contact.service.recording.recorder import Recorder, check_key_expression

    check_key_expression(key)
    opt.check_output(file, "FILE", force=force)
    settings = network.client()
    link = open_link(settings, stop)
    if link is None:
        return
    try:
        started_s = time.monotonic()
        live = sys.stderr.isatty()
        about = {"key": key, "recorded": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
        with RecordingWriter(file, about) as writer:
            recorder = Recorder(link, writer, key)
            say(f"recording {key} to {file}; stop with Ctrl-C", err=True)
            recorder.run(
                stop, seconds, (lambda: _progress(recorder.counts, started_s)) if live else None
            )
    finally:
        closed = link.close()
    if live:
        overwrite("")
    _report(file, key, recorder.counts, time.monotonic() - started_s)
    leave(closed=closed)


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


def _report(file: Path, key: str, counts: collections.Counter[str], elapsed_s: float) -> None:
    size_kb = file.stat().st_size / 1000
    say(
        f"{counts.total()} messages of {len(counts)} keys in {elapsed_s:.1f} s, "
        f"{size_kb:.0f} kB in {file}"
    )
    width = max((len(printable(name)) for name in counts), default=0)
    for name in sorted(counts):
        rate = counts[name] / elapsed_s
        say(f"  {printable(name):{width}}  {counts[name]:8d}  {rate:7.1f} /s")
    if not counts:
        say_note(
            f"nothing was received on '{key}'; `adaptive-contact doctor` shows who publishes what"
        )
