"""What both Dynamixel protocols share: instructions, errors, and a frame cut out of the bytes.

Sources: ROBOTIS e-manual, "DYNAMIXEL Protocol 1.0" and "DYNAMIXEL Protocol 2.0".
"""

from __future__ import annotations

import enum
from typing import Final, NamedTuple, Protocol

__all__ = ["BROADCAST_ID", "MAX_ID", "Codec", "Frame", "Instruction", "Status"]

BROADCAST_ID: Final = 0xFE
MAX_ID: Final = 252  # 253 is reserved in both protocols


class Instruction(enum.IntEnum):
    """Instruction codes; those from SYNC_READ on exist in protocol 2.0 only, but SYNC_WRITE."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93


class Frame(NamedTuple):
    """A packet without header, length and check: whose, what, and its parameters (unstuffed)."""

    id: int
    code: int
    parameters: bytes


class Status(NamedTuple):
    """A servo's answer."""

    id: int
    error: int
    data: bytes


class Codec(Protocol):
    """A protocol: bytes from frames, and frames from bytes."""

    version: int

    def instruction(self, servo: int, code: int, parameters: bytes = b"") -> bytes:
        """Bytes of an instruction packet."""

    def status(self, servo: int, error: int = 0, data: bytes = b"") -> bytes:
        """Bytes of a status packet."""

    def parse(self, buffer: bytearray) -> tuple[list[Frame], int]:
        """Take whole packets off the front of a buffer.

        Args:
            buffer: received so far; what was used or is no packet is removed, the beginning of a
                packet that is still coming stays.

        Returns:
            The frames, and how many packets had a wrong check.
        """
