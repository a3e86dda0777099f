"""Reads a controller's state from CDR: what a sample needs; the rest is walked over and checked.

A controller state comes with every tick.  rosbags builds all of it, some 60 objects; this reads the
stamp, the names and two lists of positions in a fifth of the time.

A message is walked once.  Where all bytes that decided on the way are the same in the next one
(byte order, frame, names, lengths of all lists) the way is the same, and the values stand where
they stood: they are read at once, without walking.

Reference: OMG CDR (formal/02-06-51), as ROS 2 writes it: 4 bytes of encapsulation, then values
aligned to their size; a sequence is its length and its elements.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final, NamedTuple

_LITTLE: Final = b"\x00\x01"
_DOUBLE: Final = 8
_DURATION: Final = 8
# Bytes of an element of a multi-joint point: transforms, velocities, accelerations.
_MULTI: Final = (7 * _DOUBLE, 6 * _DOUBLE, 6 * _DOUBLE)
_BEGINS: Final = 4  # after the encapsulation
_FRAME: Final = _BEGINS + 8  # after the stamp
# Layouts that are kept, of one definition; of messages up to this size (64 legs have 20 kB).
_MOST_LAYOUTS: Final = 64


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


class _Span(NamedTuple):
    """Bytes of a payload."""

    at: int
    size: int


class _Layout:
    """Where values stand in a payload, and the bytes that make them stand there.

    Args:
        payload: one of this layout.
        order: of bytes, as :mod:`struct` writes it.
        fixed: bytes that must be the same, in their order; those between frame and names are
            compared by who chooses the layout.
        names: of the joints.
        feedback: positions.
        reference: the same.
    """

    def __init__(
        self,
        payload: bytes,
        order: str,
        fixed: list[_Span],
        names: tuple[str, ...],
        feedback: _Span,
        reference: _Span,
    ) -> None:
        self._fixed = _struct("=", [(span, f"{span.size}s") for span in fixed]).unpack_from
        self._expected = self._fixed(payload)
        self._names = names
        lists = sorted(
            (span, f"{span.size // _DOUBLE}d") for span in (feedback, reference) if span.size
        )
        self._values = _struct(order, [(_Span(_BEGINS, 8), "iI"), *lists]).unpack_from
        first, second = feedback.size // _DOUBLE, reference.size // _DOUBLE
        self._feedback, self._reference = slice(2, 2 + first), slice(2 + first, 2 + first + second)
        if reference < feedback:
            self._reference, self._feedback = slice(2, 2 + second), slice(2 + second, None)

    def read(self, payload: bytes) -> ControllerState | None:
        """Read a message of the same length; None where it may have another layout."""
        return self.state(payload) if self._fixed(payload) == self._expected else None

    def state(self, payload: bytes) -> ControllerState:
        """Read a message of this layout."""
        values = self._values(payload)
        return ControllerState(
            Header(Stamp(values[0], values[1])),
            self._names,
            Point(values[self._feedback]),
            Point(values[self._reference]),
        )


def _struct(order: str, fields: list[tuple[_Span, str]]) -> struct.Struct:
    """Fields of a payload, whatever stands between them left out."""
    parts, end = [order], 0
    for span, code in fields:
        parts.append(f"{span.at - end}x{code}")
        end = span.at + span.size
    return struct.Struct("".join(parts))


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
        self._layouts: dict[tuple[int, bytes], _Layout] = {}  # by length, and bytes up to names
        self._heads: tuple[int, ...] = ()  # where names end in those messages

    def read(self, payload: bytes) -> ControllerState:
        """Read a message.

        Raises:
            CdrError: the bytes are no such message.
        """
        for end in self._heads:
            layout = self._layouts.get((len(payload), payload[_FRAME:end]))
            if layout is not None and (state := layout.read(payload)) is not None:
                return state
        return self.walk(payload)

    def walk(self, payload: bytes) -> ControllerState:
        """Read a message without what is known of those before; its layout is kept.

        Raises:
            CdrError: the bytes are no such message.
        """
        order = payload[:2]
        if order not in (_LITTLE, b"\x00\x00") or len(payload) < 4:
            raise CdrError("no CDR")
        try:
            return self._walk(payload, "<" if order == _LITTLE else ">")
        except (struct.error, UnicodeDecodeError) as error:
            raise CdrError(str(error)) from error

    def _walk(self, payload: bytes, order: str) -> ControllerState:
        data = payload[_BEGINS:]
        size = len(data)
        count = struct.Struct(f"{order}I").unpack_from
        (frame,) = count(data, 8)  # after the stamp
        names, at = _read_names(data, (12 + frame + 3) & -4, count)
        head = _BEGINS + at
        fixed = [_Span(0, 2)]
        found: dict[str, _Span] = {}
        for name in self._points:
            # Lists of numbers in a point; the first are its positions.
            for which in range(4):
                at = (at + 3) & -4
                (length,) = count(data, at)
                fixed.append(_Span(_BEGINS + at, 4))
                at += 4
                if length:
                    at = (at + 7) & -8
                    end = at + _DOUBLE * length
                    if end > size:
                        raise CdrError(f"{length} numbers in {size} bytes")
                    if which == 0:
                        found[name] = _Span(_BEGINS + at, end - at)
                    at = end
            at = ((at + 3) & -4) + _DURATION
        if self._multi:
            begin = (at + 3) & -4
            _, at = _read_names(data, begin, count)
            fixed.append(_Span(_BEGINS + begin, at - begin))
            for _ in range(self._multi):
                for element in _MULTI:
                    at = (at + 3) & -4
                    (length,) = count(data, at)
                    fixed.append(_Span(_BEGINS + at, 4))
                    at += 4
                    if length:
                        at = ((at + 7) & -8) + element * length
                at = ((at + 3) & -4) + _DURATION
        if self._scaling:
            at = ((at + 7) & -8) + _DOUBLE
        if not at <= size <= at + 3:
            raise CdrError(f"{size} bytes, expected {at}")
        # Humble fills both; a definition that is older has only the second.
        nowhere = _Span(0, 0)
        feedback = found.get("feedback") or found.get("actual", nowhere)
        reference = found.get("reference") or found.get("desired", nowhere)
        layout = _Layout(payload, order, fixed, names, feedback, reference)
        if len(payload) <= (32 * 1024):
            if len(self._layouts) >= _MOST_LAYOUTS:
                self._layouts.clear()
            self._layouts[len(payload), payload[_FRAME:head]] = layout
            self._heads = tuple({_FRAME + len(known) for _, known in self._layouts})
        return layout.state(payload)


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
