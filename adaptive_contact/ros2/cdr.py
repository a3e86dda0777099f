"""Reads a controller's state from CDR: what a sample needs; the rest is walked over and checked.

A controller state comes with every tick.  rosbags builds all of it, some 60 objects; this reads the
stamp, the names and two lists of positions in a fifth of the time.

Reference: OMG CDR (formal/02-06-51), as ROS 2 writes it: 4 bytes of encapsulation, then values
aligned to their size; a sequence is its length and its elements.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, NamedTuple

_LITTLE: Final = b"\x00\x01"
_BIG: Final = b"\x00\x00"
_DOUBLE: Final = 8
_DURATION: Final = 8
# Lists of numbers in a point; the first are its positions.
_LISTS: Final = 4
# Bytes of an element of a multi-joint point: transforms, velocities, accelerations.
_MULTI: Final = (7 * _DOUBLE, 6 * _DOUBLE, 6 * _DOUBLE)
_PADDING: Final = 3


_Unpack = Callable[[bytes, int], tuple[int, ...]]


class CdrError(Exception):
    """A payload is no message of its type."""


class UnknownHashError(Exception):
    """A type's hash is of no definition that is known; the text names those that are."""


class Stamp(NamedTuple):
    """Seconds and nanoseconds."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """Of a message; the frame is left out."""

    stamp: Stamp


class Point(NamedTuple):
    """Of a trajectory; its positions only."""

    positions: tuple[float, ...]


class ControllerState(NamedTuple):
    """What a sample needs of a controller's state."""

    header: Header
    joint_names: tuple[str, ...]
    feedback: Point
    reference: Point


class StateReader:
    """Reads controller states of one definition.

    Args:
        points: names of the points, in their order.
        multi: how many multi-joint points follow; none, nor their names, where 0.
        scaling: a number ends the message.
    """

    def __init__(self, points: tuple[str, ...], multi: int, *, scaling: bool) -> None:
        self._points = points
        self._multi = multi
        self._scaling = scaling
        self._names: tuple[bytes, tuple[str, ...]] = (b"", ())

    def read(self, payload: bytes) -> ControllerState:
        """Read a message.

        Raises:
            CdrError: the bytes are no such message.
        """
        order = payload[:2]
        if order not in (_LITTLE, _BIG) or len(payload) < 4:
            raise CdrError("no CDR")
        try:
            return self._read(payload[4:], "<" if order == _LITTLE else ">")
        except (struct.error, UnicodeDecodeError) as error:
            raise CdrError(str(error)) from error

    def _read(self, data: bytes, order: str) -> ControllerState:
        size = len(data)
        count = struct.Struct(f"{order}I").unpack_from
        sec, nanosec, frame = struct.unpack_from(f"{order}iII", data)
        names, at = self._joint_names(data, _aligned(12 + frame, 4), count)
        found: dict[str, tuple[float, ...]] = {}
        for name in self._points:
            for which in range(_LISTS):
                at = (at + 3) & -4
                (length,) = count(data, at)
                at += 4
                if length:
                    at = (at + 7) & -8
                    end = at + _DOUBLE * length
                    if end > size:
                        raise CdrError(f"{length} numbers in {size} bytes")
                    if which == 0:
                        found[name] = struct.unpack_from(f"{order}{length}d", data, at)
                    at = end
            at = ((at + 3) & -4) + _DURATION
        if self._multi:
            _, at = _read_names(data, (at + 3) & -4, count)
            for _ in range(self._multi):
                for element in _MULTI:
                    at = (at + 3) & -4
                    (length,) = count(data, at)
                    at += 4
                    if length:
                        at = ((at + 7) & -8) + element * length
                at = ((at + 3) & -4) + _DURATION
        if self._scaling:
            at = ((at + 7) & -8) + _DOUBLE
        if not at <= size <= at + _PADDING:
            raise CdrError(f"{size} bytes, expected {at}")
        # Humble fills both; a definition that is older has only the second.
        feedback = found.get("feedback") or found.get("actual", ())
        reference = found.get("reference") or found.get("desired", ())
        return ControllerState(
            Header(Stamp(sec, nanosec)), names, Point(feedback), Point(reference)
        )

    def _joint_names(self, data: bytes, at: int, count: _Unpack) -> tuple[tuple[str, ...], int]:
        """Names, which are the same in every message of a controller."""
        before, names = self._names
        if before and data.startswith(before, at):
            return names, at + len(before)
        names, end = _read_names(data, at, count)
        self._names = (data[at:end], names)
        return names, end


def _aligned(at: int, to: int) -> int:
    return (at + to - 1) & -to


def _read_names(data: bytes, at: int, count: _Unpack) -> tuple[tuple[str, ...], int]:
    """A sequence of texts, and where it ends."""
    (number,) = count(data, at)
    at += 4
    if number > len(data):
        raise CdrError(f"{number} names in {len(data)} bytes")
    names = []
    for _ in range(number):
        at = (at + 3) & -4
        (length,) = count(data, at)
        at += 4
        names.append(data[at : at + max(length - 1, 0)].decode())
        at += length
    if at > len(data):
        raise CdrError(f"names end at byte {at} of {len(data)}")
    return tuple(names), at
