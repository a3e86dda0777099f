"""Reads bags of ROS 2 (rosbag2) as recordings of the wire contract.

The topics of ``[ros2]`` become ``robot/leg/*/servo`` and, of foot switches, ``robot/leg/*/truth``.
The files are read one by one, whatever ``metadata.yaml`` says of them, so that a bag whose recorder
was killed is read as far as it goes.  MCAP is walked as any recording is, db3 asked by SQL.

A bag of strangers does not fill the memory: chunks, messages and cells unpack to so much and no
more.  The readers of rosbags have no such bounds, and refuse a file whose end is missing.
"""

from __future__ import annotations

import contextlib
import json
import re
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

import zstandard
from mcap.writer import MCAP0_MAGIC

from adaptive_contact.errors import ConfigurationError, RecordingError, needs
from adaptive_contact.robot import Robot
from adaptive_contact.ros2.intake import Intake, check_mapped
from adaptive_contact.ros2.problems import Complaints, Reason
from adaptive_contact.ros2.ticks import Origin
from adaptive_contact.service.recording.format import Record
from adaptive_contact.service.recording.reader import (
    MAX_CHUNK_BYTES,
    Recording,
)
from adaptive_contact.wire import MSGPACK, ContactTruth, encode, servo_key, truth_key

_SHOWN: Final = 6
_ROS_1: Final = b"#ROSBAG V"
# A file of a bag, and what orders the files of one that was split.
_FILE: Final = re.compile(r".*?(\d*)\.(?:mcap|db3)")
_QUERY: Final = """
    SELECT topics.name, CAST(timestamp AS INTEGER), COALESCE(CAST(data AS BLOB), x'')
    FROM messages JOIN topics ON topics.id = messages.topic_id
    WHERE topics.name IN (SELECT value FROM json_each(?)) ORDER BY timestamp
"""


class Bag(Recording):
    """Iterates over a bag, as often as wanted; yields samples and truth of the mapped legs.

    Raises:
        RecordingError: the bag cannot be read.
        ConfigurationError: the robot maps nothing.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, path: str | Path, robot: Robot | None) -> None:
        self.path = Path(path)
        if robot is None:
            raise ConfigurationError(
                f"{path}: a bag of ROS 2; give --config with the robot.toml whose [ros2] says "
                "which topics and joints are which (docs/ros2.md)"
            )
        check_mapped(robot, f"robot '{robot.name}'")
        if all(leg.ros2 is None for leg in robot.legs):
            raise ConfigurationError(
                f"robot '{robot.name}' maps no leg to ROS 2; write [leg.ros2] joints = [...] below "
                "each [[leg]] (docs/ros2.md)"
            )
        with needs("ROS 2", "ros2", "rosbags"):
            import adaptive_contact.ros2.types as types

        self._robot = robot
        self._cdr = types
        self._files = self._find_files()
        self.damage = None
        self.types = {}
        self.notes = ()

    @property
    def about(self) -> dict[str, str]:
        """Return an empty mapping: a bag does not say which robot it is of."""
        return {}

    def __iter__(self) -> Iterator[Record]:
        self.damage = None
        self.types, self.notes = {}, ()
        complaints = Complaints()

        def complain(topic: str, reason: Reason, detail: str) -> None:
            complaints.count(topic, reason, detail, 0.0)

        intake = Intake(self._robot, 1, complain)
        topics = intake.topics(truth=True)
        decode = self._cdr.Types(self._robot.ros2.distro if self._robot.ros2 else "jazzy").decode
        for record in self._messages(topics):
            if record.key not in topics:
                continue
            payload, at_ns = _unpacked(record.payload), record.log_time_ns
            content = intake.read(decode, record.key, *self.types[record.key], payload)
            if content is None:
                continue
            origin = Origin(b"", None, at_ns)
            for leg, made in intake.convert(record.key, self.types[record.key][0], content, origin):
                key = truth_key(leg) if isinstance(made, ContactTruth) else servo_key(leg)
                yield Record(key, encode(made, MSGPACK), MSGPACK, at_ns, at_ns)
        self.notes = (*self._missing(topics), *complaints.lines())

    def _missing(self, topics: dict[str, tuple[str, ...]]) -> Iterator[str]:
        """List each mapped topic that the bag lacks, one line each."""
        for topic, types in topics.items():
            if topic not in self.types:
                like = [name for name, (kind, _) in self.types.items() if kind in types]
                there = like or list(self.types)
                some = ", ".join(there[:_SHOWN]) + (", …" if len(there) > _SHOWN else "")
                of = "such topics are" if like else "there are"
                yield f"no topic {topic} in the bag; {of} {some or 'none'}: correct robot.toml"

    # -- files -------------------------------------------------------------------------------------

    def _find_files(self) -> list[Path]:
        """Return the files of the bag in their order."""
        path = self.path
        if not path.exists():
            raise RecordingError(f"{path}: cannot be read (no such file); give a bag")
        files = sorted((f for f in path.glob("*") if _FILE.fullmatch(f.name)), key=_number)
        packed = (path, *path.glob("*.zstd"))[-1]
        if not files and packed.suffix == ".zstd":
            raise RecordingError(
                f"{packed}: compressed as a whole; unpack each such file with `zstd -d {packed}`"
            )
        for file in files or (path, *sorted(path.glob("*.bag*"))):
            if _is_ros_1(file):
                raise RecordingError(
                    f"{file}: a bag of ROS 1; convert it with `rosbags-convert --src {file} "
                    "--dst DIR`"
                )
        return files or [path]

    def _messages(self, topics: Collection[str]) -> Iterator[Record]:
        for file in self._files:
            read = self._asked if file.suffix == ".db3" else self._walked
            yield from read(file, topics)

    def _walked(self, path: Path, _: Collection[str]) -> Iterator[Record]:
        """Yield the messages of an MCAP file."""
        recording = Recording(path)
        recording.types = self.types
        yield from recording
        self._record_damage(path.name, recording.damage)

    def _asked(self, path: Path, topics: Collection[str]) -> Iterator[Record]:
        """Yield the messages of a db3 file."""
        given = 0
        where = f"{path.resolve().as_uri()}?immutable=1"
        try:
            with contextlib.closing(sqlite3.connect(where, uri=True)) as database:
                # Tables may compute their cells, or be views, which never end.
                database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
                database.set_authorizer(lambda *asked: int(asked[-1] is not None))
                rows = database.execute(
                    "SELECT CAST(name AS TEXT), type FROM topics WHERE name NOT NULL"
                )
                self.types |= {topic: (kind, "") for topic, kind in rows}
                for topic, time_ns, payload in database.execute(_QUERY, [json.dumps([*topics])]):
                    yield Record(topic, payload, "", time_ns, time_ns)
                    given += 1
        except sqlite3.Error as error:
            if not self.types:
                raise RecordingError(
                    f"{self.path}: cannot be read as a bag ({_one_line(error)}); give a folder "
                    "that `ros2 bag record` wrote, or an .mcap or .db3 of it"
                ) from error
            what = f"{_one_line(error)}; the {given} messages before it are intact"
            self._record_damage(path.name, what)

    def _record_damage(self, name: str, damage: str | None) -> None:
        if damage is not None:
            which = "" if name == self.path.name else f"{name}: "
            self.damage = f"{which}{damage}" if self.damage is None else self.damage


def _is_ros_1(path: Path) -> bool:
    with contextlib.suppress(OSError), path.open("rb") as file:
        return file.read(len(_ROS_1)) == _ROS_1
    return False


def _unpacked(payload: bytes) -> bytes:
    """Unpack a message of ``ros2 bag record --compression-mode message``."""
    # Begins a message that its recorder compressed by itself, and no CDR.
    if payload.startswith(b"\x28\xb5\x2f\xfd"):
        with contextlib.suppress(zstandard.ZstdError):
            unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
            return unpacker.stream_reader(payload).read(1 << 20)
    return payload


def _number(path: Path) -> tuple[int, str]:
    """Order of a bag's files: ``walk_2.mcap`` comes before ``walk_10.mcap``."""
    found = _FILE.fullmatch(path.name)
    return (int(found[1] or 0) if found else 0, path.name)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def read_recording(path: str | Path, robot: Robot | None = None) -> Recording:
    """Open a recording for reading.

    Returns:
        An iterable of :class:`Record`, with ``damage`` after a pass over it.

    Raises:
        RecordingError: the file cannot be read, or is no recording.
        ConfigurationError: it is a bag, and ``robot`` does not say what the bag holds.
    """
    if is_bag(path):
        return Bag(path, robot)
    return Recording(path)


def is_bag(path: str | Path) -> bool:
    """Return whether a path is a bag of ROS: a folder, a db3 or bag file, or rosbag2's MCAP."""
    path = Path(path)
    if path.is_dir():
        return any(
            entry.suffix in (".mcap", ".db3", ".yaml", ".zstd", ".bag") for entry in path.iterdir()
        )
    if path.suffix in (".db3", ".bag", ".zstd"):
        return True
    if not path.is_file():  # what can be read but once is left for the reader
        return False
    try:
        with path.open("rb") as file:
            # The magic, the frame of the header, and its first text: the profile.
            head = file.read(len(MCAP0_MAGIC) + 9 + 8)
            ros_2 = head.startswith(MCAP0_MAGIC) and head.endswith(b"\x04\0\0\0ros2")
            return ros_2 or head.startswith(_ROS_1)
    except OSError:
        return False
