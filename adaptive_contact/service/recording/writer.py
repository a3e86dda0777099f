"""Writes a recording: any key, any bytes, in small chunks.

A message of the contract is written as protobuf; what is none keeps its bytes.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, Self

from mcap.writer import CompressionType, Writer

from adaptive_contact.errors import RecordingError, reason_of
from adaptive_contact.service.recording.format import ABOUT, ENCODING, PROTOBUF, TO_MCAP, TO_ZENOH
from adaptive_contact.service.recording.schemas import kind_of_key, protobuf_class, schema_name
from adaptive_contact.wire import MSGPACK, Message, Rejected, decode, encode

if TYPE_CHECKING:
    from adaptive_contact.service.recording.scene import Scene

# A slow stream fills no chunk; it is written out once its oldest message is this old (log time).
FLUSH_NS: Final = 1_000_000_000
MAX_TIME_NS: Final = (1 << 64) - 1
MAX_CHANNELS: Final = (1 << 16) - 1


class RecordingWriter:
    """Write a recording.  A context manager; not for several threads at once.

    Args:
        path: the file; an old one of that name is replaced.
        about: what the recording is of (scenario, seed, robot), kept in the file as text.
        scene: draws the robot, as topics of their own.

    Raises:
        RecordingError: the file cannot be written; also from every method.
    """

    def __init__(
        self,
        path: str | Path,
        about: Mapping[str, str] | None = None,
        scene: Scene | None = None,
    ) -> None:
        self.path = Path(path)
        self.messages = 0  # without those of the scene
        self._scene = scene
        if scene is not None:
            scene.restart()
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._flush_at: int | None = None
        self._file: IO[bytes] | None = None
        with self._writing():
            # Under its name from the first byte on: a recorder that is killed leaves what it has.
            self._file = self.path.open("wb")
            # 32 kB hold about 200 samples, two thirds of a second of six legs at 50 Hz: small
            # enough that a damaged chunk costs little, large enough that zstd still halves it.
            self._writer = Writer(
                self._file, chunk_size=32 * 1024, compression=CompressionType.ZSTD
            )
            self._writer.start(profile="", library="adaptive-contact")
            self._writer.add_metadata(ABOUT, {"v": "1", **(about or {})})
            self._file.flush()

    def write(
        self,
        key: str,
        payload: bytes,
        encoding: str,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Append one message.

        Args:
            key: Zenoh key.
            payload: any bytes.
            encoding: Zenoh encoding (``application/msgpack``), or MCAP's name of it.
            log_time_ns: when it was seen, ns since any epoch, 0 to 2^64 - 1.
            publish_time_ns: when it was sent; the log time where it is not known.
        """
        sent_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        kind = kind_of_key(key)
        message = None if kind is None else decode(payload, kind, encoding)
        if message is None or isinstance(message, Rejected):
            self._add(key, payload, encoding, log_time_ns, sent_ns)
        else:
            self._add_message(key, message, log_time_ns, sent_ns, (payload, encoding))
        self.messages += 1

    def write_message(self, key: str, message: Message, log_time_ns: int) -> None:
        """Append one message of the wire contract."""
        self._add_message(key, message, log_time_ns, log_time_ns, None)
        self.messages += 1

    def close(self) -> None:
        """Write the last chunk and the index, and close the file.  A second call does nothing."""
        if self._file is None:
            return
        with self._writing():
            self._writer.finish()
            self._file.flush()
            if stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):  # no device can sync
                os.fsync(self._file.fileno())
        self._abandon()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add_message(
        self,
        key: str,
        message: Message,
        log_time_ns: int,
        sent_ns: int,
        original: tuple[bytes, str] | None,
    ) -> None:
        kind = type(message)
        descriptors, to_bytes = protobuf_class(kind)
        try:
            content = to_bytes(message)
        except (ValueError, OverflowError):
            original = (encode(message), MSGPACK) if original is None else original
            self._add(key, *original, log_time_ns, sent_ns)
            return
        self._add(key, content, PROTOBUF, log_time_ns, sent_ns, (schema_name(kind), descriptors))
        if self._scene is not None:
            for topic, drawn, schema in self._scene.update(key, message, log_time_ns):
                self._add(topic, drawn, PROTOBUF, log_time_ns, log_time_ns, schema)

    def _add(
        self,
        key: str,
        payload: bytes,
        encoding: str,
        log_time_ns: int,
        sent_ns: int,
        schema: tuple[str, bytes] | None = None,
    ) -> None:
        if self._file is None:
            raise RecordingError(f"{self.path}: already closed; nothing more can be recorded")
        if not (0 <= log_time_ns <= MAX_TIME_NS and 0 <= sent_ns <= MAX_TIME_NS):
            raise RecordingError(
                f"{self.path}: time {log_time_ns} or {sent_ns} ns on '{key}' does not fit; "
                "expected 0 to 2^64 - 1"
            )
        with self._writing():
            channel = self._channels.get((key, encoding))
            if channel is None:
                channel = self._open_channel(key, encoding, schema)
            self._writer.add_message(channel, log_time_ns, payload, sent_ns)
            if self._flush_at is None:
                self._flush_at = log_time_ns + FLUSH_NS
            elif log_time_ns >= self._flush_at:
                self._writer.flush()
                self._flush_at = log_time_ns + FLUSH_NS

    def _open_channel(self, key: str, encoding: str, schema: tuple[str, bytes] | None) -> int:
        if len(self._channels) >= MAX_CHANNELS:
            raise RecordingError(
                f"{self.path}: more than {MAX_CHANNELS} keys; record a narrower key expression"
            )
        number = 0  # MCAP's "none"
        if schema is not None:
            name, data = schema
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, PROTOBUF, data)
            number = self._schemas[name]
        zenoh_encoding = TO_ZENOH.get(encoding, encoding)
        called = TO_MCAP.get(zenoh_encoding.split(";")[0], zenoh_encoding)
        plain = schema is not None or TO_ZENOH.get(called) == zenoh_encoding
        channel = self._writer.register_channel(
            topic=key,
            message_encoding=called,
            schema_id=number,
            metadata={} if plain else {ENCODING: zenoh_encoding},
        )
        self._channels[key, encoding] = channel
        return channel

    def _abandon(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            # Closing flushes; on a full disk that fails again, and the first failure is reported.
            with contextlib.suppress(OSError):
                file.close()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Report what the disk refuses, and write no more."""
        try:
            yield
        except OSError as error:
            self._abandon()
            raise RecordingError(
                f"{self.path}: cannot be written ({reason_of(error)}); "
                "give a path in a folder that exists, is writable and has room"
            ) from error
