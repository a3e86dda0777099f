"""Encodes one leg's state: a header that never changes, a checksum, a msgpack map.

::

    offset  size  what
         0     8  magic, "ACSTATE" and a line feed
         8     2  version of the body, little endian
        10     8  length of the body, bytes
        18    32  SHA-256 of version and body
        50     …  body: msgpack map of Record

Whatever is wrong with a file is said in one line and never raised: a crash may have left
anything, and the service must start all the same.

What a state belongs to is a digest of all that shapes its learner.
"""

from __future__ import annotations

import hashlib
import os
import struct
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgpack
import msgspec

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model.bounds import Count
from adaptive_contact.robot import Robot

# 2: position of the source, so that samples that passed while the service was down are counted.
FORMAT: Final = 2
# A leg's state is about a megabyte; larger files are not read, as they could fill the memory.
MAX_BYTES: Final = 64 * 1024 * 1024

_MAGIC: Final = b"ACSTATE\n"
_HEAD: Final = struct.Struct("<8sHQ32s")
_VERSION: Final = struct.Struct("<H")


class Identity(msgspec.Struct, frozen=True):
    """Identifies what a state belongs to."""

    robot: str  # its name
    leg: str  # its id
    library: str  # of candidate terms, `none` for a learner that began without a model
    settings: str  # digest of robot.toml and baseline, see `settings_digest`


class Position(NamedTuple):
    """Holds where a source was when its leg was saved."""

    # run, seq: of the last sample that was used
    run: int | None
    seq: int
    missed_down: int = 0  # samples that passed while the service was down until then
    # runs of older publishers, the one that was replaced last at the end
    superseded: tuple[int | None, ...] = ()


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """Holds a leg's state, and when it was saved."""

    identity: Identity  # what it belongs to
    saved_ns: Count  # wall clock, since 1970
    package: str  # version of this package
    model_version: Count  # in force
    # run, seq: of the last sample the learner used; the run is None where samples carry none, the
    # number where none came yet
    run: int | None
    seq: Count | None
    missed_down: Count = 0  # samples that passed while the service was down, all times together
    # runs of older publishers of the leg; none in files from before it was kept
    superseded: tuple[int | None, ...] = ()
    body: dict[str, Any]  # the learner's own snapshot: numbers, strings, bytes, lists and maps


class Refused(NamedTuple):
    """Explains in one line why a state is not used."""

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


# Formats (of the file, of the learner's snapshot) that are no part of the digest.  Later ones are:
# a version with another format has files of its own, and an older version finds its own again.
_UNNAMED: Final = (2, 3)


def default_folder() -> Path:
    """Return the user's folder: ``$XDG_STATE_HOME/adaptive-contact``, or below ``~/.local/state``.

    Raises:
        ConfigurationError: the user has no home.
    """
    base = os.environ.get("XDG_STATE_HOME", "")
    # The specification says to ignore a relative path.
    if Path(base).is_absolute():
        return Path(base) / "adaptive-contact"
    try:
        return Path.home() / ".local" / "state" / "adaptive-contact"
    except RuntimeError as error:  # a container's user, say, with neither HOME nor an account
        raise ConfigurationError(
            "no home folder to keep state in ($HOME is not set); give --state DIR, or --no-state"
        ) from error


def settings_digest(
    robot: Robot, leg: str, baseline: str = "", *, formats: tuple[int, int] = (FORMAT, _UNNAMED[1])
) -> str:
    """Return a digest of all settings that make learned state useless when they change.

    Args:
        robot: description; mounts, servo ids and the target false-alarm rate do not enter.
        leg: id; one that the description lacks is known by its id alone.
        baseline: text of the models the learner starts from, empty for none: a new baseline is
            a new beginning, which old state must not undo.
        formats: of the file, and of the learner's snapshot in it.

    Returns:
        16 hexadecimal digits.
    """
    shape: tuple[object, ...] = ()
    if leg in robot.leg_ids:
        known = robot.leg(leg)
        shape = (known.joints, known.joint_axes, known.lengths_m, robot.quantum(leg))
        if known.origins_m is not None:
            shape += (known.origins_m,)
    facts: tuple[object, ...] = (robot.period_s, robot.servo, leg, shape, baseline)
    if formats != _UNNAMED:
        facts += (formats,)
    return hashlib.sha256(msgspec.json.encode(facts)).hexdigest()[:16]
