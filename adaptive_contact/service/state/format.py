"""One leg's state as bytes: a header that never changes, a checksum, a msgpack map.

::

    offset  size  what
         0     8  magic, "ACSTATE" and a line feed
         8     2  version of the body, little endian
        10     8  length of the body, bytes
        18    32  SHA-256 of version and body
        50     …  body: msgpack map of Record

Whatever is wrong with a file is said in one line and never raised: a crash may have left
anything, and the service must start all the same.
"""

from __future__ import annotations

import hashlib
import struct
from typing import Any, Final, NamedTuple

import msgpack
import msgspec

__all__ = ["FORMAT", "MAX_BYTES", "Identity", "Record", "Refused", "pack", "unpack"]

# 2: position of the source, so that samples that passed while the service was down are counted.
FORMAT: Final = 2
# A leg's state is about a megabyte; what is larger is no state, and must not fill the memory.
MAX_BYTES: Final = 64 * 1024 * 1024

_MAGIC: Final = b"ACSTATE\n"
_HEAD: Final = struct.Struct("<8sHQ32s")
_VERSION: Final = struct.Struct("<H")


class Identity(msgspec.Struct, frozen=True):
    """What a state belongs to.

    Attributes:
        robot: its name.
        leg: its id.
        library: of candidate terms, ``none`` for a learner that began without a model.
        settings: digest of robot.toml and baseline, see ``settings_digest``.
    """

    robot: str
    leg: str
    library: str
    settings: str


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """A leg's state, and when it was.

    Attributes:
        identity: what it belongs to.
        saved_ns: wall clock, since 1970.
        package: version of this package.
        model_version: in force.
        run, seq: of the last sample the learner used; the run is None where samples
            carry none, the number where none came yet.
        missed_down: samples that passed while the service was down, all times together.
        superseded: runs of older publishers of the leg; none in files from before it was kept.
        body: the learner's own snapshot: numbers, strings, bytes, lists and maps.
    """

    identity: Identity
    saved_ns: int
    package: str
    model_version: int
    run: int | None
    seq: int | None
    missed_down: int = 0
    superseded: tuple[int | None, ...] = ()
    body: dict[str, Any]


class Refused(NamedTuple):
    """A state that is not used, and why, in one line."""

    why: str


def pack(record: Record) -> bytes:
    """Serialise a record.

    Raises:
        TypeError: the body holds something else than numbers, strings, bytes, lists and maps.
    """
    body = msgspec.msgpack.encode(record)
    version = _VERSION.pack(FORMAT)
    digest = hashlib.sha256(version + body).digest()
    return _HEAD.pack(_MAGIC, FORMAT, len(body), digest) + body


def unpack(data: bytes, identity: Identity | None = None) -> Record | Refused:
    """Read a record back, and check that it is whole and wanted.

    Args:
        data: of a file.
        identity: what it must belong to; None takes any.
    """
    if len(data) < _HEAD.size or not data.startswith(_MAGIC):
        return Refused(f"not a state file ({len(data)} bytes without the head of one)")
    _, version, length, digest = _HEAD.unpack_from(data)
    body = data[_HEAD.size :]
    if len(body) != length:
        return Refused(f"damaged: {len(body)} bytes where the head says {length}")
    if hashlib.sha256(_VERSION.pack(version) + body).digest() != digest:
        return Refused("damaged: its checksum is wrong")
    if version != FORMAT:
        age = "an older" if version < FORMAT else "a newer"
        return Refused(f"written by {age} version (format {version}, this one reads {FORMAT})")
    try:
        parsed = msgpack.unpackb(body, raw=False, strict_map_key=True)
        record = msgspec.convert(parsed, Record, strict=True)
    except (ValueError, msgpack.UnpackException, msgspec.ValidationError, RecursionError) as error:
        return Refused(f"its checksum is right but it cannot be read: {str(error)[:100]}")
    return record if identity is None else _wanted(record, identity)


def _wanted(record: Record, identity: Identity) -> Record | Refused:
    for name in ("robot", "leg", "library", "settings"):
        found, expected = getattr(record.identity, name), getattr(identity, name)
        if found != expected:
            return Refused(f"of another {name}: '{found}', this is '{expected}'")
    return record
