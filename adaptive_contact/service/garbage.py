"""Garbage is collected by hand, between ticks.

A collection holds up every thread for as long as it takes, and Python makes one when a count says
so: often in the tick of an event, in which most is made.
"""

from __future__ import annotations

import gc
from typing import Final

# The learners make no cycles (0 in 150 s of six walking legs); others may, on bad days.
_PERIOD_NS: Final = 60_000_000_000
# So many objects more than at the last collection, some 4 MB, wait for no pause.
_MOST_OBJECTS: Final = 20_000


class Sweeper:
    """Collects the garbage of a process that is in a hurry.

    Args:
        most_objects: made since the last collection, and still there, after which one is due at
            once.
    """

    def __init__(self, most_objects: int = _MOST_OBJECTS) -> None:
        self._most = most_objects
        self._swept_ns = 0

    def start(self, now_ns: int) -> None:
        """Nothing is collected by itself from now on, and what there is is not looked at again."""
        gc.collect()
        gc.freeze()
        gc.disable()
        self._swept_ns = now_ns

    def sweep(self, now_ns: int, *, pause: bool) -> None:
        """Collect if it is time.

        Args:
            now_ns: monotonic.
            pause: nothing else waits to be done.
        """
        due = pause and now_ns - self._swept_ns > _PERIOD_NS
        if due or gc.get_count()[0] > self._most:
            gc.collect()
            self._swept_ns = now_ns
