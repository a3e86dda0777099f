"""Packets byte for byte against the protocol documents.

Examples marked P1 are of the ROBOTIS e-manual "DYNAMIXEL Protocol 1.0", P2 of "Protocol 2.0".
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.bridge.packets import (
    BROADCAST_ID,
    Codec,
    Frame,
    Instruction,
    Status,
    fast_sync_status,
    split_fast_sync,
    stuff,
    unstuff,
)

I = Instruction
ALL = BROADCAST_ID

P1_INSTRUCTIONS = [
    ("ping", 1, I.PING, "", "FF FF 01 02 01 FB"),
    ("read temperature", 1, I.READ, "2B 01", "FF FF 01 04 02 2B 01 CC"),
    ("write id, broadcast", ALL, I.WRITE, "03 01", "FF FF FE 04 03 03 01 F6"),
    (
        "sync write",
        ALL,
        I.SYNC_WRITE,
        "1E 04 00 10 00 50 01 01 20 02 60 03",
        "FF FF FE 0E 83 1E 04 00 10 00 50 01 01 20 02 60 03 67",
    ),
]
P1_STATUS = [
    ("ping", 1, 0, "", "FF FF 01 02 00 FC"),
    ("temperature 32", 1, 0, "20", "FF FF 01 03 00 20 DB"),
    ("goal of 1", 1, 0, "00 80", "FF FF 01 04 00 00 80 7A"),
    ("position of 2", 2, 0, "00 80", "FF FF 02 04 00 00 80 79"),
]
P2_INSTRUCTIONS = [
    ("ping", 1, I.PING, "", "FF FF FD 00 01 03 00 01 19 4E"),
    ("ping all", ALL, I.PING, "", "FF FF FD 00 FE 03 00 01 31 42"),
    ("read", 1, I.READ, "84 00 04 00", "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    ("write", 1, I.WRITE, "74 00 00 02 00 00", "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    ("reboot", 1, I.REBOOT, "", "FF FF FD 00 01 03 00 08 2F 4E"),
    (
        "sync read",
        ALL,
        I.SYNC_READ,
        "84 00 04 00 01 02",
        "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
    ),
    (
        "sync write",
        ALL,
        I.SYNC_WRITE,
        "74 00 04 00 01 96 00 00 00 02 AA 00 00 00",
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    (
        "fast sync read",
        ALL,
        I.FAST_SYNC_READ,
        "84 00 04 00 03 07 04",
        "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2",
    ),
]
P2_STATUS = [
    ("ping, model 1030", 1, 0, "06 04 26", "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    ("position 166", 1, 0, "A6 00 00 00", "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
    ("position 2079", 2, 0, "1F 08 00 00", "FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE"),
    ("write", 1, 0, "", "FF FF FD 00 01 04 00 55 00 A1 0C"),
]
INSTRUCTIONS = [(Codec(1), *row) for row in P1_INSTRUCTIONS] + [
    (Codec(2), *row) for row in P2_INSTRUCTIONS
]
STATUSES = [(Codec(1), *row) for row in P1_STATUS] + [(Codec(2), *row) for row in P2_STATUS]


@pytest.mark.parametrize(("codec", "name", "servo", "code", "parameters", "packet"), INSTRUCTIONS)
def test_instructions_are_those_of_the_documents(
    codec: Codec, name: str, servo: int, code: int, parameters: str, packet: str
) -> None:
    expected = bytes.fromhex(packet)
    assert codec.instruction(servo, code, bytes.fromhex(parameters)) == expected
    assert codec.parse(bytearray(expected)) == [Frame(servo, code, bytes.fromhex(parameters))]


@pytest.mark.parametrize(("codec", "name", "servo", "error", "data", "packet"), STATUSES)
def test_status_packets_are_those_of_the_documents(
    codec: Codec, name: str, servo: int, error: int, data: str, packet: str
) -> None:
    assert codec.status(servo, error, bytes.fromhex(data)) == bytes.fromhex(packet)


def test_fast_sync_read_is_answered_as_in_the_document() -> None:
    # P2, "Fast Sync Read": ids 3, 7, 4 at 166, 2079, 1023; CRCs of ids 3 and 7 as printed.
    answers = [Status(i, 0, p.to_bytes(4, "little")) for i, p in ((3, 166), (7, 2079), (4, 1023))]
    packet = fast_sync_status(answers)
    printed = bytes.fromhex(
        "FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA 00 04 FF 03 00 00"
    )
    assert packet[: len(printed)] == printed
    [frame] = Codec(2).parse(bytearray(packet))
    assert split_fast_sync(frame.parameters, 4) == answers


@pytest.mark.parametrize("codec", [Codec(1), Codec(2)])
def test_a_wrong_check_costs_one_packet(codec: Codec) -> None:
    good = codec.instruction(5, I.READ, b"\x24\x02")
    for position in range(len(good)):
        broken = bytearray(good)
        broken[position] ^= 0x10
        # A flipped length may swallow what follows; enough follows to come out of it again.
        buffer = broken + good * 140
        frames = codec.parse(buffer)
        assert all(f == Frame(5, I.READ, b"\x24\x02") for f in frames)
        assert len(frames) >= 1


@pytest.mark.parametrize("codec", [Codec(1), Codec(2)])
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_packets_come_out_however_they_are_cut(codec: Codec, data: st.DataObject) -> None:
    rows = data.draw(
        st.lists(
            st.tuples(
                st.integers(0, 252),
                st.sampled_from([int(i) for i in I if i != I.STATUS]),
                st.binary(max_size=40) | st.sampled_from([b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"]),
            ),
            max_size=4,
        )
    )
    stream = b"".join(codec.instruction(*row) for row in rows)
    buffer, frames = bytearray(), []
    at = 0
    while at < len(stream):
        size = data.draw(st.integers(1, 12))
        buffer += stream[at : at + size]
        frames += codec.parse(buffer)
        at += size
    assert frames == [Frame(*row) for row in rows]
    assert not buffer


@settings(max_examples=200)
@given(st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55]), max_size=24).map(bytes))
def test_stuffing_is_undone(payload: bytes) -> None:
    assert unstuff(stuff(payload)) == payload
    # Never a header inside, so a receiver that lost its place finds the next packet.
    assert b"\xff\xff\xfd\x00" not in stuff(payload)


@pytest.mark.parametrize("codec", [Codec(1), Codec(2)])
@settings(max_examples=150, deadline=None)
@given(noise=st.binary(max_size=60))
def test_noise_never_raises_and_is_not_kept(codec: Codec, noise: bytes) -> None:
    buffer = bytearray(noise)
    codec.parse(buffer)
    buffer += bytes(1100)
    codec.parse(buffer)
    assert len(buffer) < 8


@pytest.mark.parametrize("codec", [Codec(1), Codec(2)])
def test_too_long_a_packet_is_refused(codec: Codec) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        codec.instruction(1, I.WRITE, bytes(1100))
