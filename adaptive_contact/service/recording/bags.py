"""Bags of ROS 2 (rosbag2), read as recordings of the wire contract.

The topics of ``[ros2]`` become ``robot/leg/*/servo`` and, of foot switches, ``robot/leg/*/truth``.
MCAP files are walked from the front as any recording, so that a bag whose recorder was killed is
read up to there; db3 files and files compressed as a whole are read by rosbags.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import zstandard

from adaptive_contact.errors import ConfigurationError, RecordingError, needs
from adaptive_contact.robot import Robot
from adaptive_contact.ros2.intake import Intake, check_mapped
from adaptive_contact.ros2.problems import Complaints, Reason
from adaptive_contact.ros2.ticks import Origin
from adaptive_contact.service.recording.format import Record
from adaptive_contact.service.recording.reader import ROS_1, Recording
from adaptive_contact.wire import MSGPACK, ContactTruth, encode, servo_key, truth_key

_SHOWN: Final = 6
# Begins a message that its recorder compressed by itself, and no CDR.
_ZSTD: Final = b"\x28\xb5\x2f\xfd"
_MOST_BYTES: Final = 1 << 20  # of such a message


class _Message(NamedTuple):
    topic: str
    type: str
    hash: str
    time_ns: int
    payload: bytes


class Bag(Recording):
    """A bag to iterate over, as often as wanted; gives samples and truth of the mapped legs.

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
        self.skipped = 0
        self.lost = 0
        self.types = {}
        self.notes = ()

    @property
    def about(self) -> dict[str, str]:
        """Empty: a bag does not say which robot it is of."""
        return {}

    def __iter__(self) -> Iterator[Record]:
        self.damage, self.skipped, self.lost = None, 0, 0
        self.types, self.notes = {}, ()
        complaints = Complaints()

        def complain(topic: str, reason: Reason, detail: str) -> None:
            complaints.take(topic, reason, detail, 0.0)

        intake = Intake(self._robot, 1, complain)
        topics = intake.topics(truth=True)
        decode = self._cdr.Types(self._robot.ros2.distro if self._robot.ros2 else "jazzy").decode
        for message in self._messages():
            if message.topic not in topics:
                continue
            content = intake.read(
                decode, message.topic, message.type, message.hash, _unpacked(message.payload)
            )
            if content is None:
                continue
            origin = Origin(b"", None, message.time_ns)
            for leg, made in intake.take(message.topic, message.type, content, origin):
                key = truth_key(leg) if isinstance(made, ContactTruth) else servo_key(leg)
                payload = encode(made, MSGPACK)
                yield Record(key, payload, MSGPACK, message.time_ns, message.time_ns)
        self.notes = (*self._missing(topics), *complaints.lines())

    def _missing(self, topics: dict[str, tuple[str, ...]]) -> Iterator[str]:
        """A line for each mapped topic that the bag lacks."""
        for topic, types in topics.items():
            if topic not in self.types:
                like = [name for name, (kind, _) in self.types.items() if kind in types]
                there = like or list(self.types)
                some = ", ".join(there[:_SHOWN]) + (", …" if len(there) > _SHOWN else "")
                of = "such topics are" if like else "there are"
                yield f"no topic {topic} in the bag; {of} {some or 'none'}: correct robot.toml"

    # -- files -------------------------------------------------------------------------------------

    def _find_files(self) -> list[Path]:
        """Files of the bag in their order; the folder itself where rosbags is to read it."""
        path = self.path
        if not path.exists():
            raise RecordingError(f"{path}: cannot be read (no such file); give a bag")
        files = sorted((*path.glob("*.mcap"), *path.glob("*.db3")), key=_number)
        described = (path / "metadata.yaml").is_file()
        old = sorted(path.glob("*.bag*")) if path.is_dir() else [path]
        for file in () if files or described else filter(_is_ros_1, old):
            raise RecordingError(
                f"{file}: a bag of ROS 1; convert it with `rosbags-convert --src {file} --dst DIR`"
            )
        if path.suffix == ".zstd":
            raise RecordingError(
                f"{path}: compressed as a whole; give the folder of the bag, which has a "
                "metadata.yaml, or unpack the file with `zstd -d`"
            )
        if not path.is_dir():
            return [path]
        if described and not any(file.suffix == ".mcap" for file in files):
            return [path]
        return files or [path]

    def _messages(self) -> Iterator[_Message]:
        for file in self._files:
            yield from self._walked(file) if file.suffix == ".mcap" else self._by_rosbags(file)

    def _walked(self, path: Path) -> Iterator[_Message]:
        recording = Recording(path)
        for record in recording:
            kind, hash_ = recording.types.get(record.key, ("", ""))
            yield _Message(record.key, kind, hash_, record.log_time_ns, record.payload)
        self.types |= recording.types
        self._note_damage(path, recording.damage)
        self.skipped += recording.skipped
        self.lost += recording.lost

    def _by_rosbags(self, path: Path) -> Iterator[_Message]:
        """Messages of a db3 file or of a folder with its metadata."""
        import apsw
        from rosbags.rosbag2 import Reader, ReaderError

        troubles = (ReaderError, apsw.Error, OSError, ValueError, KeyError)
        given = 0
        with contextlib.ExitStack() as stack:
            try:
                reader = stack.enter_context(Reader(path))
                self.types |= {c.topic: (c.msgtype, c.digest) for c in reader.connections}
            except troubles as error:
                raise RecordingError(
                    f"{path}: cannot be read as a bag ({_one_line(error)}); give a folder that "
                    "`ros2 bag record` wrote, or a file of it"
                ) from error
            try:
                for connection, time_ns, payload in reader.messages():
                    given += 1
                    hash_ = connection.digest
                    yield _Message(connection.topic, connection.msgtype, hash_, time_ns, payload)
            except troubles as error:
                self._note_damage(
                    path, f"{_one_line(error)}; the {given} messages before it are intact"
                )

    def _note_damage(self, path: Path, damage: str | None) -> None:
        if damage is not None:
            which = "" if path == self.path else f"{path.name}: "
            self.damage = f"{which}{damage}" if self.damage is None else self.damage


def _is_ros_1(path: Path) -> bool:
    with contextlib.suppress(OSError), path.open("rb") as file:
        return file.read(len(ROS_1)) == ROS_1
    return False


def _unpacked(payload: bytes) -> bytes:
    """Unpack a message of ``ros2 bag record --compression-mode message``."""
    if payload.startswith(_ZSTD):
        with contextlib.suppress(zstandard.ZstdError):
            return zstandard.ZstdDecompressor().stream_reader(payload).read(_MOST_BYTES)
    return payload


def _number(path: Path) -> tuple[int, str]:
    """Order of a bag's files: ``walk_2.mcap`` comes before ``walk_10.mcap``."""
    digits = re.search(r"(\d+)$", path.stem)
    return (int(digits[1]) if digits else 0, path.name)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
