"""What a soak heard and broke, kept for whoever asks later why a touch was missed."""

from __future__ import annotations

from pathlib import Path

import msgspec

from adaptive_contact.files import write_file

from .conduct import Take

__all__ = ["keep_heard"]


def keep_heard(take: Take, path: Path) -> None:
    """Write faults and events, one JSON object per line, in order of time.

    Args:
        take: of the run.
        path: of the file; replaced.  A fault has ``fault``, ``from_ns`` and ``to_ns``, an event
            what was on the wire and ``heard_ns``; all but ``t_ns`` and ``onset_ns``, which are the
            samples', are of the wall clock.
    """
    rows: list[tuple[int, dict[str, object]]] = [
        (one.from_ns, {"fault": one.kind, "from_ns": one.from_ns, "to_ns": one.to_ns})
        for one in take.broken
    ]
    rows += [
        (heard_ns, {"heard_ns": heard_ns, **msgspec.to_builtins(event)})
        for heard_ns, event in take.heard.events
    ]
    rows.sort(key=lambda row: row[0])
    write_file(path, b"".join(msgspec.json.encode(row) + b"\n" for _, row in rows))
