"""Compiles the tick before a command needs it, and says so where it takes time."""

from __future__ import annotations

import os
import platform
import resource
import subprocess
import sys
import threading
import time
from typing import Final

from adaptive_contact.cli._output import say_note

# Ctrl-C reaches it, too, and has nothing to say of it.
_CODE: Final = (
    "import signal; signal.signal(signal.SIGINT, signal.SIG_DFL); "
    "from adaptive_contact.bank import compile_ahead; compile_ahead()"
)


def compile_tick(stop: threading.Event | None = None) -> None:
    """Load the compiled tick; the first start after an installation compiles it, and says so.

    Args:
        stop: ends it early: nothing is loaded then.
    """
    from adaptive_contact.bank import compile_ahead
    from adaptive_contact.compiled import (
        cache_folder,
        compiles,
        compiling_s,
        is_cached,
        note_compiled,
    )

    if not compiles():
        why = f"numba, which has builds for 64 bits only, is not installed ({platform.machine()})"
        if os.environ.get("NUMBA_DISABLE_JIT"):
            why = "NUMBA_DISABLE_JIT is set"
        say_note(f"{why}: ticks run as plain Python, too slow for a robot that walks")
        return
    if not is_cached():
        kept = "at each start, as no folder could be had to keep it in"
        if cache_folder():
            kept = "once"
        how_long = f"{_about(compiling_s())} of one core, longer beside other work"
        say_note(f"compiling the arithmetic of a tick for this computer, {kept}: {how_long}")
        if cache_folder():
            began_s, before_s = time.monotonic(), _children_s()
            # In a process of its own: the compiler would keep 200 MB for as long as this one runs.
            _run_until(stop or threading.Event(), [sys.executable, "-c", _CODE])
            if is_cached():
                note_compiled(_children_s() - before_s)
                say_note(f"compiled after {time.monotonic() - began_s:.0f} s")
    if stop is None or not stop.is_set():
        compile_ahead()


def _about(seconds: float) -> str:
    """Round a time that is estimated."""
    step = 1 if seconds < 10.0 else 5 if seconds < 60.0 else 30
    return f"about {max(round(seconds / step) * step, 1)} s"


def _children_s() -> float:
    """Return the CPU time of processes that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _run_until(stop: threading.Event, words: list[str]) -> None:
    child = subprocess.Popen(words, stdin=subprocess.DEVNULL)
    try:
        while child.poll() is None and not stop.wait(0.1):
            pass
    finally:
        child.kill()
        child.wait()
