"""Whatever is on disk: a whole state, or one line on why it is none."""

from __future__ import annotations

import hashlib
import struct

import msgspec
import pytest

from adaptive_contact.service.state import Identity, Refused, pack, unpack
from adaptive_contact.service.state.format import FORMAT

from .conftest import WHO, record


def sealed(body: bytes, version: int = FORMAT) -> bytes:
    """A file with a right checksum over any body."""
    digest = hashlib.sha256(struct.pack("<H", version) + body).digest()
    return struct.pack("<8sHQ32s", b"ACSTATE\n", version, len(body), digest) + body


def why(data: bytes, identity: Identity | None = WHO) -> str:
    found = unpack(data, identity)
    assert isinstance(found, Refused), found
    assert "\n" not in found.why
    return found.why


def test_what_is_packed_is_read_back() -> None:
    whole = record(3, saved_ns=5, package="0.1.0", run=12, seq=99)
    assert unpack(pack(whole), WHO) == whole
    assert unpack(pack(record(seq=None)), None) == record(seq=None)
    known = record(superseded=(None, 3))
    assert unpack(pack(known), WHO) == known


def test_a_state_from_before_older_publishers_were_kept_is_read() -> None:
    fields = msgspec.to_builtins(record(), builtin_types=(bytes,))
    del fields["superseded"]
    assert unpack(sealed(msgspec.msgpack.encode(fields)), WHO) == record(superseded=())


def test_every_flipped_byte_and_every_cut_is_refused() -> None:
    data = pack(record())
    assert "damaged" in why(data + b"x")
    for at in range(len(data)):
        assert why(data[:at])
        flipped = bytearray(data)
        flipped[at] ^= 0x40
        assert why(bytes(flipped))


@pytest.mark.parametrize(
    ("field", "value", "line"),
    [
        ("robot", "maxi", "of another robot: 'maxi', this is 'mini'"),
        ("leg", "lf", "of another leg: 'lf', this is 'rf'"),
        ("library", "paper", "of another library: 'paper', this is 'servo'"),
        ("settings", "0", "of another settings: '0', this is '0123456789abcdef'"),
    ],
)
def test_what_belongs_to_something_else_is_refused(field: str, value: str, line: str) -> None:
    other = msgspec.structs.replace(WHO, **{field: value})
    assert why(pack(record(identity=other))) == line
    assert unpack(pack(record(identity=other)), None)


@pytest.mark.parametrize(("version", "age"), [(1, "an older"), (3, "a newer")])
def test_other_versions_are_told(version: int, age: str) -> None:
    data = sealed(msgspec.msgpack.encode({"whatever": version}), version)
    assert why(data) == f"written by {age} version (format {version}, this one reads 2)"


@pytest.mark.parametrize("body", [b"", b"\xc1", b"\x93\x01", b"\x80", msgspec.msgpack.encode([1])])
def test_a_right_checksum_over_nonsense_is_refused(body: bytes) -> None:
    assert "cannot be read" in why(sealed(body))
