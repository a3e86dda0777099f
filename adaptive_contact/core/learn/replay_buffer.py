"""Buffers the newest confirmed free ticks.

Newest segments first, with a quota per direction and region of the workspace, so that a
monotonous gait does not forget the rest; bounded in segments and in rows.  Raw rows are kept, as
covariances are computed from residuals under the model in force.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.model.labelled_swing import SEGMENTS, Rows
from adaptive_contact.wire import BufferCounts

# A large library needs more rows than that, and its segments are kept for longer; 1,000 segments of
# the paper's library are 20 MB.
MOST_SEGMENTS: Final = 1000
# Swings of many seconds bring hundreds of rows each: so many, 5 MB of the shipped library, are kept
# in all.  A thousand segments of a walk, of a dozen, are as many.
MOST_ROWS: Final = 12_000


@dataclasses.dataclass(slots=True, eq=False)
class Segment:
    """Holds the confirmed rows of one lift or one descent."""

    values: Array  # (n, p + J) regressors and movements, side by side
    terms: int  # p
    context: Ints  # (n,) by which the rows' covariances were chosen
    cell: tuple[int, int]  # direction and region it counts towards
    era: int  # which state of the leg it belongs to; raised by the drift monitor
    t_ns: int  # of its last row, by the clock of
    source: int = -1  # the number of the source, since the buffer was made

    @property
    def theta(self) -> Array:
        """Return the (n, p) regressors."""
        return self.values[:, : self.terms]

    @property
    def target(self) -> Array:
        """Return the (n, J) movements, rad."""
        return self.values[:, self.terms :]


@dataclasses.dataclass
class ReplayBuffer:
    """Buffers the confirmed segments of one leg, and queues what the recursion is to learn.

    Attributes:
        limit: segments kept, more where they hold less than ``rows`` rows.
        rows: that a refit wants.
        segments: oldest first.
    """

    limit: int = SEGMENTS
    rows: int = 0
    segments: deque[Segment] = dataclasses.field(default_factory=deque)
    _source: int = 0
    _queue: deque[tuple[Segment, int]] = dataclasses.field(default_factory=deque)

    @property
    def unlearned(self) -> int:
        """Return how many rows wait for the recursion."""
        return len(self._queue)

    @property
    def counts(self) -> BufferCounts:
        """Return the counts of swings and ticks, for the status."""
        lifts = [len(segment.values) for segment in self.segments if segment.cell[0] == 0]
        return BufferCounts(
            swings=max(len(lifts), len(self.segments) - len(lifts)),
            lift_ticks=sum(lifts),
            descent_ticks=self._held - sum(lifts),
        )

    def add(self, rows: Rows, region: int, era: int) -> None:
        """Add the confirmed rows of a lift or of a descent."""
        if not rows:
            return
        width = rows.values.shape[1] - rows.joints  # what was moved aside is not kept
        context = rows.records["context"].astype(np.int64)
        cell, t_ns = (0 if rows.lifting else 1, region), int(rows.records[-1]["t_ns"])
        values = rows.values[:, :width].copy()
        segment = Segment(values, width - rows.joints, context, cell, era, t_ns, self._source)
        self.segments.append(segment)
        self._queue.extend((segment, row) for row in range(len(rows)))
        many = len(self.segments) > self.limit
        if many and (self._held > self.rows or len(self.segments) > MOST_SEGMENTS):
            self._evict()
        self._bound_rows()

    def residuals(self, coefficients: Array, era: int) -> tuple[Array, Ints]:
        """Compute the (n, J) residuals, rad, of an era's rows under (p, J) coefficients.

        Returns:
            These, and the rows' (n,) contexts.
        """
        terms, joints = coefficients.shape
        values = self.newest(era, MOST_ROWS)
        if not len(values):
            return np.zeros((0, joints)), np.zeros(0, np.int64)
        context = np.concatenate([s.context for s in self.segments if s.era == era])
        return values[:, terms:] - values[:, :terms] @ coefficients, context

    def newest(self, era: int, most: int) -> Array:
        """Copy the newest (n, p + J) regressors and movements of an era, oldest first."""
        kept = [segment.values for segment in self.segments if segment.era == era]
        return np.concatenate(kept)[-most:] if kept else np.zeros((0, 0))

    def pop_unlearned(self) -> tuple[Segment, int]:
        """Remove the oldest row that waits for the recursion, and return where it is.

        Raises:
            IndexError: none waits.
        """
        return self._queue.popleft()

    def drop_unlearned(self) -> None:
        """Drop what waits for the recursion; it stays in the buffer."""
        self._queue.clear()

    def drop_since(self, t_ns: int) -> None:
        """Drop segments that reach to or beyond a time of the source in force."""

        def older(segment: Segment) -> bool:
            return segment.source != self._source or segment.t_ns < t_ns

        self.segments = deque(s for s in self.segments if older(s))
        self._queue = deque(row for row in self._queue if older(row[0]))

    def new_source(self) -> None:
        """Follow a restart of the source: times of segments do not compare with those to come."""
        self._source += 1

    def restore(self, segments: list[Segment]) -> None:
        """Restore saved segments, oldest first; beyond the limit, the newest."""
        self.drop_unlearned()
        self.segments = deque(segments[-MOST_SEGMENTS:])
        self._bound_rows()

    @property
    def _held(self) -> int:
        return sum([len(segment.values) for segment in self.segments])

    def _bound_rows(self) -> None:
        while len(self.segments) > 1 and self._held > MOST_ROWS:
            self._evict()

    def _evict(self) -> None:
        """Drop one: first of older eras, then the oldest of the fullest cell."""
        index = 0  # eras are in order
        if self.segments[0].era == self.segments[-1].era:
            cells = Counter(segment.cell for segment in self.segments)
            most = max(cells.values())
            index = next(i for i, s in enumerate(self.segments) if cells[s.cell] == most)
        del self.segments[index]
