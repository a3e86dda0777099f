"""Exports recordings: tables, bags of ROS 2, and older recordings as MCAP of today.

Messages keep their keys, times and order; nothing is resampled.  What no table has (a key that the
contract does not have, a payload that cannot be read) is counted by key and reason.  Memory does
not grow with the recording: tables are written in groups of rows, in two passes, the first of which
finds how many joints the widest leg has.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from adaptive_contact.errors import RecordingError, needs
from adaptive_contact.files import whole_file
from adaptive_contact.robot import Robot
from adaptive_contact.service.recording.format import Record
from adaptive_contact.service.recording.reader import Recording
from adaptive_contact.service.recording.scene import Scene
from adaptive_contact.service.recording.schemas import kind_of_key
from adaptive_contact.service.recording.writer import RecordingWriter
from adaptive_contact.wire import (
    ContactEvent,
    Message,
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

# Names of a message's columns, by the path of their value.
Columns = dict[str, dict[str, None]]


def _cells(held: object, path: str = "") -> Iterator[tuple[str, str, object]]:
    """Yield path, column and content of each value: ``drift.level``, ``measured_0``.

    A list of numbers has a column for each place, a struct one for each field; text, maps, lists of
    those, and lists that are longer than any robot's, are one of JSON.
    """
    if isinstance(held, msgspec.Struct):
        for name in held.__struct_fields__:
            yield from _cells(getattr(held, name), f"{path}.{name}" if path else name)
    elif not isinstance(held, list | tuple | dict):
        yield path, path, held
    elif (
        not isinstance(held, dict)
        and len(held) <= 64
        and all(isinstance(part, int | float) for part in held)
    ):
        for at, part in enumerate(held):
            yield path, f"{path}_{at}", part
    else:
        yield path, path, msgspec.json.encode(held).decode()


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
        message = decode(record.payload, kind, record.encoding)
        if isinstance(message, Rejected):
            exported.left_out[record.key, message.reason.value] += 1
        else:
            yield record, kind, message


def _write_tables(recording: Recording, out: Path, exported: Exported) -> None:
    columns: dict[type[Message], Columns] = {}
    first = Exported()
    for record, kind, message in _known(recording, first):
        own = columns.setdefault(kind, {})
        for place, name, held in _cells(message):
            of_place = own.setdefault(place, {})
            if held is not None:
                of_place[name] = None
        first.count(record)
    if not first.messages:
        why = "no message in it"
        for (key, reason), _ in first.left_out.most_common(1):
            why = f"none of its {first.left_out.total()} messages can be exported ({key}: {reason})"
        expected = "; expected keys such as robot/leg/lf/servo" if first.left_out else ""
        raise RecordingError(f"{recording.path}: {why}; nothing was written{expected}")
    try:
        out.mkdir(exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"{out}: cannot be made ({error.strerror}); give a folder in one that exists"
        ) from error
    with contextlib.ExitStack() as stack:
        tables: dict[type[Message], csv.DictWriter[str]] = {}
        for kind, own in columns.items():
            path = out / f"{kind.__name__}.csv"
            file = codecs.getwriter("utf-8")(
                stack.enter_context(whole_file(path, error=RecordingError))
            )
            # What was None all the time has a column, too; the leg is known by the key.
            own["leg"] = {}
            names = [name for place, of_place in own.items() for name in of_place or (place,)]
            names = ["log_time_ns", "key", "leg", *(name for name in names if name != "leg")]
            tables[kind] = csv.DictWriter(file, names, lineterminator="\n")
            tables[kind].writeheader()
            exported.files[path] = 0
        for record, kind, message in _known(recording, exported):
            # A flag is 1 or 0: programs that plot columns do not take words.
            cells = {
                name: int(held) if isinstance(held, bool) else held
                for _, name, held in _cells(message)
                if held is not None
            }
            leg = leg_of_key(record.key) or cells.get("leg")
            where = {"log_time_ns": record.log_time_ns, "key": record.key, "leg": leg}
            tables[kind].writerow(cells | where)
            exported.files[out / f"{kind.__name__}.csv"] += 1
            exported.count(record)
