"""Buffers the newest confirmed free ticks.

Newest segments first, with a quota per direction and region of the workspace, so that a
monotonous gait does not forget the rest; bounded in segments.  Raw rows are kept, as covariances
are computed from residuals under the model in force, and side by side, as that is one product then.
Evicting is marking a segment's rows; their room is regained when there is no other left.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.compiled import compiled, records
from adaptive_contact.model.labelled_swing import SEGMENTS, Rows
from adaptive_contact.wire import BufferCounts

# A large library needs more rows than that, and its segments are kept for longer; 1,000 segments of
# the paper's library are 20 MB.
MOST_SEGMENTS: Final = 1000
# Swings of many seconds bring hundreds of rows each: so many, 5 MB of the shipped library, are kept
# in all, with room for half as many more.  A thousand segments of a walk, of a dozen, are as many.
MOST_ROWS: Final = 12_000
# Room for rows at first, those of a walk's segments: arrays that grow leave holes in the process's
# memory, and what is not written to takes none.  Once more than this share of it is kept, for so
# many times those.
FIRST_ROOM: Final = 2048
FULL: Final = 0.8
SPARE: Final = 1.5
_EVICTED: Final = -1  # era of rows that are kept no more


class Segment(NamedTuple):
    """Holds the confirmed rows of one lift or one descent; the buffer's are views."""

    theta: Array  # (n, p)
    target: Array  # (n, J) rad
    context: Ints  # (n,) by which the rows' covariances were chosen
    cell: tuple[int, int]  # direction and region it counts towards
    era: int  # which state of the leg it belongs to; raised by the drift monitor
    t_ns: int  # of its last row


@dataclasses.dataclass(slots=True)
class _Place:
    """Locates the rows of a segment, and holds its other fields."""

    first: int
    count: int
    cell: tuple[int, int]
    era: int
    t_ns: int
    unlearned: int = 0  # rows, the last


@dataclasses.dataclass
class ReplayBuffer:
    """Buffers the confirmed segments of one leg, and queues what the recursion is to learn.

    Attributes:
        limit: segments kept, more where they hold less than ``rows`` rows.
        rows: that a refit wants.
        values: (rows, p + J) regressors and movements, side by side.
        unlearned: rows that wait for the recursion; those of a segment that goes do not.
    """

    limit: int = SEGMENTS
    rows: int = 0
    unlearned: int = 0
    values: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    _segments: deque[_Place] = dataclasses.field(default_factory=deque)
    _cells: Counter[tuple[int, int]] = dataclasses.field(default_factory=Counter)
    _held: int = 0  # rows
    _of_source: int = 0  # segments, the newest: whose times are of the source in force
    _used: int = 0  # rows of the arrays, those evicted among them
    _terms: int = 0  # p
    _queue: deque[_Place] = dataclasses.field(default_factory=deque)
    _context: Ints = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    _eras: Ints = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def segments(self) -> list[Segment]:
        """Segments, oldest first; good until the buffer changes."""
        found = []
        for s in self._segments:
            rows = slice(s.first, s.first + s.count)
            theta, target = self.values[rows, : self._terms], self.values[rows, self._terms :]
            found.append(Segment(theta, target, self._context[rows], s.cell, s.era, s.t_ns))
        return found

    @property
    def counts(self) -> BufferCounts:
        """Counts of swings and ticks, for the status."""
        lifts = [segment.count for segment in self._segments if segment.cell[0] == 0]
        return BufferCounts(
            swings=max(len(lifts), len(self._segments) - len(lifts)),
            lift_ticks=sum(lifts),
            descent_ticks=self._held - sum(lifts),
        )

    def add(self, rows: Rows, region: int, era: int) -> None:
        """Take in the confirmed rows of a lift or of a descent."""
        if not rows:
            return
        width = rows.values.shape[1] - rows.joints  # what was moved aside is not kept
        cell, t_ns = (0 if rows.lifting else 1, region), int(rows.records[-1]["t_ns"])
        place = _Place(0, len(rows), cell, era, t_ns)
        self._append(place, width, rows.joints)
        of_rows = records(rows.records)
        keep_rows(rows.values, of_rows, self.values, self._context, self._eras, place.first, era)
        self._of_source += 1
        place.unlearned = place.count
        self.unlearned += place.count
        self._queue.append(place)
        if len(self._segments) > self.limit and (
            self._held > self.rows or len(self._segments) > MOST_SEGMENTS
        ):
            self._evict()
        self._bound()

    def residuals(self, coefficients: Array, era: int) -> tuple[Array, Ints]:
        """Compute the (n, J) residuals, rad, of an era's rows under (p, J) coefficients.

        Returns:
            These, and the rows' (n,) contexts.
        """
        used = slice(self._used)
        if not self._used:
            return np.zeros((0, coefficients.shape[1])), self._context
        values, p = self.values[used], self._terms
        off = values[:, p:] - values[:, :p] @ coefficients
        of_era = np.flatnonzero(self._eras[used] == era)
        return off.take(of_era, axis=0), self._context.take(of_era)

    def of_era(self, era: int) -> int:
        """Count the segments of an era."""
        return sum(segment.era == era for segment in self._segments)

    def next_unlearned(self) -> tuple[int, int]:
        """Take the oldest of the rows that wait.

        Returns:
            Its place in :attr:`values`, and when its segment ended, ns.

        Raises:
            IndexError: none waits.
        """
        place = self._queue[0]
        while not place.unlearned:  # learned, or gone
            self._queue.popleft()
            place = self._queue[0]
        at = place.first + place.count - place.unlearned
        place.unlearned -= 1
        self.unlearned -= 1
        return at, place.t_ns

    def drop_unlearned(self) -> None:
        """Drop what waits for the recursion; it stays in the buffer."""
        for place in self._queue:
            place.unlearned = 0
        self._queue.clear()
        self.unlearned = 0

    def _append(self, place: _Place, width: int, joints: int) -> None:
        """Give a segment its place behind the others."""
        if self._used + place.count > len(self._eras):
            self._make_room(place.count, width)
        place.first, self._terms = self._used, width - joints
        self._used += place.count
        self._segments.append(place)
        self._cells[place.cell] += 1
        self._held += place.count

    def _make_room(self, count: int, width: int) -> None:
        """Move what is kept together; into larger arrays, where it nearly fills these."""
        arrays = before = self.values, self._context, self._eras
        if self._held + count > FULL * len(self._eras):
            room = max(FIRST_ROOM, int(SPARE * (self._held + count)))
            self.values = np.zeros((room, width))
            self._context, self._eras = np.zeros(room, np.int64), np.zeros(room, np.int64)
            arrays = self.values, self._context, self._eras
        self._used = 0
        for segment in self._segments:
            # One by one: a copy of all in between would leave holes in the process's memory.
            at = slice(self._used, self._used + segment.count)
            for of, rows in zip(arrays, before, strict=True):
                of[at] = rows[segment.first : segment.first + segment.count]
            segment.first, self._used = at.start, at.stop

    def _drop(self, segment: _Place) -> None:
        self._eras[segment.first : segment.first + segment.count] = _EVICTED
        self._held -= segment.count
        self.unlearned -= segment.unlearned
        segment.unlearned = 0
        self._cells[segment.cell] -= 1

    def _bound(self) -> None:
        while self._held > MOST_ROWS and len(self._segments) > 1:
            self._evict()

    def _evict(self) -> None:
        """Drop one: first of older eras, then the oldest of the fullest cell."""
        index = 0  # eras are in order
        if self._segments[0].era == self._segments[-1].era:
            most = max(self._cells.values())
            index = next(i for i, s in enumerate(self._segments) if self._cells[s.cell] == most)
        self._of_source -= index >= len(self._segments) - self._of_source
        self._drop(self._segments[index])
        del self._segments[index]

    def drop_since(self, t_ns: int) -> None:
        """Drop segments that reach to or beyond a time of the source in force.

        They are not in order: a descent that waited comes after the lift that confirmed it.
        """
        own = [self._segments.pop() for _ in range(self._of_source)]
        kept = []
        for segment in reversed(own):
            if segment.t_ns < t_ns:
                kept.append(segment)
            else:
                self._drop(segment)
        self._segments.extend(kept)
        self._of_source = len(kept)

    def new_source(self) -> None:
        """Mark all segments as of an earlier source: their times do not compare with its own."""
        self._of_source = 0

    def newest(self, era: int, most: int) -> Array:
        """Copy the newest (n, p + J) regressors and movements of an era, oldest first."""
        return np.asarray(self.values[np.flatnonzero(self._eras[: self._used] == era)[-most:]])

    def restore(self, segments: list[Segment]) -> None:
        """Take over saved segments, oldest first; beyond the limit, the newest."""
        self.drop_unlearned()
        self._segments.clear()
        self._cells.clear()
        self._held = self._used = self._of_source = 0
        for s in segments[-MOST_SEGMENTS:]:
            place = _Place(0, len(s.target), s.cell, s.era, s.t_ns)
            (_, terms), (_, joints) = s.theta.shape, s.target.shape
            self._append(place, terms + joints, joints)
            rows = slice(place.first, self._used)
            self.values[rows, :terms], self.values[rows, terms:] = s.theta, s.target
            self._context[rows], self._eras[rows] = s.context, s.era
        self._bound()


@compiled
def keep_rows(values, records, kept, contexts, eras, first, era):
    """Copy rows to behind others.

    Args:
        values: (n, p + 2 J) of :class:`~adaptive_contact.model.labelled_swing.Rows`.
        records: (n,) of them.
        kept: (rows, p + J) that get regressors and movements.
        contexts: (rows,) that get their contexts.
        eras: (rows,) that get ``era``.
        first: row of the first copy.
        era: of the leg.
    """
    for i in range(len(records)):
        for k in range(kept.shape[1]):
            kept[first + i, k] = values[i, k]
        contexts[first + i] = records[i].context
        eras[first + i] = era
