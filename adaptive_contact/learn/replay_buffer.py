"""Buffers the newest confirmed free ticks.

Newest segments first, with a quota per direction and region of the workspace, so that a
monotonous gait does not forget the rest; bounded in segments.  Each segment keeps its raw rows:
covariances are computed from residuals under the model in force.  Evicting is dropping.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.model.factor import Factor
from adaptive_contact.model.labelled_swing import SEGMENTS, Rows
from adaptive_contact.wire import BufferCounts

__all__ = ["ReplayBuffer", "Segment"]

Array = NDArray[np.float64]

# A large library needs more rows than that, and its segments are kept for longer; 1,000 segments of
# the paper's library are 20 MB.
MOST_SEGMENTS: Final = 1000
# Swings of many seconds bring hundreds of rows each: so many, 5 MB of the shipped library, are kept
# in all.  Segments of a walk hold a dozen, and a thousand of those are as many.
MOST_ROWS: Final = 12_000


class Segment(NamedTuple):
    """Holds the confirmed rows of one lift or one descent.

    Attributes:
        theta: (n, p); target: (n, J) rad.
        context: (n,) by which the rows' covariances were chosen.
        cell: direction and region it counts towards.
        era: which state of the leg it belongs to; raised by the drift monitor.
        t_ns: of its last row.
    """

    theta: Array
    target: Array
    context: NDArray[np.int64]
    cell: tuple[int, int]
    era: int
    t_ns: int


@dataclasses.dataclass
class ReplayBuffer:
    """Buffers the confirmed segments of one leg.

    Attributes:
        limit: segments kept, more where they hold less than ``rows`` rows.
        rows: that a refit wants.
    """

    limit: int = SEGMENTS
    rows: int = 0
    _segments: deque[Segment] = dataclasses.field(default_factory=deque)
    _cells: Counter[tuple[int, int]] = dataclasses.field(default_factory=Counter)
    _held: int = 0  # rows
    _of_source: int = 0  # segments, the newest: whose times are of the source in force

    @property
    def segments(self) -> list[Segment]:
        """Segments, oldest first."""
        return list(self._segments)

    @property
    def counts(self) -> BufferCounts:
        """Counts of swings and ticks, for the status."""
        lifts = [len(segment.target) for segment in self._segments if segment.cell[0] == 0]
        return BufferCounts(
            swings=max(len(lifts), len(self._segments) - len(lifts)),
            lift_ticks=sum(lifts),
            descent_ticks=self._held - sum(lifts),
        )

    def add(self, rows: Rows, region: int, era: int) -> None:
        """Take in the confirmed rows of a lift or of a descent."""
        if not rows:
            return
        cell = (0 if rows.known["lift"][0] else 1, region)
        context = rows.known["context"].astype(np.int64)
        segment = Segment(rows.theta, rows.target, context, cell, era, int(rows.t_ns[-1]))
        self._segments.append(segment)
        self._cells[cell] += 1
        self._held += len(rows)
        self._of_source += 1
        if len(self._segments) > self.limit and (
            self._held > self.rows or len(self._segments) > MOST_SEGMENTS
        ):
            self._evict()
        self._bound()

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
        self._held -= len(self._segments[index].target)
        self._cells[self._segments[index].cell] -= 1
        del self._segments[index]

    def drop_since(self, t_ns: int) -> None:
        """Drop segments that reach to or beyond a time of the source in force.

        They are not in order: a descent that waited comes after the lift that confirmed it.
        """
        own = [self._segments.pop() for _ in range(self._of_source)]
        kept = [segment for segment in reversed(own) if segment.t_ns < t_ns]
        self._segments.extend(kept)
        self._of_source = len(kept)
        self._count()

    def new_source(self) -> None:
        """Mark all segments as of an earlier source: their times do not compare with its own."""
        self._of_source = 0

    def factors(
        self, terms: int, joints: int, *, era: int, every: int = 5
    ) -> tuple[Factor, Factor]:
        """Compress the segments of an era into a factor to fit to and one to choose by.

        Args:
            terms: p.
            joints: J.
            era: only segments of this state of the leg.
            every: each so-manyth segment is held out.

        Returns:
            The factor of the rest, and of those held out; their rows are compressed on
            first use.
        """
        fit, held_out = Factor(terms, joints), Factor(terms, joints)
        of_era = [s for s in self._segments if s.era == era]
        dealt: tuple[list[Segment], list[Segment]] = ([], [])
        for number, segment in enumerate(of_era):
            dealt[number % every == every - 1].append(segment)
        for factor, segments in zip((fit, held_out), dealt, strict=True):
            if segments:
                factor.add(
                    np.concatenate([s.theta for s in segments]),
                    np.concatenate([s.target for s in segments]),
                )
        return fit, held_out

    def restore(self, segments: list[Segment]) -> None:
        """Take over saved segments, oldest first; beyond the limit, the newest."""
        self._segments = deque(segments[-MOST_SEGMENTS:])
        self._of_source = 0
        self._count()
        self._bound()

    def _count(self) -> None:
        """Count rows and cells from the segments."""
        self._held = sum(len(segment.target) for segment in self._segments)
        self._cells = Counter(segment.cell for segment in self._segments)
