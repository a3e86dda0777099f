"""Exports recordings: tables, bags of ROS 2, and older recordings as MCAP of today.

Messages keep their keys, times and order; nothing is resampled.  What no table has (a key that the
contract does not have, a payload that cannot be read) is counted by key and reason.  Memory does
not grow with the recording: tables are written in groups of rows, in two passes, the first of which
finds how many joints the widest leg has.
"""

from __future__ import annotations

import contextlib
import csv
import io
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, Literal, get_type_hints

import msgspec

from adaptive_contact.errors import RecordingError, needs
from adaptive_contact.files import whole_file
from adaptive_contact.robot import Robot
from adaptive_contact.service.recording.format import Record
from adaptive_contact.service.recording.reader import Recording
from adaptive_contact.service.recording.scene import Scene
from adaptive_contact.service.recording.schemas import kind_of_key, parts_of
from adaptive_contact.service.recording.writer import RecordingWriter
from adaptive_contact.wire import (
    ContactEvent,
    Message,
    Reject,
    Rejected,
    contact_key,
    decode,
    leg_of_key,
)

# csv: a folder of tables; bag: a bag of ROS 2; mcap: a recording.
ExportFormat = Literal["csv", "bag", "mcap"]


class Exported:
    """Counts what an export wrote and left out.

    Attributes:
        messages: written.
        span_s: time between the first and last of them, as recorded, s.
        left_out: messages that were not, by key and why.
        files: that were written, and how many messages are in each.
    """

    def __init__(self) -> None:
        self.messages = 0
        self.left_out: Counter[tuple[str, str]] = Counter()
        self.files: dict[Path, int] = {}
        self._first_ns = self._last_ns = 0

    @property
    def span_s(self) -> float:
        """See the class."""
        return (self._last_ns - self._first_ns) / 1e9

    def count(self, record: Record) -> None:
        """Count a message that was written."""
        at_ns = record.log_time_ns
        self._first_ns = min(self._first_ns, at_ns) if self.messages else at_ns
        self._last_ns = max(self._last_ns, at_ns)
        self.messages += 1


def export_recording(
    recording: Recording,
    out: Path,
    to: ExportFormat,
    robot: Robot | None = None,
    events: Sequence[ContactEvent] | None = None,
) -> Exported:
    """Write a recording for other programs.

    Args:
        recording: that is read.
        out: an MCAP file, or for tables a folder, which is made where it is missing; of a bag, one
            that is not there.
        to: the format.
        robot: whose recording it is: needed for a bag, drawn in an MCAP file.
        events: in a bag, in place of those that were recorded.

    Returns:
        What was written and what was not.

    Raises:
        RecordingError: it cannot be read or written, or has no message that can be exported.
        MissingExtraError: a library for the format is not installed.
    """
    exported = Exported()
    if to == "csv":
        _write_tables(recording, out, exported)
        return exported
    if to == "bag":
        assert robot is not None
        _write_bag(recording, out, robot, events, exported)
        return exported
    scene = None if robot is None else Scene(robot)
    with RecordingWriter(out, recording.about, scene) as writer:
        for record in recording:
            writer.write(*record)
            exported.count(record)
    exported.files[out] = exported.messages
    return exported


def _nothing(recording: Recording, exported: Exported) -> str:
    """Explain why nothing was written, which then leaves no file."""
    if not exported.left_out:
        return f"{recording.path}: no message in it; nothing was written"
    (key, why), _ = exported.left_out.most_common(1)[0]
    return (
        f"{recording.path}: none of its {exported.left_out.total()} messages can be exported "
        f"({key}: {why}); nothing was written; expected keys such as robot/leg/lf/servo"
    )


def _read(record: Record, kind: type[Message], exported: Exported) -> Message | None:
    message = decode(record.payload, kind, record.encoding)
    if isinstance(message, Rejected):
        exported.left_out[record.key, message.reason.value] += 1
        return None
    return message


def _write_bag(
    recording: Recording,
    out: Path,
    robot: Robot,
    events: Sequence[ContactEvent] | None,
    exported: Exported,
) -> None:
    with needs("export --to bag", "ros2", "rosbags"):
        from adaptive_contact.ros2.bag import BagWriter
    due: dict[tuple[str, int], list[ContactEvent]] = {}
    for event in events or ():
        due.setdefault((event.leg, event.t_ns), []).append(event)
    try:
        with BagWriter(out, robot) as bag:
            for record, kind, message in _known(recording, exported):
                leg, at_ns = leg_of_key(record.key) or "", record.log_time_ns
                if kind is ContactEvent and events is not None:
                    continue
                if bag.write(leg, message, at_ns):
                    exported.count(record)
                else:
                    exported.left_out[record.key, "nothing that ROS 2 gets"] += 1
                # An event belongs to the sample that decided.
                for event in due.pop((leg, getattr(message, "t_ns", -1)), ()):
                    bag.write(leg, event, at_ns)
    except OSError as error:
        raise RecordingError(
            f"{out}: cannot be written ({error.strerror}); give a folder on a disk that has room"
        ) from error
    for leg, _ in due:
        exported.left_out[contact_key(leg), "an event of a sample that is not there"] += 1
    for path in sorted(out.glob("*.mcap")):
        exported.files[path] = exported.messages


# -- tables ----------------------------------------------------------------------------------------

Row = list[Any]


class _Columns:
    """Lays out the table of one message: ``measured_0``, ``drift.level``.

    A list of numbers has a column for each place, a struct one for each field; text, maps and lists
    of those are one column of JSON.
    """

    def __init__(self, kind: type[Message]) -> None:
        self.width: Counter[str] = Counter()
        self._fields = [
            (name, attrgetter(name), form) for name, form in _flat(kind, "") if name != "leg"
        ]  # the leg is known by the key
        self._lists = [(name, get) for name, get, form in self._fields if form == "wide"]

    def look(self, message: Message) -> None:
        """Make room for a message's lists, up to the widest of a robot."""
        for name, get in self._lists:
            held = get(message)
            # Columns of one list; a robot's legs have at most 16 joints.
            if held is not None and self.width[name] < len(held) <= 64:
                self.width[name] = len(held)

    @property
    def names(self) -> Row:
        names: Row = ["log_time_ns", "key", "leg"]
        for name, _, form in self._fields:
            wide = form == "wide"
            names += [f"{name}_{at}" for at in range(self.width[name])] if wide else [name]
        return names

    def row(self, record: Record, message: Message) -> Row | None:
        """Return the values in the order of the columns; None where a list is too long."""
        row: Row = [
            record.log_time_ns,
            record.key,
            leg_of_key(record.key) or getattr(message, "leg", None),
        ]
        for name, get, form in self._fields:
            try:
                held = get(message)
            except AttributeError:  # of a struct that is None
                held = None
            if form == "wide":
                held = held or ()
                room = self.width[name] - len(held)
                if room < 0:
                    return None
                row.extend(held)
                row.extend([None] * room)
            elif form == "json" and held is not None:
                row.append(msgspec.json.encode(held).decode())
            else:
                row.append(held)
        return row


def _flat(
    struct: type[msgspec.Struct], before: str
) -> Iterator[tuple[str, Literal["plain", "wide", "json"]]]:
    """Yield each value's path, and whether it has a column, one for each place, or one of JSON."""
    hints = get_type_hints(struct)
    for field in msgspec.structs.fields(struct):
        name = f"{before}{field.name}"
        origin, arguments, _ = parts_of(hints[field.name])
        inner = parts_of(arguments[0])[0] if origin is list else origin
        if origin is list and inner in (float, int, bool):
            yield name, "wide"
        elif origin in (list, dict):
            yield name, "json"
        elif isinstance(inner, type) and issubclass(inner, msgspec.Struct):
            yield from _flat(inner, f"{name}.")
        else:
            yield name, "plain"


class _CsvTable:
    def __init__(self, names: Row, file: IO[bytes]) -> None:
        self._text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        self._rows = csv.writer(self._text, lineterminator="\n")
        self._rows.writerow(names)

    def add(self, row: Row) -> None:
        # A flag is 1 or 0: programs that plot columns do not take words.
        self._rows.writerow([int(held) if held is True or held is False else held for held in row])

    def close(self) -> None:
        self._text.flush()
        self._text.detach()


def _known(
    recording: Iterable[Record], exported: Exported
) -> Iterator[tuple[Record, type[Message], Message]]:
    kinds: dict[str, type[Message] | None] = {}
    for record in recording:
        if record.key not in kinds:
            kinds[record.key] = kind_of_key(record.key)
        kind = kinds[record.key]
        if kind is None:
            exported.left_out[record.key, "no message of the contract has this key"] += 1
            continue
        message = _read(record, kind, exported)
        if message is not None:
            yield record, kind, message


def _write_tables(recording: Recording, out: Path, exported: Exported) -> None:
    columns: dict[type[Message], _Columns] = {}
    first = Exported()
    for record, kind, message in _known(recording, first):
        if kind not in columns:
            columns[kind] = _Columns(kind)
        columns[kind].look(message)
        first.count(record)
    if not first.messages:
        raise RecordingError(_nothing(recording, first))
    try:
        out.mkdir(exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"{out}: cannot be made ({error.strerror}); give a folder in one that exists"
        ) from error
    with contextlib.ExitStack() as stack:
        tables: dict[type[Message], _CsvTable] = {}
        counts: dict[type[Message], int] = dict.fromkeys(columns, 0)
        for kind, described in columns.items():
            path = out / f"{kind.__name__}.csv"
            file = stack.enter_context(whole_file(path, error=RecordingError))
            tables[kind] = _CsvTable(described.names, file)
        for record, kind, message in _known(recording, exported):
            row = columns[kind].row(record, message)
            if row is None:
                exported.left_out[record.key, Reject.WRONG_JOINTS.value] += 1
                continue
            tables[kind].add(row)
            counts[kind] += 1
            exported.count(record)
        for kind, table in tables.items():
            table.close()
            exported.files[out / f"{kind.__name__}.csv"] = counts[kind]
