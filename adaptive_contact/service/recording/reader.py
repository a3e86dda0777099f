"""Reading a recording from the front, up to its end or its first damage.

An MCAP file is a row of records ``opcode u8, length u64, content``, little endian; a message is
``channel u16, sequence u32, log_time u64, publish_time u64, data``.  The walk is done here rather
than by mcap's readers, which want the index at the end of a file or raise in the middle of a cut
one, and take several times as long.

Reference: https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Final

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from adaptive_contact.errors import RecordingError
from adaptive_contact.service.recording.format import ABOUT, ENCODING, TO_ZENOH, Record

__all__ = ["Recording", "read_recording"]

# No honest record is larger; a length beyond it is damage, not a reason to allocate.
MAX_RECORD_BYTES: Final = 1 << 30

_FRAME: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_INDEX: Final = struct.Struct("<HI")

# What a data section may hold; any other opcode below 0x80 (private records) is damage.
_DATA_SECTION: Final = frozenset(
    {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK}
    | {Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END}
)

# What the parsers of mcap, zstandard and lz4 (RuntimeError) raise on damaged bytes; ValueError is
# also the base of Unicode and checksum errors.
_PARSE_ERRORS: Final = (
    *(McapError, ValueError, struct.error, zstandard.ZstdError),
    *(RuntimeError, EOFError, MemoryError, OverflowError),
)


class Recording:
    """A recording to iterate over, as often as wanted, in the file's order.

    Attributes:
        path: the file.
        damage: None, or one line saying where and why the last pass over it stopped early.

    Raises:
        RecordingError: the file cannot be read, or is no recording.  Damage inside never raises.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage: str | None = None
        with self._open():
            pass

    @property
    def truncated(self) -> bool:
        """Whether the last pass met a cut or damage; what came before it was given out."""
        return self.damage is not None

    @property
    def about(self) -> dict[str, str]:
        """What the writer said of it (scenario, seed); empty for files of other tools."""
        # Damage this early also ends every pass over the messages, and is told there.
        with self._open() as file, contextlib.suppress(_DamagedError, *_PARSE_ERRORS):
            for opcode, content in _frames(file):
                if opcode == Opcode.METADATA:
                    found = Metadata.read(ReadDataStream(BytesIO(content)))
                    if found.name == ABOUT:
                        return {k: text for k, text in found.metadata.items() if k != "v"}
                elif opcode != Opcode.HEADER:
                    break
        return {}

    def __iter__(self) -> Iterator[Record]:
        self.damage = None
        channels: dict[int, tuple[str, str]] = {}
        given = 0
        with self._open() as file:
            try:
                for opcode, content in _frames(file):
                    for record in _records(opcode, content, channels):
                        given += 1
                        yield record
            except _DamagedError as damage:
                self.damage = f"{damage}; the {given} messages before it are intact"

    def _open(self) -> IO[bytes]:
        """Open the file and step over its magic."""
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise RecordingError(
                f"{self.path}: cannot be read ({error.strerror}); give the path of a recording"
            ) from error
        start = file.read(len(MCAP0_MAGIC))
        if start != MCAP0_MAGIC:
            file.close()
            found = "is empty" if not start else "is not a recording"
            raise RecordingError(
                f"{self.path}: {found}; expected an MCAP file, as 'adaptive-contact record' writes"
            )
        return file


def read_recording(path: str | Path) -> Recording:
    """Open a recording for reading.

    Args:
        path: an MCAP file.

    Returns:
        An iterable of :class:`Record`, with ``truncated`` and ``damage`` after a pass over it.

    Raises:
        RecordingError: the file cannot be read, or is no recording.
    """
    return Recording(path)


class _DamagedError(Exception):
    """The walk over a file cannot go on; the text says where and why."""


def _frames(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record of the data section; the file is past its magic.

    A flipped opcode would make the walk step over a chunk without a word, so the order of records
    is checked too: an index of messages stands behind its chunk, and the section's end is 4 bytes.
    """
    size = os.fstat(file.fileno()).st_size
    at = file.tell()
    indexed = False  # whether an index of messages may come now
    while True:
        head = file.read(_FRAME.size)
        if len(head) < _FRAME.size:
            raise _DamagedError(f"cut at byte {size}")
        opcode, length = _FRAME.unpack(head)
        if (opcode < 0x80 and opcode not in _DATA_SECTION) or length > MAX_RECORD_BYTES:
            raise _DamagedError(f"damaged at byte {at}: no record begins there")
        content = file.read(length)
        at += _FRAME.size + len(content)
        if len(content) < length:
            if opcode == Opcode.CHUNK and _is_plain(content):
                yield opcode, content  # its messages can be read up to the cut
            raise _DamagedError(f"cut at byte {size}, inside a chunk")
        if opcode == Opcode.DATA_END:
            if length != 4:
                raise _DamagedError(f"damaged at byte {at}: no record ends there")
            file.seek(max(size - len(MCAP0_MAGIC), at))
            if file.read() != MCAP0_MAGIC:
                raise _DamagedError(f"cut at byte {size}, inside the index")
            return
        if opcode == Opcode.MESSAGE_INDEX and not (indexed and _is_index(content)):
            raise _DamagedError(f"damaged at byte {at}: a chunk is missing before it")
        yield opcode, content
        indexed = opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX)


def _is_index(content: bytes) -> bool:
    """Whether the length of an index of messages is what its own count says."""
    return len(content) >= _INDEX.size and (
        len(content) == _INDEX.size + _INDEX.unpack_from(content)[1]
    )


def _records(opcode: int, content: bytes, channels: dict[int, tuple[str, str]]) -> Iterator[Record]:
    """Messages of one record of the data section; fills ``channels`` on the way."""
    if opcode == Opcode.CHUNK:
        data = _inflate(content)
    elif opcode in (Opcode.MESSAGE, Opcode.CHANNEL):  # a file without chunks
        data = _FRAME.pack(opcode, len(content)) + content
    else:
        return
    at = 0
    while at < len(data):
        try:
            kind, length = _FRAME.unpack_from(data, at)
            at += _FRAME.size
            if length > len(data) - at:
                raise _DamagedError("cut inside a message")
            if kind == Opcode.MESSAGE:
                channel, _, log_ns, sent_ns = _MESSAGE.unpack_from(data, at)
                payload = data[at + _MESSAGE.size : at + length]
                key, encoding = channels[channel]
                record = Record(key, payload, encoding, log_ns, sent_ns)
            elif kind == Opcode.CHANNEL:
                found = Channel.read(ReadDataStream(BytesIO(data[at : at + length])))
                named = TO_ZENOH.get(found.message_encoding, found.message_encoding)
                channels[found.id] = (found.topic, found.metadata.get(ENCODING, named))
        except KeyError as error:
            raise _DamagedError(f"damaged: a message of an unknown channel {error}") from error
        except _PARSE_ERRORS as error:
            raise _DamagedError(f"damaged: {type(error).__name__} in a chunk") from error
        at += length
        if kind == Opcode.MESSAGE:
            yield record


def _is_plain(content: bytes) -> bool:
    """Whether a chunk is not compressed: its compression is the empty string, at byte 28."""
    return content[28:32] == bytes(4)


def _inflate(content: bytes) -> bytes:
    """The records inside a chunk; of a cut one that is not compressed, what there is of them."""
    try:
        chunk: Chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        if chunk.uncompressed_size > MAX_RECORD_BYTES:
            raise _DamagedError("damaged: the size of a chunk is impossible")
        if not chunk.compression and len(chunk.data) < chunk.uncompressed_size:
            return chunk.data  # no checksum can be made of a part
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        records: bytes = stream.read(size)
        return records
    except _PARSE_ERRORS as error:
        raise _DamagedError(f"damaged: {type(error).__name__} in a chunk") from error
