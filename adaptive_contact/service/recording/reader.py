"""Reads a recording from the front; damage is skipped and counted, memory is bounded.

An MCAP file is a row of records ``opcode u8, length u64, content``, little endian; a message is
``channel u16, sequence u32, log_time u64, publish_time u64, data``.  The walk is done here rather
than by mcap's readers, which want the index at the end of a file or raise in the middle of a cut
one, take several times as long, and unpack a chunk to whatever size its data say.

- A chunk whose checksum or content is wrong costs its own messages; the walk goes on behind it.
- A record whose opcode or length is wrong costs everything up to the next chunk, which is found by
  the two lengths in its head that must agree.
- Channels that a lost chunk defined are taken from the summary at the end of the file.

Reference: https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import os
import re
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
from mcap.records import Channel, Metadata, Schema
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
_MAX_COMPRESSION_NAME: Final = 16

_FRAME: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_INDEX: Final = struct.Struct("<HI")
_CHUNK: Final = struct.Struct("<QQQII")  # times, unpacked size, checksum, length of compression
_LENGTH: Final = struct.Struct("<Q")
_CHUNK_HEAD_BYTES: Final = _CHUNK.size + _MAX_COMPRESSION_NAME + _LENGTH.size  # at most
_FOOTER: Final = struct.Struct("<BQQQI")

# What a data section may hold; any other opcode below 0x80 (private records) is damage.
_DATA_SECTION: Final = frozenset(
    {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK}
    | {Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END}
)
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
        self.skipped = 0  # damaged places that the last pass stepped over
        self.lost = 0  # messages that are known to have been in them
        with self._open():
            pass

    @property
    def truncated(self) -> bool:
        """Return whether the last pass met a cut or damage; all intact messages were yielded."""
        return self.damage is not None

    @property
    def about(self) -> dict[str, str]:
        """Return what the writer noted (scenario, seed); empty for files of other tools."""
        with self._open() as file:
            head = file.read(_FRAME.size)
            while len(head) == _FRAME.size:
                opcode, length = _FRAME.unpack(head)
                if opcode not in (Opcode.HEADER, Opcode.METADATA) or length > (1 << 20):
                    break
                content = file.read(length)
                try:
                    found = Metadata.read(ReadDataStream(BytesIO(content)))
                except _PARSE_ERRORS:  # a damaged header; reported when messages are read
                    found = None
                if opcode == Opcode.METADATA and found is not None and found.name == ABOUT:
                    return {k: text for k, text in found.metadata.items() if k != "v"}
                head = file.read(_FRAME.size)
        return {}

    def __iter__(self) -> Iterator[Record]:
        self.damage, self.skipped, self.lost = None, 0, 0
        given = 0
        with self._open() as file:
            walk = _Walk(file, self.types)
            for record in walk.records():
                given += 1
                yield record
        self.damage = walk.report(given)
        self.skipped, self.lost = walk.skipped, walk.lost

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
        # skipped, lost: as of `Recording`
        self.skipped = 0
        self.lost = 0
        self._file = file
        self._size = os.fstat(file.fileno()).st_size
        self._at = file.tell()
        self._sure = self._at  # end of the last record whose length was proven
        self._channels: _Channels = {}
        self._chunked = False
        self._first = ""  # what is wrong at the first damaged place
        self._cut: str | None = None
        self._may_unpack = max(MAX_CHUNK_BYTES, MAX_RATIO * self._size)
        # A chunk comes before its index of messages.  None if none came, else whether it could be
        # used: this detects a chunk whose opcode was flipped.
        self._chunk_used: bool | None = None

    def report(self, given: int) -> str | None:
        """Describe in one line the damage that was met; None for a file that is whole."""
        if not self.skipped:
            return self._cut and f"{self._cut}; the {given} messages before it are intact"
        places = "1 damaged place" if self.skipped == 1 else f"{self.skipped} damaged places"
        lost = f" with {self.lost} messages" if self.lost else ""
        line = f"{places}{lost} stepped over, {self._first}; {given} messages are intact"
        return line if self._cut is None else f"{line}; {self._cut}"

    def records(self) -> Iterator[Record]:
        while True:
            self._file.seek(self._at)
            head = self._file.read(_FRAME.size)
            if len(head) < _FRAME.size:
                self._cut = f"cut at byte {self._size}"
                return
            opcode, length = _FRAME.unpack(head)
            end = self._at + _FRAME.size + length
            if end > self._size:
                yield from self._beyond(opcode, length)
                if not self._find_chunk():
                    inside = ", inside a chunk" if opcode == Opcode.CHUNK else ""
                    self._cut = f"cut at byte {self._size}{inside}"
                    return
                self._skip(self._at, "a length is wrong")
                continue
            if opcode == Opcode.DATA_END and length == 4:
                self._file.seek(max(self._size - len(MCAP0_MAGIC), end))
                if self._file.read() != MCAP0_MAGIC:
                    self._cut = f"cut at byte {self._size}, inside the index"
                elif self._is_followed(end):
                    self._cut = "another recording is appended, which is not read"
                return
            wrong = self._framing(opcode, length)
            if wrong is not None:
                self._skip(self._at, wrong)
                if not self._find_chunk():
                    return
                continue
            yield from self._record(opcode, length)
            self._at = end
            # Records that say their length twice; in a file without chunks, messages are gone
            # through in order.
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.MESSAGE):
                self._sure = end

    def _is_followed(self, at: int) -> bool:
        """Return whether another file follows the footer, as where `cat` joined recordings."""
        opcode = Opcode.DATA_END
        while opcode and opcode != Opcode.FOOTER:
            head = os.pread(self._file.fileno(), _FRAME.size, at).ljust(_FRAME.size, b"\0")
            opcode, length = _FRAME.unpack(head)
            at = min(at + _FRAME.size + length, self._size)
        return os.pread(self._file.fileno(), 2 * len(MCAP0_MAGIC), at) == 2 * MCAP0_MAGIC

    def _record(self, opcode: int, length: int) -> Iterator[Record]:
        """Yield the messages of one record whose frame is sound; the file is at its content."""
        if opcode == Opcode.CHUNK:
            self._chunked = True
            self._chunk_used = False
            try:
                yield from self._unpacked(self._unpack(length))
                self._chunk_used = True
            except _DamagedError as damage:
                self._skip(self._at, str(damage))
                self._learn_channels()
        elif opcode == Opcode.MESSAGE_INDEX:
            self._count_index(length)
        else:
            self._chunk_used = None
            # In a file without chunks; in another, an index whose opcode was flipped.
            known = (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA)
            if opcode in known and not self._chunked:
                try:
                    head = _FRAME.pack(opcode, length)
                    yield from self._unpacked(head + self._file.read(length))
                except _DamagedError as damage:
                    self._skip(self._at, str(damage))

    def _framing(self, opcode: int, length: int) -> str | None:
        """Return what contradicts a record's opcode and length; None where nothing does."""
        if (opcode < _PRIVATE and opcode not in _DATA_SECTION) or opcode == Opcode.DATA_END:
            return "no record begins there"
        if opcode == Opcode.MESSAGE and (self._chunked or length > MAX_CHUNK_BYTES):
            return "no message can be there"
        if opcode == Opcode.CHUNK and not _is_chunk(self._peek(_CHUNK_HEAD_BYTES), length):
            return "the lengths of a chunk disagree"
        if opcode == Opcode.MESSAGE_INDEX:
            head = self._peek(_INDEX.size)
            if len(head) < _INDEX.size or length != _INDEX.size + _INDEX.unpack(head)[1]:
                return "the lengths of an index disagree"
        return None

    def _count_index(self, length: int) -> None:
        """Count the lost messages of a damaged or missing chunk by its index."""
        if self._chunk_used is None:
            self._skip(self._at, "a chunk is missing before it")
            self._chunk_used = False
            self._learn_channels()
        if not self._chunk_used:
            self.lost += (length - _INDEX.size) // 16

    def _beyond(self, opcode: int, length: int) -> Iterator[Record]:
        """Yield messages of a record that ends beyond the file: of a plain chunk, up to the cut."""
        if opcode != Opcode.CHUNK or not _is_chunk(self._peek(_CHUNK_HEAD_BYTES), length):
            return
        content = self._file.read(MAX_CHUNK_BYTES)
        if _CHUNK.unpack_from(content)[4] == 0:  # not compressed
            self._chunked = True
            with contextlib.suppress(_DamagedError):  # the cut itself
                yield from self._unpacked(content[_CHUNK.size + _LENGTH.size :])

    def _skip(self, at: int, why: str) -> None:
        self.skipped += 1
        if not self._first:
            self._first = f"the first at byte {at} ({why})"

    def _peek(self, count: int) -> bytes:
        """Return the next bytes of the content without moving on."""
        here = self._file.tell()
        head = self._file.read(count)
        self._file.seek(here)
        return head

    def _find_chunk(self) -> bool:
        """Move to the next place where a chunk begins; False where there is none.

        The length that led here may be the wrong one, so the search begins where all is proven.
        """
        self._chunk_used = None
        here = self._at
        base, kept = (self._sure if self._sure < self._at else self._at + 1), b""
        self._file.seek(base)
        while block := self._file.read(1 << 20):
            data = kept + block
            # Where a chunk of less than 4 GB may begin, overlapping places too.
            for match in re.finditer(rb"(?=\x06[\s\S]{4}\x00{4})", data):
                at = base - len(kept) + match.start()
                head = os.pread(self._file.fileno(), _FRAME.size + _CHUNK_HEAD_BYTES, at)
                if at != here and _is_chunk(head[_FRAME.size :], _FRAME.unpack_from(head)[1]):
                    self._at = self._sure = at  # the next search begins behind it
                    self._learn_channels()
                    return True
            kept = data[-(_FRAME.size - 1) :]
            base += len(block)
        return False

    def _unpack(self, length: int) -> bytes:
        """Unpack the records of the chunk whose content is next."""
        if length > MAX_CHUNK_BYTES + _CHUNK_HEAD_BYTES:
            raise _DamagedError(f"a chunk of {length >> 20} MB, at most {MAX_CHUNK_BYTES >> 20}")
        content = self._file.read(length)
        _, _, size, checksum, name_bytes = _CHUNK.unpack_from(content)
        name = content[_CHUNK.size : _CHUNK.size + name_bytes]
        packed = memoryview(content)[_CHUNK.size + name_bytes + _LENGTH.size :]
        if size > MAX_CHUNK_BYTES:
            raise _DamagedError(
                f"a chunk that unpacks to {size >> 20} MB, at most {MAX_CHUNK_BYTES >> 20}"
            )
        if size > self._may_unpack:
            raise _DamagedError(f"chunks that unpack to more than {MAX_RATIO} times the file")
        try:
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
        at, unknown = 0, 0
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
                    elif number not in self._channels:
                        unknown += 1
                elif kind == Opcode.CHANNEL:
                    self._learn_channel(data[at : at + length])
                elif kind == Opcode.SCHEMA:
                    self._learn_schema(data[at : at + length])
                elif kind < _PRIVATE:
                    raise _DamagedError("no record begins inside a chunk")
            except _PARSE_ERRORS as error:
                raise _DamagedError(f"{type(error).__name__} in a chunk") from error
            at += length
            if record is not None:
                yield record
        if unknown:
            self.lost += unknown
            raise _DamagedError("messages of a channel that is not defined")

    def _learn_channels(self) -> None:
        """Restore from the summary channels lost by damage, if the summary is whole."""
        footer_bytes = _FOOTER.size + len(MCAP0_MAGIC)
        tail = os.pread(self._file.fileno(), footer_bytes, max(self._size - footer_bytes, 0))
        if len(tail) < footer_bytes or tail[_FOOTER.size :] != MCAP0_MAGIC:
            return
        opcode, _, start, _, checksum = _FOOTER.unpack_from(tail)
        length = self._size - footer_bytes - start
        # Of the summary at the end of a file, of metadata.
        if opcode != Opcode.FOOTER or not 0 < length <= (64 << 20):
            return
        summary = os.pread(self._file.fileno(), length, start)
        if checksum not in (0, zlib.crc32(summary + tail[: _FOOTER.size - 4])):
            return
        at = 0
        while at + _FRAME.size <= len(summary):
            kind, size = _FRAME.unpack_from(summary, at)
            at += _FRAME.size
            try:
                if kind == Opcode.CHANNEL:
                    self._learn_channel(summary[at : at + size])
                elif kind == Opcode.SCHEMA:
                    self._learn_schema(summary[at : at + size])
            except _PARSE_ERRORS:
                return
            at += size

    def _learn_channel(self, content: bytes) -> None:
        """Store a channel: its key, its Zenoh encoding, its type."""
        found = Channel.read(ReadDataStream(BytesIO(content)))
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

    def _learn_schema(self, content: bytes) -> None:
        found = Schema.read(ReadDataStream(BytesIO(content)))
        self._schemas[found.id] = (found.name, found.data)


def _is_chunk(head: bytes, length: int) -> bool:
    """Return whether the lengths at the head of a chunk agree with the length of its record."""
    if len(head) < _CHUNK.size:
        return False
    name = _CHUNK.unpack_from(head)[4]
    if name > _MAX_COMPRESSION_NAME or len(head) < _CHUNK.size + name + _LENGTH.size:
        return False
    inner = _LENGTH.unpack_from(head, _CHUNK.size + name)[0]
    return bool(length == _CHUNK.size + name + _LENGTH.size + inner)
