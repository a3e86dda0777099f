r"""Protocol 2.0: ``FF FF FD 00 id length(2) code parameters crc(2)``, little endian.

The CRC is CRC-16/IBM (polynomial :math:`x^{16}+x^{15}+x^2+1`, not reflected, starting from 0)
over everything before it.  Inside code and parameters, ``FF FF FD`` would look like a header: a
second ``FD`` is stuffed behind it, counted in the length and covered by the CRC.  A status packet
has code 55 and the error as its first parameter.

Fast sync read is answered by one packet that the servos write together: the first sends the
header, each its ``error id data`` and the CRC of all bytes so far; nothing is stuffed.

Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 2.0" and its "CRC calculation".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from adaptive_contact.bridge.packets import BROADCAST_ID, Frame, Instruction, Status

__all__ = [
    "ERROR_NUMBERS",
    "Protocol2",
    "crc16",
    "fast_sync_status",
    "split_fast_sync",
    "stuff",
    "unstuff",
]

_HEADER: Final = b"\xff\xff\xfd\x00"
_MAGIC: Final = b"\xff\xff\xfd"
# Header, id and length; the length counts from the code on.
_OVERHEAD: Final = 7
_MAX_LENGTH: Final = 1024
_ALERT: Final = 0x80

# Error numbers (low 7 bits of the error byte), by the name they are counted under.
ERROR_NUMBERS: Final = {
    1: "result_fail",
    2: "instruction",
    3: "crc",
    4: "data_range",
    5: "data_length",
    6: "data_limit",
    7: "access",
}


def _table() -> tuple[int, ...]:
    rows = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1) ^ (0x8005 if value & 0x8000 else 0)
        rows.append(value & 0xFFFF)
    return tuple(rows)


_TABLE: Final = _table()


def crc16(data: bytes, crc: int = 0) -> int:
    """CRC of bytes, or of bytes that follow those ``crc`` is of."""
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ _TABLE[(crc >> 8) ^ byte]
    return crc


def stuff(payload: bytes) -> bytes:
    """Put an FD behind every FF FF FD of code and parameters."""
    return payload.replace(_MAGIC, _MAGIC + b"\xfd")


def unstuff(payload: bytes) -> bytes:
    """Undo :func:`stuff`."""
    return payload.replace(_MAGIC + b"\xfd", _MAGIC)


class Protocol2:
    """Protocol 2.0, a :class:`~adaptive_contact.bridge.packets.Codec`."""

    version = 2

    def instruction(self, servo: int, code: int, parameters: bytes = b"") -> bytes:
        """Bytes of an instruction packet.

        Raises:
            ValueError: the packet would be longer than servos take.
        """
        payload = stuff(bytes((code,)) + parameters)
        length = len(payload) + 2
        if length > _MAX_LENGTH:
            raise ValueError(f"{length} bytes do not fit a protocol 2.0 packet ({_MAX_LENGTH})")
        packet = _HEADER + bytes((servo,)) + length.to_bytes(2, "little") + payload
        return packet + crc16(packet).to_bytes(2, "little")

    def status(self, servo: int, error: int = 0, data: bytes = b"") -> bytes:
        """Bytes of a status packet."""
        return self.instruction(servo, Instruction.STATUS, bytes((error,)) + data)

    def parse(self, buffer: bytearray) -> tuple[list[Frame], int]:
        """Take whole packets off the front of a buffer; see :class:`.packets.Codec`."""
        frames: list[Frame] = []
        corrupt = 0
        while True:
            start = buffer.find(_HEADER)
            if start < 0:
                # Up to three last bytes may begin a header.
                keep = next((n for n in (3, 2, 1) if buffer[-n:] == _HEADER[:n]), 0)
                del buffer[: len(buffer) - keep]
                return frames, corrupt
            del buffer[:start]
            if len(buffer) < _OVERHEAD:
                return frames, corrupt
            length = int.from_bytes(buffer[5:7], "little")
            if not 3 <= length <= _MAX_LENGTH:
                corrupt += 1
                del buffer[: len(_HEADER)]
                continue
            end = _OVERHEAD + length
            if len(buffer) < end:
                return frames, corrupt
            packet = bytes(buffer[:end])
            if crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                payload = packet[_OVERHEAD:-2]
                # A joint answer to a fast sync read comes from nobody, and is not stuffed.
                fast = packet[4] == BROADCAST_ID and payload[0] == Instruction.STATUS
                payload = payload if fast else unstuff(payload)
                frames.append(Frame(packet[4], payload[0], payload[1:]))
                del buffer[:end]
            else:
                corrupt += 1
                del buffer[: len(_HEADER)]


def fast_sync_status(answers: Sequence[Status]) -> bytes:
    """The packet that servos write together in answer to a fast sync read.

    Args:
        answers: one per servo, in the order of the request, with equally long data.
    """
    parts = sum(len(a.data) + 4 for a in answers)  # error, id, data, CRC each
    head = _HEADER + bytes((BROADCAST_ID,)) + (parts + 1).to_bytes(2, "little")
    packet = head + bytes((Instruction.STATUS,))
    for answer in answers:
        packet += bytes((answer.error, answer.id)) + answer.data
        packet += crc16(packet).to_bytes(2, "little")
    return packet


def split_fast_sync(parameters: bytes, size: int) -> list[Status]:
    """Take a fast sync read's answer apart.

    Args:
        parameters: all after the code, without the last CRC.
        size: bytes of data per servo.

    Returns:
        The answers of whole parts; a part cut short is left out.
    """
    step = size + 4
    return [
        Status(parameters[i + 1], parameters[i], bytes(parameters[i + 2 : i + 2 + size]))
        for i in range(0, len(parameters) - size - 1, step)
    ]
