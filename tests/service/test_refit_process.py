"""The process that refits, by itself."""

from __future__ import annotations

import os
import subprocess
import threading
import time

from adaptive_contact.priority import take_priority
from adaptive_contact.service.refit_process import end_process, start_process


def test_in_a_hurry_it_runs_before_no_ordinary_process() -> None:
    """Nor while it loads, where the service was started before all of them."""
    found: list[subprocess.Popen[bytes]] = []

    def hurried() -> None:
        take_priority()
        found.append(start_process(hurry=True))

    starter = threading.Thread(target=hurried)
    starter.start()
    starter.join()
    (process,) = found
    seen: set[tuple[int, int]] = set()
    last = (os.SCHED_OTHER, min(os.getpriority(os.PRIO_PROCESS, 0) + 5, 19))
    until = time.monotonic() + 30
    try:
        while last not in seen:
            assert time.monotonic() < until
            of = os.sched_getscheduler(process.pid), os.getpriority(os.PRIO_PROCESS, process.pid)
            seen.add(of)
            time.sleep(0.001)
    finally:
        end_process(process)
    # It loads for a second: the two states before that take a hundredth of it.
    assert (os.SCHED_OTHER, os.getpriority(os.PRIO_PROCESS, 0)) in seen
