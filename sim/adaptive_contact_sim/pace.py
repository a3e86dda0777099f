"""Keeping time: a tick every so often, without drift."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event

__all__ = ["Pace"]

# Further behind than this, lost time is let go instead of caught up in a burst.
_LET_GO_S = 0.5


class Pace:
    """Waits for the next tick's moment; moments lie on a grid fixed at the start.

    Args:
        period_s: between ticks, of the wall clock; 0 for as fast as possible.
        clock: monotonic seconds.
    """

    def __init__(self, period_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._period_s = period_s
        self._clock = clock
        self._start = clock()
        self._next = self._start
        self.ticks = 0
        self.late = 0

    @property
    def elapsed_s(self) -> float:
        """Wall clock time since the start."""
        return self._clock() - self._start

    def wait(self, stop: Event) -> bool:
        """Wait until the next tick is due.

        Args:
            stop: ends the waiting when set.

        Returns:
            False when stopped.
        """
        self.ticks += 1
        if self._period_s == 0.0:
            return not stop.is_set()
        self._next += self._period_s
        ahead = self._next - self._clock()
        if ahead > 0.0:
            return not stop.wait(ahead)
        self.late += 1
        if ahead < -_LET_GO_S:
            self._next = self._clock()
        return not stop.is_set()
