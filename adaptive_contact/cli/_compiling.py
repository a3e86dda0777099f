"""Compiles the tick before a command needs it, and says so where it takes time."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Final

from adaptive_contact import __version__
from adaptive_contact.cli._output import print_note

if TYPE_CHECKING:
    from adaptive_contact.robot import Robot
    from adaptive_contact.service.link import Link

# Ctrl-C reaches it, too, and has nothing to say of it.
_CODE: Final = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_DFL); "
    "from adaptive_contact.core.bank import compile_ahead; compile_ahead()"
)


def compile_tick(stop: threading.Event | None = None) -> None:
    """Load the compiled tick; the first start after an installation compiles it, and says so.

    Args:
        stop: ends it early: nothing is loaded then.
    """
    from adaptive_contact.compiled import cache_folder, compiles, is_cached
    from adaptive_contact.core.bank import compile_ahead

    if not compiles():
        why = f"numba, which has builds for 64 bits only, is not installed ({platform.machine()})"
        if os.environ.get("NUMBA_DISABLE_JIT"):
            why = "NUMBA_DISABLE_JIT is set"
        print_note(f"{why}: ticks run as plain Python, too slow for a robot that walks")
        return
    line = first_start()
    if line is not None:
        print_note(line)
        if cache_folder():
            began_s = time.monotonic()
            # In a process of its own: the compiler would keep 200 MB for as long as this one runs.
            _run_until(stop or threading.Event(), [sys.executable, "-c", _CODE])
            if is_cached():
                print_note(f"compiled after {time.monotonic() - began_s:.0f} s")
    if stop is None or not stop.is_set():
        compile_ahead()


def first_start() -> str | None:
    """Return what is compiled before the first tick, and for how long; None where nothing is."""
    from adaptive_contact.compiled import cache_folder, compiles, is_cached

    if not compiles() or is_cached():
        return None
    kept = "once" if cache_folder() else "at each start, as no folder could be had to keep it in"
    how_long = "half a minute on a PC, minutes on a small computer"
    return f"compiling the arithmetic of a tick for this computer, {kept}: {how_long}"


def compile_in_view(
    line: str, link: Link, robot: Robot, baseline: str | None, stop: threading.Event
) -> None:
    """Compile the tick, and meanwhile publish what :func:`first_start` says as the service's note.

    Samples that come are counted and dropped: judged later, their contacts would be late.
    """
    from adaptive_contact.service.settings import SERVICE_TOKEN
    from adaptive_contact.status import SERVICE_STATUS, LegFacts, ServiceStatus
    from adaptive_contact.wire import ALL_SERVO

    came: Counter[str] = Counter()
    samples = link.subscribe(ALL_SERVO, lambda _: came.update(["samples"]))
    status, began_s = link.publisher(SERVICE_STATUS), time.monotonic()
    link.token(SERVICE_TOKEN)
    legs = {leg: LegFacts.from_robot(robot, leg) for leg in robot.leg_ids}
    with ThreadPoolExecutor(1, "compile") as pool:
        compiled = pool.submit(compile_tick, stop)
        while not compiled.done():
            so_far_s, count = time.monotonic() - began_s, came["samples"]
            status.put(
                ServiceStatus(
                    version=__version__,
                    robot=robot.name,
                    period_s=robot.period_s,
                    baseline=baseline,
                    legs=legs,
                    uptime_s=so_far_s,
                    samples=count,
                    note=f"{line}; wait: {so_far_s:.0f} s so far, {count} samples not judged",
                )
            )
            wait([compiled], 1.0)
    samples.close()
    compiled.result()


def _run_until(stop: threading.Event, words: list[str]) -> None:
    child = subprocess.Popen(words, stdin=subprocess.DEVNULL)
    try:
        while child.poll() is None and not stop.wait(0.1):
            pass
        if child.returncode:  # a signal to all processes ends it before this one has noticed
            stop.wait(1.0)
    finally:
        child.kill()
        child.wait()
