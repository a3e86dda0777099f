"""How long a thread that is woken waits for a core; a script, not a test.

    python tests/service/bench_wake.py [--times N]

An event passes through three threads and more on its way.  Here three wake each other, beside
processes that compute without a pause, and the time from the first being woken to the last running
is taken.  With as many such processes as cores it shows what ``--realtime`` is for: kernels of
today let an ordinary thread wait for the next tick of the scheduler, up to 4 ms.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

from adaptive_contact.priority import take_priority

TIMES = 600
LINKS = 3
# Niceness of those that compute: that of the process that refits.
NICE = 5

COMPUTE = "import os; os.nice({nice}); {idle}\nwhile True: pass"
IDLE = "os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))"


@contextlib.contextmanager
def computing(count: int, *, idle: bool) -> Iterator[None]:
    """As many processes that compute; ended at the end."""
    code = COMPUTE.format(nice=NICE, idle=IDLE if idle else "pass")
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", code]))
            stack.callback(process.kill)
        time.sleep(0.3)  # a benchmark may: they start
        yield


def waits(times: int, *, realtime: bool) -> list[float] | None:
    """From the first being woken to the last running, ms, sorted; None where not allowed."""
    found: list[float] = []
    refused: list[str] = []
    gates = [threading.Semaphore(0) for _ in range(LINKS)]
    woken_ns = 0
    ended = threading.Event()

    def link(number: int) -> None:
        while True:
            gates[number].acquire()
            if ended.is_set():
                return
            if number + 1 < LINKS:
                gates[number + 1].release()
            else:
                found.append((time.monotonic_ns() - woken_ns) / 1e6)

    def wake() -> None:
        nonlocal woken_ns
        why = take_priority() if realtime else None
        if why is not None:
            refused.append(why)
            return
        threads = [threading.Thread(target=link, args=(number,)) for number in range(LINKS)]
        for thread in threads:
            thread.start()
        for number in range(times):
            time.sleep(0.012 + 0.0004 * (number % 10))
            woken_ns = time.monotonic_ns()
            gates[0].release()
        time.sleep(0.1)
        ended.set()
        for gate in gates:
            gate.release()
        for thread in threads:
            thread.join()

    waker = threading.Thread(target=wake)
    waker.start()
    waker.join()
    return None if refused else sorted(found)


def main(times: int) -> None:
    """Print a row per company."""
    cores = len(os.sched_getaffinity(0))
    print(f"{cores} cores, {times} times, ms")
    for count, idle, realtime in (
        (0, False, False),
        (cores - 1, False, False),
        (cores, False, False),
        (cores, True, False),
        (cores, False, True),
    ):
        with computing(count, idle=idle):
            found = waits(times, realtime=realtime)
        name = f"beside {count} that compute" if count else "alone"
        name += ", of idle priority" if idle else ""
        name += ", of real-time priority itself" if realtime else ""
        if found is None:
            print(f"{name:52s} not allowed here")
            continue
        n = len(found)
        quantiles = (found[n // 2], found[int(0.95 * n)], found[int(0.99 * n)], found[-1])
        print(f"{name:52s} p50 {quantiles[0]:.2f}  p95 {quantiles[1]:.2f}  p99 {quantiles[2]:.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="how long a woken thread waits for a core")
    parser.add_argument("--times", type=int, default=TIMES)
    main(parser.parse_args().times)
