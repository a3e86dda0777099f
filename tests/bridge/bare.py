"""A bus with nothing of ours on it: what the computer itself allows, in the same run.

A master and its servos, a process each, exchange as many packets of the same lengths as the bridge
and a port of the virtual bus do in a cycle, through a pseudo-terminal, each packet taking its time
on the wire.  Nothing is parsed, learned, published or simulated.  Where these two are late, no
program on this computer would have been in time.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import pty
import select
import time
import tty
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

# A read of an AX-12A and its answer, bytes; six servos on a port; 10 bits a byte at 1 Mbps.
ASKED, ANSWERED, SERVOS, BYTE_S = 8, 14, 6, 1e-5
PERIOD_S = 0.02
# The bridge's own among real-time threads.
PRIORITY = 20


class Bare(NamedTuple):
    """The bare bus over a whole run: times in ms, and cycles."""

    cycle_p50: float
    cycle_p99: float
    jitter_p50: float
    jitter_p99: float
    missed: int
    cycles: int

    def __str__(self) -> str:
        return (
            f"a bare bus in the same run: cycle p50 {self.cycle_p50:.2f}, p99 "
            f"{self.cycle_p99:.2f} ms; jitter p50 {self.jitter_p50:.2f}, p99 "
            f"{self.jitter_p99:.2f} ms; {self.missed} of {self.cycles} cycles missed"
        )


class BareBus:
    """The two processes, from the making to :meth:`end`.

    Args:
        realtime: run before ordinary processes, as the bridge does.
    """

    def __init__(self, *, realtime: bool) -> None:
        context = multiprocessing.get_context("spawn")
        self._servos, theirs = context.Pipe()
        self._processes = [context.Process(target=answer, args=(theirs, realtime))]
        self._processes[0].start()
        terminal = self._servos.recv()
        self._master, theirs = context.Pipe()
        self._processes.append(context.Process(target=ask, args=(theirs, terminal, realtime)))
        self._processes[1].start()

    def end(self) -> Bare:
        """End them; how they fared."""
        self._master.send("end")
        begun, ended = np.array(self._master.recv()).T
        self._servos.send("end")
        for process in self._processes:
            process.join()
        off = ended - np.rint((ended - ended[0]) / PERIOD_S) * PERIOD_S
        jitter = 1000 * np.abs(off - np.median(off))
        took = 1000 * (ended - begun)
        due = round((begun[-1] - begun[0]) / PERIOD_S) + 1
        return Bare(
            *(float(np.quantile(took, q)) for q in (0.5, 0.99)),
            *(float(np.quantile(jitter, q)) for q in (0.5, 0.99)),
            missed=due - len(took),
            cycles=due,
        )


def ask(pipe: Connection, terminal: str, realtime: bool) -> None:
    """Ask every servo once a period; the target of a spawned process."""
    _before_others(realtime)
    port = os.open(terminal, os.O_RDWR | os.O_NOCTTY)
    rows: list[tuple[float, float]] = []
    due = time.monotonic() + PERIOD_S
    while not pipe.poll(0):
        time.sleep(max(due - time.monotonic(), 0.0))
        begun = time.monotonic()
        due += max(int((begun - due) / PERIOD_S), 0) * PERIOD_S  # whole periods late: missed
        for _ in range(SERVOS):
            os.write(port, bytes(ASKED))
            _read(port, ANSWERED)
        rows.append((begun, time.monotonic()))
        due += PERIOD_S
    pipe.send(rows)
    os.close(port)


def answer(pipe: Connection, realtime: bool) -> None:
    """Answer each packet after both packets' time on the wire; the target of a spawned process."""
    _before_others(realtime)
    master, slave = pty.openpty()
    tty.setraw(slave)
    pipe.send(os.ttyname(slave))
    while not pipe.poll(0):
        if not select.select([master], [], [], 0.1)[0]:
            continue
        _read(master, ASKED)
        time.sleep((ASKED + ANSWERED) * BYTE_S)
        os.write(master, bytes(ANSWERED))


def _read(descriptor: int, size: int) -> None:
    while size > 0:
        size -= len(os.read(descriptor, size))


def _before_others(realtime: bool) -> None:
    if realtime:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    gc.disable()
