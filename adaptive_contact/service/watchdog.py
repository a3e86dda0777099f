"""Watches worker and publisher from outside, and reports when they hang.

A worker that stands still is reported after a second (the log and ServiceStatus), an event whose
put blocks after half a second.  After half a minute of either, the process ends with exit code 70
and every thread's stack on stderr, for whatever started it to restart it: state is on disk, and
a service that only looks alive is of no use.

What the worker hangs on, the watchdog must not: the network and the reader of the log are only
spoken to on other threads, and the end waits for neither.  Code that keeps Python's lock for
ever stops this thread too.  What could end the process all the same (faulthandler's timer) goes
by the clock, and would end one that was only stopped and continued; so nothing does.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Final

import structlog

_log = structlog.get_logger()

LOOK_S: Final = 0.25
STALL_S: Final = 1.0


def _since_boot_s() -> float:
    """Read the clock that goes on in suspension, s; elsewhere than on Linux the monotonic one."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Watchdog:
    """Watches one service.

    A stall is timed in looks, not by the clock: a process that was stopped and continued (a
    laptop's lid, SIGSTOP) need not end.  The clock shows such a stop afterwards, and it is counted.

    Args:
        beat: counts up whenever the worker gets round.
        blocked_ns: how long the put under way has been going on, by monotonic time.
        on_stall: called at each look while the worker stands still, with for how long, s; once
            the watchdog is started, on a thread of its own, and not again before it returns.
        on_end: called when it has stood still, or a put has gone on, for too long.
        give_up_s: how long is too long.
        clock_s: goes on while the computer is suspended.

    Attributes:
        stalls: times that the worker, or the whole process, stood still for a second or more.
    """

    def __init__(
        self,
        beat: Callable[[], int],
        blocked_ns: Callable[[int], int],
        *,
        on_stall: Callable[[float], None],
        on_end: Callable[[], None],
        give_up_s: float = 30.0,
        clock_s: Callable[[], float] = _since_boot_s,
    ) -> None:
        self.stalls = 0
        self._beat = beat
        self._blocked_ns = blocked_ns
        self._on_stall = on_stall
        self._on_end = on_end
        self._clock_s, self._looked_s = clock_s, clock_s()
        self._last_look = round(give_up_s / LOOK_S)
        self._seen = -1
        self._still = 0  # looks in a row without a beat
        self._blocked = False
        self._blocked_looks = 0  # in a row with a put under way
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._reports: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._reporter = threading.Thread(target=self._report, name="stalls", daemon=True)

    def start(self) -> None:
        """Check the worker every quarter of a second from now on."""
        self._looked_s = self._clock_s()
        self._reporter.start()
        self._thread.start()

    def close(self) -> None:
        """Stop looking."""
        self._stop.set()
        self._reports.put(None)
        for thread in (self._thread, self._reporter):
            if thread.is_alive():
                thread.join(2 * LOOK_S)

    def check(self, now_ns: int) -> None:
        """Check process, worker and event publisher once; ``now_ns`` is monotonic."""
        before_s, self._looked_s = self._looked_s, self._clock_s()
        stopped_s = self._looked_s - before_s - LOOK_S
        if stopped_s >= STALL_S:
            self.stalls += 1
            why = "it was stopped or suspended, or got no core"
            self._queue_report(
                lambda: _log.warning("process stood still", for_s=stopped_s, why=why)
            )
        self._check_worker()
        blocked_s = self._blocked_ns(now_ns) / 1e9
        blocked = blocked_s >= 2 * LOOK_S
        if blocked and not self._blocked:
            self._queue_report(lambda: _log.warning("contact events are held up"))
        self._blocked = blocked
        self._blocked_looks = self._blocked_looks + 1 if blocked else 0
        if self._blocked_looks == self._last_look:  # Zenoh drops who hangs, and then it ends
            _try(lambda: _log.critical("an event could not be sent, ending", for_s=blocked_s))
            self._on_end()

    def _check_worker(self) -> None:
        beat = self._beat()
        if beat != self._seen:
            stood_s = self._still * LOOK_S
            if stood_s >= STALL_S:
                self._queue_report(lambda: _log.warning("worker goes on", stood_still_s=stood_s))
            self._seen, self._still = beat, 0
            return
        self._still += 1
        still_s = self._still * LOOK_S
        if self._still == self._last_look:
            _try(lambda: _log.critical("worker stood still for too long, ending", for_s=still_s))
            self._on_end()
        if still_s < STALL_S:
            return
        if still_s == STALL_S:
            self.stalls += 1
            self._queue_report(lambda: _log.error("worker stands still", for_s=still_s))
        # While the last report is under way, this one would only be old by its turn.
        if self._reports.empty():
            self._queue_report(lambda: self._on_stall(still_s))

    def _queue_report(self, what: Callable[[], None]) -> None:
        """Queue a report for the reporting thread; without one, report at once."""
        if self._reporter.ident is None:
            what()
        else:
            self._reports.put(what)

    def _report(self) -> None:
        while (what := self._reports.get()) is not None:
            what()

    def _run(self) -> None:
        while not self._stop.wait(LOOK_S):
            self.check(time.monotonic_ns())


def give_up() -> None:
    """End the process, leaving every thread's stack on stderr if that takes them in time."""
    try:
        # Into memory first: the dump keeps Python's lock, and the reader of stderr may hang.
        stacks = os.memfd_create("stacks")
        faulthandler.dump_traceback(file=stacks, all_threads=True)
        _try(lambda: _copy(stacks, sys.stderr.fileno()))
    finally:
        # EX_SOFTWARE of sysexits.h.
        os._exit(70)


def _copy(source: int, target: int) -> None:
    os.lseek(source, 0, os.SEEK_SET)
    while data := os.read(source, 65536):
        while data:
            data = data[os.write(target, data) :]


def _try(what: Callable[[], None]) -> None:
    """Call a function on a thread of its own, and continue without it if it hangs."""
    thread = threading.Thread(target=what, name="last words", daemon=True)
    with contextlib.suppress(RuntimeError):  # no room for another thread
        thread.start()
        thread.join(1.0)  # The last words, and then the stacks, are waited for so long each.
