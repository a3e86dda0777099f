"""Sets a process' priority before, or behind, the other work of a computer."""

from __future__ import annotations

import contextlib
import os
import sys


def raise_priority(below: int = 0) -> str | None:
    """Run this thread, and those it makes, before all ordinary ones.

    Args:
        below: by how much to stand back behind others that call this.

    Returns:
        The reason where that is not allowed.
    """
    if not hasattr(os, "sched_setscheduler"):
        return "this system lets no process run before others; leave --realtime out"
    try:
        # Among real-time threads, below those of the kernel's interrupts (50).
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(20 - below))
    except PermissionError:
        return (
            "no right to real-time priority; give it with: sudo setcap cap_sys_nice+ep "
            f"{os.path.realpath(sys.executable)}, or leave --realtime out"
        )
    return None


def yield_priority(nice: int) -> None:
    """Run this process before no ordinary one, whatever started it.

    Args:
        nice: added to the niceness, 0 to 19.
    """
    # Some systems have neither.
    with contextlib.suppress(OSError, AttributeError):
        if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError, AttributeError):
        os.nice(nice)
