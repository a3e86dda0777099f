r"""Encodes and decodes packets of both Dynamixel protocols, and of Feetech's.

Protocol 1.0: ``FF FF id length code parameters checksum``.

The checksum is :math:`\lnot(\text{id} + \text{length} + \text{code} + \sum p_i)`, its low byte;
the length counts code, parameters and checksum.  In a status packet the code is the error byte.

Protocol 2.0: ``FF FF FD 00 id length(2) code parameters crc(2)``, little endian.

The CRC is CRC-16/IBM (polynomial :math:`x^{16}+x^{15}+x^2+1`, not reflected, starting from 0)
over everything before it.  Inside code and parameters, ``FF FF FD`` would look like a header: a
second ``FD`` is stuffed behind it, counted in the length and covered by the CRC.  A status packet
has code 55 and the error as its first parameter.

Fast sync read is answered by one packet that the servos write together: the first sends the
header, each its ``error id data`` and the CRC of all bytes so far; nothing is stuffed.

Feetech's packets are those of protocol 1.0.  Its STS series has a sync read with these: address and
length of one byte, answers one after the other.

Sources: ROBOTIS e-manual, "DYNAMIXEL Protocol 1.0", "DYNAMIXEL Protocol 2.0" and its "CRC
calculation".
"""

from __future__ import annotations

import enum
import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from adaptive_contact.robot.description import Protocol

BROADCAST_ID: Final = 0xFE
MAX_ID: Final = 252  # 253 is reserved in both protocols


class Instruction(enum.IntEnum):
    """Lists instruction codes; from SYNC_READ on of protocol 2.0 only, except SYNC_WRITE."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A


class Frame(NamedTuple):
    """Holds a packet without header, length and check: id, code, parameters (unstuffed)."""

    id: int
    code: int
    parameters: bytes


class Status(NamedTuple):
    """Holds a servo's answer."""

    id: int
    error: int
    data: bytes


# Bits of a status packet's error byte, by the name they are counted under.
ERROR_BITS: Final = {
    0x01: "voltage",
    0x02: "angle_limit",
    0x04: "overheating",
    0x08: "range",
    0x10: "checksum",
    0x20: "overload",
    0x40: "instruction",
}
# Those of Feetech's, which are its Status register.
FEETECH_BITS: Final = {
    0x01: "voltage",
    0x02: "encoder",
    0x04: "overheating",
    0x08: "overcurrent",
    0x20: "overload",
}

_HEADER_2: Final = b"\xff\xff\xfd\x00"
_MAGIC: Final = b"\xff\xff\xfd"
ALERT: Final = 0x80  # bit of the error byte: the servo's own hardware is in trouble

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


def version_of(protocol: Protocol) -> int:
    """Return the version of a protocol's packets, 1 or 2."""
    return 2 if protocol == 2 else 1


def alarm_names(protocol: Protocol, error: int) -> tuple[str, ...]:
    """Names for a status packet's error byte; protocol 2.0's alert bit is ``hardware``."""
    if protocol != 2:
        bits = ERROR_BITS if protocol == 1 else FEETECH_BITS
        return tuple(name for bit, name in bits.items() if error & bit)
    names = ["hardware"] if error & ALERT else []
    number = error & ~ALERT
    if number:
        names.append(ERROR_NUMBERS.get(number, f"error_{number}"))
    return tuple(names)


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
    """Compute the CRC of bytes, or of bytes that follow those ``crc`` is of."""
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ _TABLE[(crc >> 8) ^ byte]
    return crc


def stuff(payload: bytes) -> bytes:
    """Put an FD behind every FF FF FD of code and parameters."""
    return payload.replace(_MAGIC, _MAGIC + b"\xfd")


def unstuff(payload: bytes) -> bytes:
    """Undo :func:`stuff`."""
    return payload.replace(_MAGIC + b"\xfd", _MAGIC)


class _Layout(NamedTuple):
    """Describes what surrounds code and parameters in a packet."""

    header: bytes
    overhead: int  # bytes up to the end of the length, which counts all that follows it
    lengths: range  # that a packet may have
    check_bytes: int


_LAYOUTS: Final = {
    1: _Layout(b"\xff\xff", 4, range(2, 251), 1),
    2: _Layout(_HEADER_2, 7, range(3, 1025), 2),
}


class Codec:
    """Encodes and decodes frames of a version of the protocol."""

    def __init__(self, version: int) -> None:
        self.version = version
        self._layout = _LAYOUTS[version]

    def instruction(self, servo: int, code: int, parameters: bytes = b"") -> bytes:
        """Encode an instruction packet.

        Raises:
            ValueError: the packet would be longer than the protocol has them.
        """
        header, overhead, lengths, check_bytes = self._layout
        payload = bytes((code,)) + parameters
        if self.version == 2:
            payload = stuff(payload)
        length, most = len(payload) + check_bytes, lengths[-1]
        if length > most:
            raise ValueError(
                f"{length} bytes do not fit a protocol {self.version}.0 packet ({most})"
            )
        head = header + bytes((servo,))
        packet = head + length.to_bytes(overhead - len(head), "little") + payload
        return packet + self._check(packet)

    def status(self, servo: int, error: int = 0, data: bytes = b"") -> bytes:
        """Encode a status packet."""
        if self.version == 1:
            return self.instruction(servo, error, data)
        return self.instruction(servo, Instruction.STATUS, bytes((error,)) + data)

    def parse(self, buffer: bytearray) -> list[Frame]:
        """Take whole packets off the front of a buffer; those with a wrong check are left out.

        Args:
            buffer: received so far; what was used or is no packet is removed, the beginning of a
                packet that is still coming stays.
        """
        header, overhead, lengths, _ = self._layout
        frames: list[Frame] = []
        while self._begins(buffer):
            length = int.from_bytes(buffer[len(header) + 1 : overhead], "little")
            end = overhead + length
            frame = None
            if length in lengths:
                if len(buffer) < end:
                    break
                frame = self._frame(bytes(buffer[:end]))
            if frame is None:
                del buffer[: len(header)]
            else:
                frames.append(frame)
                del buffer[:end]
        return frames

    def _begins(self, buffer: bytearray) -> bool:
        """Remove what comes before a header; whether all up to the packet's length is there."""
        header = self._layout.header
        start = buffer.find(header)
        if start < 0:
            # The last bytes may begin a header.
            keep = next((n for n in range(len(header) - 1, 0, -1) if buffer[-n:] == header[:n]), 0)
            start = len(buffer) - keep
        # An id is at most FE, so of three or more FF the last two are protocol 1.0's header.
        while buffer[start + 1 : start + 1 + len(header)] == header:
            start += 1
        del buffer[:start]
        return len(buffer) >= self._layout.overhead

    def _frame(self, packet: bytes) -> Frame | None:
        """Decode a packet; None where its check is wrong."""
        header, overhead, _, check_bytes = self._layout
        inside = packet[:-check_bytes]
        if self._check(inside) != packet[-check_bytes:]:
            return None
        servo, payload = packet[len(header)], inside[overhead:]
        # A joint answer to a fast sync read comes from no single servo, and is not stuffed.
        fast = servo == BROADCAST_ID and payload[0] == Instruction.STATUS
        if self.version == 2 and not fast:
            payload = unstuff(payload)
        return Frame(servo, payload[0], payload[1:])

    def _check(self, packet: bytes) -> bytes:
        """Compute the checksum, or CRC, of a packet that lacks it."""
        if self.version == 1:
            return bytes((~sum(packet[len(self._layout.header) :]) & 0xFF,))
        return crc16(packet).to_bytes(2, "little")


class Awaited:
    """Answers that may still come.

    An answer says who gives it and how long it is, not to which question.  Where one is late, the
    next question to its servo asks for another number of bytes, so that the two differ.

    Attributes:
        late: answers that came after they were waited for, by servo; one that is dead has none,
            however late those of others are.
    """

    def __init__(self) -> None:
        self.late: Counter[int] = Counter()
        self._sizes: dict[int, list[tuple[int, float]]] = {}

    def unlike(self, servos: Iterable[int], size: int, now_s: float) -> int:
        """Return a length, this one or more, that no answer of these servos still to come has."""
        taken = {s for servo in servos for s, end_s in self._sizes.get(servo, ()) if end_s > now_s}
        return next(more for more in itertools.count(size) if more not in taken)

    def record_request(self, servo: int, size: int, now_s: float) -> None:
        """Record a request, by the bytes of data that its answer has."""
        known = [one for one in self._sizes.get(servo, ()) if one[1] > now_s]
        # An answer that has not come within this time does not come.
        # A dead servo is asked five times in that time, with all others and alone; a disturbed line
        # need not make all questions long.
        self._sizes[servo] = [*known[-15:], (size, now_s + 1.0)]

    def strike(self, servo: int, size: int, *, late: bool = False) -> bool:
        """Remove an answer that has come; return False if none of its length was awaited."""
        sizes = self._sizes.get(servo, [])
        one = next((one for one in sizes if one[0] == size), None)
        if one is None:
            return False
        sizes.remove(one)
        if late:
            self.late[servo] += 1
        return True


def unsent(
    version: int,
    servo: int,
    instruction: Instruction,
    words: Sequence[int] = (),
    data: Sequence[int] = (),
) -> list[int]:
    """Encode a packet as the SDK takes it: it fills in header, stuffing and check bytes.

    Args:
        version: of the packets, 1 or 2.
        servo: its id.
        instruction: what is asked.
        words: parameters of two bytes each, of one in protocol 1.0.
        data: bytes that follow them.
    """
    if version == 1:
        rest = [*words, *data]
        return [0, 0, servo, len(rest) + 2, instruction, *rest, 0]
    rest = [*(byte for word in words for byte in (word & 0xFF, word >> 8)), *data]
    return [0, 0, 0, 0, servo, len(rest) + 3, 0, instruction, *rest, 0, 0]


def fast_sync_status(answers: Sequence[Status]) -> bytes:
    """Encode the packet that servos write together in answer to a fast sync read.

    Args:
        answers: one per servo, in the order of the request, with equally long data.
    """
    parts = sum(len(a.data) + 4 for a in answers)  # error, id, data, CRC each
    head = _HEADER_2 + bytes((BROADCAST_ID,)) + (parts + 1).to_bytes(2, "little")
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
