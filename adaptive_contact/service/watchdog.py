"""Looks at the worker and the outbox from outside, for they cannot say that they hang.

A worker that stands still is told of after a second (the log and ServiceStatus); after half a
minute the process ends with exit code 70 and every thread's stack on stderr, for whatever
started it to start it anew: state is on disk, and a service that only looks alive helps nobody.
"""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Final

import structlog

__all__ = ["EXIT_CODE", "Watchdog", "give_up"]

_log = structlog.get_logger()

LOOK_S: Final = 0.25
STALL_S: Final = 1.0
GIVE_UP_S: Final = 30.0
# EX_SOFTWARE of sysexits.h.
EXIT_CODE: Final = 70


class Watchdog:
    """Watches one service.

    Time is counted in looks, not by the clock: a process that was stopped and continued (a
    laptop's lid, SIGSTOP) has not stalled, its clock only went on without it.

    Args:
        beat: counts up whenever the worker gets round.
        blocked_ns: how long the put under way has been going on, by monotonic time.
        on_stall: called at each look while the worker stands still, with for how long, s.
        on_end: called when it has stood still for too long.

    Attributes:
        stalls: times that the worker stood still for a second or more.
        blocks: times that a put was seen to take half a second or more.
    """

    def __init__(
        self,
        beat: Callable[[], int],
        blocked_ns: Callable[[int], int],
        *,
        on_stall: Callable[[float], None],
        on_end: Callable[[], None],
    ) -> None:
        self.stalls = 0
        self.blocks = 0
        self._beat = beat
        self._blocked_ns = blocked_ns
        self._on_stall = on_stall
        self._on_end = on_end
        self._seen = -1
        self._still = 0  # looks in a row without a beat
        self._blocked = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="watchdog", daemon=True)

    def start(self) -> None:
        """Look every quarter of a second from now on."""
        self._thread.start()

    def close(self) -> None:
        """Stop looking."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(2 * LOOK_S)

    def look(self, now_ns: int) -> None:
        """Look once; ``now_ns`` is monotonic."""
        self._look_at_worker()
        blocked = self._blocked_ns(now_ns) >= 2 * LOOK_S * 1e9
        if blocked and not self._blocked:
            self.blocks += 1
            _log.warning("a subscriber that hangs holds up contact events")
        self._blocked = blocked

    def _look_at_worker(self) -> None:
        beat = self._beat()
        if beat != self._seen:
            if self._still * LOOK_S >= STALL_S:
                _log.warning("worker goes on", stood_still_s=self._still * LOOK_S)
            self._seen, self._still = beat, 0
            return
        self._still += 1
        still_s = self._still * LOOK_S
        if still_s < STALL_S:
            return
        if still_s == STALL_S:
            self.stalls += 1
            _log.error("worker stands still", for_s=still_s)
        self._on_stall(still_s)
        if still_s == GIVE_UP_S:
            _log.critical("worker stood still for too long, ending", for_s=still_s)
            self._on_end()

    def _work(self) -> None:
        while not self._stop.wait(LOOK_S):
            self.look(time.monotonic_ns())


def give_up() -> None:
    """End the process at once, leaving every thread's stack on stderr."""
    faulthandler.dump_traceback(file=sys.stderr, all_threads=True)
    sys.stderr.flush()
    os._exit(EXIT_CODE)
