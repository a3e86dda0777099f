"""Reads a recording from the front; a damaged chunk is skipped and counted, memory is bounded.

An MCAP file is a row of records ``opcode u8, length u64, content``, little endian; a message is
``channel u16, sequence u32, log_time u64, publish_time u64, data``.  The walk is done here rather
than by mcap's readers, which want the index at the end of a file or raise in the middle of a cut
one, take several times as long, and unpack a chunk to whatever size its data say.

- A chunk whose checksum or content is wrong costs its own messages; the walk goes on behind it.
- Behind a record whose length is wrong nothing is read: ``mcap recover`` finds the next chunk.
- Channels that a lost chunk defined are taken from the summary at the end of the file.

Reference: https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Final

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Header, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from adaptive_contact.errors import RecordingError
from adaptive_contact.service.recording.format import ABOUT, ENCODING, PROTOBUF, TO_ZENOH, Record
from adaptive_contact.service.recording.schemas import kind_of_key, protobuf_reader, schema_name
from adaptive_contact.wire import MSGPACK

# Of a chunk, packed and unpacked.  Writers make chunks of 32 kB (ours) to a few MB.
MAX_CHUNK_BYTES: Final = 64 << 20
# All chunks together may unpack to this many times the file, or to one chunk of the largest size.
# Recordings of robots are packed 2 to 20 times; 262 kB of repeated bytes would unpack to gigabytes.
MAX_RATIO: Final = 200

_FRAME: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_CHUNK: Final = struct.Struct("<QQQII")  # times, unpacked size, checksum, length of compression
_LENGTH_BYTES: Final = 8

_KNOWN: Final = frozenset(opcode.value for opcode in Opcode)
_PRIVATE: Final = 0x80

# What the parsers of mcap, zstandard and lz4 (RuntimeError) raise on damaged bytes; ValueError is
# also the base of Unicode errors.
_PARSE_ERRORS: Final = (
    *(McapError, ValueError, struct.error, zstandard.ZstdError),
    *(RuntimeError, EOFError, MemoryError, OverflowError),
)


# By channel: its key, its Zenoh encoding, and what turns its payloads into the wire's; None for a
# channel of no key.
_Convert = Callable[[bytes], bytes]
_Channels = dict[int, tuple[str, str, _Convert | None] | None]
# By key: name of the channel's schema, and its hash or an empty text.
Types = dict[str, tuple[str, str]]


class Recording:
    """Iterates over a recording, as often as wanted, in the file's order.

    Raises:
        RecordingError: the file cannot be read, or is no recording.  Damage inside never raises.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)  # the file
        # of each key that the last pass has met, the name of its schema and the hash of its type,
        # as rosbag2 writes them; empty texts where there are none
        self.types: Types = {}
        # what a person should know of the last pass, a line each; empty but for bags
        self.notes: tuple[str, ...] = ()
        # None, or one line on what the last pass stepped over and where it stopped
        self.damage: str | None = None
        self._open().close()

    @property
    def about(self) -> dict[str, str]:
        """Return what the writer noted (scenario, seed); empty for files of other tools."""
        with self._open() as file, contextlib.suppress(*_PARSE_ERRORS):
            reader = StreamReader(file, True, True, record_size_limit=1 << 20)
            for record in reader.records:
                if isinstance(record, Metadata) and record.name == ABOUT:
                    return {k: text for k, text in record.metadata.items() if k != "v"}
                if not isinstance(record, Header | Metadata):
                    break
        return {}

    def __iter__(self) -> Iterator[Record]:
        self.damage, given = None, 0
        with self._open() as file:
            walk = _Walk(file, self.types)
            for record in walk.records():
                given += 1
                yield record
            self.damage = walk.report(given)

    def _open(self) -> IO[bytes]:
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(
                f"{self.path}: cannot be read ({error.strerror}); give the path of a recording"
            ) from error
        start = file.read(len(MCAP0_MAGIC))
        if start != MCAP0_MAGIC or not file.seekable():
            file.close()
            found = "is empty" if not start else "is not a recording"
            if start == MCAP0_MAGIC:
                found = "cannot be read twice"
            raise RecordingError(
                f"{self.path}: {found}; expected an MCAP file, as 'adaptive-contact record' writes"
            )
        return file


class _DamagedError(Exception):
    """Reports that a chunk cannot be used, and why."""


class _Walk:
    """Reads a file once, from behind its magic."""

    def __init__(self, file: IO[bytes], types: Types) -> None:
        self._types = types
        self._schemas: dict[int, tuple[str, bytes]] = {}
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._channels: _Channels = {}
        self._chunked = False
        self._messages = 0  # read, those for viewers too
        self._skipped: list[str] = []  # what is wrong with each chunk that was stepped over
        self._end: str | None = None  # why the walk ended before the end of a sound file
        self._may_unpack = max(MAX_CHUNK_BYTES, MAX_RATIO * self._size)

    def report(self, given: int) -> str | None:
        """Describe in one line the damage that was met; None for a file that is whole."""
        if not self._skipped:
            return self._end and f"{self._end}; the {given} messages before it are intact"
        places = "damaged place" if len(self._skipped) == 1 else "damaged places"
        line = f"{len(self._skipped)} {places} stepped over, the first {self._skipped[0]}"
        return "; ".join(filter(None, (line, f"{given} messages are intact", self._end)))

    def records(self) -> Iterator[Record]:
        opcode = None
        while opcode != Opcode.FOOTER:
            at = self._file.tell()
            head = self._file.read(_FRAME.size)
            if len(head) < _FRAME.size:
                self._end = f"cut at byte {self._size}"
                return
            opcode, length = _FRAME.unpack(head)
            end = at + _FRAME.size + length
            if end > self._size or (opcode < _PRIVATE and opcode not in _KNOWN):
                self._end = f"damaged at byte {at}, or cut at byte {self._size}"
                return
            try:
                yield from self._record(opcode, length)
            except _DamagedError as damage:
                self._skipped.append(f"at byte {at} ({damage})")
                self._learn_channels()
            self._file.seek(end)
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            self._end = f"cut at byte {self._size}"
        elif self._file.read(1):
            self._end = "another recording is appended, which is not read"
        elif not self._skipped and self._messages < self._learn_channels():
            self._end = "damaged: messages are missing that its summary counts"

    def _record(self, opcode: int, length: int) -> Iterator[Record]:
        """Yield the messages of one record; the file is at its content."""
        if opcode == Opcode.CHUNK:
            self._chunked = True
            yield from self._unpacked(self._unpack(length))
        # In a file without chunks; in another, an index whose opcode was flipped.
        elif opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA) and not self._chunked:
            if length > MAX_CHUNK_BYTES:
                raise _DamagedError(f"a message of {length >> 20} MB")
            yield from self._unpacked(_FRAME.pack(opcode, length) + self._file.read(length))

    def _unpack(self, length: int) -> bytes:
        """Unpack the records of the chunk whose content is next."""
        if length > MAX_CHUNK_BYTES:
            raise _DamagedError(f"a chunk of {length >> 20} MB, at most {MAX_CHUNK_BYTES >> 20}")
        content = self._file.read(length)
        try:
            _, _, size, checksum, name_bytes = _CHUNK.unpack_from(content)
            name = content[_CHUNK.size : _CHUNK.size + name_bytes]
            packed = memoryview(content)[_CHUNK.size + name_bytes + _LENGTH_BYTES :]
            if size > MAX_CHUNK_BYTES:
                raise _DamagedError(
                    f"a chunk that unpacks to {size >> 20} MB, at most {MAX_CHUNK_BYTES >> 20}"
                )
            if size > self._may_unpack:
                raise _DamagedError(f"chunks that unpack to more than {MAX_RATIO} times the file")
            if name == b"zstd":
                unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
                data = unpacker.stream_reader(packed).read(size + 1)
            elif name == b"lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
            elif not name:
                data = bytes(packed)
            else:
                raise _DamagedError("a compression that is unknown")
        except _PARSE_ERRORS as error:
            raise _DamagedError("a chunk cannot be unpacked") from error
        self._may_unpack -= len(data)
        if len(data) != size:
            more = "more" if len(data) > size else "less"
            raise _DamagedError(f"a chunk unpacks to {more} than it says")
        if checksum not in (0, zlib.crc32(data)):
            raise _DamagedError("the checksum of a chunk is wrong")
        return data

    def _unpacked(self, data: bytes) -> Iterator[Record]:
        """Yield the messages among unpacked records; channels are learned on the way."""
        at, unknown = 0, False
        while at < len(data):
            record = None
            try:
                kind, length = _FRAME.unpack_from(data, at)
                at += _FRAME.size
                if length > len(data) - at:
                    raise _DamagedError("a chunk is cut inside a message")
                if kind == Opcode.MESSAGE:
                    if length < _MESSAGE.size:
                        raise _DamagedError("a message is too short")
                    number, _, log_ns, sent_ns = _MESSAGE.unpack_from(data, at)
                    channel = self._channels.get(number)
                    if channel is not None:
                        key, encoding, convert = channel
                        payload = data[at + _MESSAGE.size : at + length]
                        if convert is not None:
                            payload = convert(payload)
                        record = Record(key, payload, encoding, log_ns, sent_ns)
                    unknown |= number not in self._channels
                    self._messages += 1
                elif kind == Opcode.CHANNEL:
                    self._learn_channel(Channel.read(_stream(data[at : at + length])))
                elif kind == Opcode.SCHEMA:
                    self._learn_schema(Schema.read(_stream(data[at : at + length])))
                elif kind < _PRIVATE:
                    raise _DamagedError("no record begins inside a chunk")
            except _PARSE_ERRORS as error:
                raise _DamagedError(f"{type(error).__name__} in a chunk") from error
            at += length
            if record is not None:
                yield record
        if unknown:
            raise _DamagedError("messages of a channel that is not defined")

    def _learn_channels(self) -> int:
        """Learn channels lost by damage from the summary; return how many messages that counts."""
        here, count = self._file.tell(), 0
        self._file.seek(0)
        with contextlib.suppress(*_PARSE_ERRORS, OSError):
            summary = SeekingReader(self._file, record_size_limit=1 << 20).get_summary()
            if summary is not None:
                count = summary.statistics.message_count if summary.statistics else 0
                for schema in summary.schemas.values():
                    self._learn_schema(schema)
                for channel in summary.channels.values():
                    self._learn_channel(channel)
        self._file.seek(here)
        return count

    def _learn_channel(self, found: Channel) -> None:
        """Store a channel: its key, its Zenoh encoding, its type."""
        encoding = TO_ZENOH.get(found.message_encoding, found.message_encoding)
        kind, descriptors = self._schemas.get(found.schema_id, ("", b""))
        # Metadata of a channel of rosbag2: the hash of its type's definition.
        self._types[found.topic] = (kind, found.metadata.get("topic_type_hash", ""))
        message = kind_of_key(found.topic)
        convert = None
        # What the file holds for viewers only.
        if encoding == PROTOBUF and kind.startswith("foxglove."):
            self._channels[found.id] = None
            return
        if encoding == PROTOBUF and message is not None and kind == schema_name(message):
            convert, encoding = protobuf_reader(message, descriptors), MSGPACK
        self._channels[found.id] = (found.topic, found.metadata.get(ENCODING, encoding), convert)

    def _learn_schema(self, found: Schema) -> None:
        self._schemas[found.id] = (found.name, found.data)


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
