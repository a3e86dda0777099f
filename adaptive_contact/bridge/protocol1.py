r"""Protocol 1.0: ``FF FF id length code parameters checksum``.

The checksum is :math:`\lnot(\text{id} + \text{length} + \text{code} + \sum p_i)`, its low byte;
the length counts code, parameters and checksum.  In a status packet the code is the error byte.

Source: ROBOTIS e-manual, "DYNAMIXEL Protocol 1.0".
"""

from __future__ import annotations

from typing import Final

from adaptive_contact.bridge.packets import Frame

__all__ = ["ERROR_BITS", "Protocol1", "checksum"]

_HEADER: Final = b"\xff\xff"
# Header, id, length, code and checksum; a length byte counts from the code on.
_OVERHEAD: Final = 4
_MAX_LENGTH: Final = 250

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


def checksum(body: bytes) -> int:
    """Checksum of a packet's bytes from the id to the last parameter."""
    return ~sum(body) & 0xFF


class Protocol1:
    """Protocol 1.0, a :class:`~adaptive_contact.bridge.packets.Codec`."""

    version = 1

    def instruction(self, servo: int, code: int, parameters: bytes = b"") -> bytes:
        """Bytes of an instruction packet.

        Raises:
            ValueError: the packet would be too long for its length byte.
        """
        length = len(parameters) + 2
        if length > _MAX_LENGTH:
            raise ValueError(f"{length} bytes do not fit a protocol 1.0 packet ({_MAX_LENGTH})")
        body = bytes((servo, length, code)) + parameters
        return _HEADER + body + bytes((checksum(body),))

    def status(self, servo: int, error: int = 0, data: bytes = b"") -> bytes:
        """Bytes of a status packet."""
        return self.instruction(servo, error, data)

    def parse(self, buffer: bytearray) -> tuple[list[Frame], int]:
        """Take whole packets off the front of a buffer; see :class:`.packets.Codec`."""
        frames: list[Frame] = []
        corrupt = 0
        while True:
            start = buffer.find(_HEADER)
            if start < 0:
                # The last byte may be the first of a header.
                del buffer[: len(buffer) - (buffer[-1:] == b"\xff")]
                return frames, corrupt
            # An id is at most FE, so of three or more FF the last two are the header.
            while buffer[start + 2 : start + 3] == b"\xff":
                start += 1
            del buffer[:start]
            if len(buffer) < _OVERHEAD:
                return frames, corrupt
            length = buffer[3]
            if not 2 <= length <= _MAX_LENGTH:
                corrupt += 1
                del buffer[:2]
                continue
            end = _OVERHEAD + length
            if len(buffer) < end:
                return frames, corrupt
            body = bytes(buffer[2 : end - 1])
            if checksum(body) == buffer[end - 1]:
                frames.append(Frame(body[0], body[2], body[3:]))
                del buffer[:end]
            else:
                corrupt += 1
                del buffer[:2]
