"""When events came, against when their samples did.

An event is right by the time it carries, however late it is on the wire; a leg that waits for it
is not helped.  The simulator's clock begins with the process and not with the first tick, and
stands still where the machine lets it wait, so an event is timed from when the samples of its
own second came here at the soonest, by the same wall clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact.wire import NS_PER_S

# An honest event takes some ms; a busy machine's scheduler some tens.
LATE_S: Final = 0.25


class SourceClock:
    """From the wall clock of this process to the clock of the samples.

    Args:
        lags_ns: by second of the samples' clock, least arrival of a sample minus its time, ns; of
            one second at least.
    """

    def __init__(self, lags_ns: Mapping[int, int]) -> None:
        self._seconds = np.array(sorted(lags_ns), dtype=np.int64)
        self._lags_ns = np.array([lags_ns[second] for second in self._seconds], dtype=np.int64)

    @property
    def behind_s(self) -> float:
        """How far the source fell behind, from its best second to its worst."""
        return float(np.ptp(self._lags_ns)) / NS_PER_S

    def lag_ns(self, t_ns: int) -> int:
        """Of a sample's time; in an outage that of the second before it."""
        at = int(np.searchsorted(self._seconds, t_ns // NS_PER_S, side="right")) - 1
        return int(self._lags_ns[max(at, 0)])

    def of_wall(self, wall_ns: int) -> int:
        """The samples' clock at a moment of the wall clock."""
        # Lags are small against the time between two changes of them: one step is enough.
        return wall_ns - self.lag_ns(wall_ns - self.lag_ns(wall_ns))


def judge_arrivals(
    arrived: Iterable[tuple[int, int]],
    clock: SourceClock,
    windows: Sequence[tuple[int, int]],
) -> dict[str, float]:
    """Time the events: how many, how many came later than 0.25 s, the slowest, s.

    Args:
        arrived: of each event, wall clock of its arrival and the time of its sample, ns.
        clock: of the source.
        windows: begin and end, ns of the samples' clock, in which events may be late.
    """
    took_s = np.array(
        [
            (at_ns - t_ns - clock.lag_ns(t_ns)) / NS_PER_S
            for at_ns, t_ns in arrived
            if not any(begin <= t_ns <= end for begin, end in windows)
        ]
    )
    slowest = {f"p{p}_s": float(np.percentile(took_s, p)) for p in (99, 100) if len(took_s)}
    return {"events": len(took_s), "late": int(np.sum(took_s > LATE_S)), **slowest}
