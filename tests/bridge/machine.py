"""What the computer under a benchmark does: who takes its processors, and when they stand still."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

# Half of a control period: with less, a cycle is late but not missed.
STALL_MS = 10.0


class Stall(NamedTuple):
    """A time in which a processor ran nothing, monotonic."""

    begin_s: float
    end_s: float


class Workers:
    """The kernel's workers for terminals, before ordinary processes for a while."""

    def __init__(self) -> None:
        self._raised: set[int] = set()

    def raise_all(self) -> None:
        """Raise those that there are now; they come and go."""
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit() or int(entry.name) in self._raised:
                continue
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                if (entry / "comm").read_text().startswith("kworker/u"):
                    os.sched_setscheduler(int(entry.name), os.SCHED_RR, os.sched_param(30))
                    self._raised.add(int(entry.name))

    def lower_all(self) -> None:
        """As they were."""
        for number in self._raised:
            with contextlib.suppress(ProcessLookupError):
                os.sched_setscheduler(number, os.SCHED_OTHER, os.sched_param(0))
        self._raised.clear()


class Computer:
    """What share of the computer was idle, and what share was taken by other guests."""

    def __init__(self) -> None:
        self._before = self._read()

    @staticmethod
    def _read() -> np.ndarray:
        return np.array(Path("/proc/stat").read_text().split("\n")[0].split()[1:9], dtype=float)

    def __str__(self) -> str:
        spent = self._read() - self._before
        share = 100 * spent / spent.sum()
        return f"computer: {share[3] + share[4]:.0f} % idle, {share[7]:.1f} % taken by its host"


class Stalls:
    """Times at which a processor stood still for everybody: its host had taken it.

    A sleeper on each processor, before everything else there is, wakes every 5 ms; where it wakes
    late, nobody on that processor could have run.
    """

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipes = []
        self._sleepers = []
        for processor in sorted(os.sched_getaffinity(0)):
            ours, theirs = context.Pipe()
            self._pipes.append(ours)
            self._sleepers.append(context.Process(target=sleep_and_wake, args=(theirs, processor)))
            self._sleepers[-1].start()
            theirs.close()
        for pipe in self._pipes:
            pipe.recv()

    def end(self) -> list[Stall]:
        """End the sleepers; what they saw."""
        for pipe in self._pipes:
            pipe.send("end")
        late = [pipe.recv() for pipe in self._pipes]
        for sleeper in self._sleepers:
            sleeper.join()
        return [stall for stalls in late for stall in stalls]


def sleep_and_wake(pipe: Connection, processor: int) -> None:
    """Wake every 5 ms until told to end; the target of a spawned process."""
    os.sched_setaffinity(0, {processor})
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(60))
    gc.disable()
    pipe.send("up")
    late: list[Stall] = []
    while not pipe.poll(0):
        due = time.monotonic() + 0.005
        time.sleep(0.005)
        now = time.monotonic()
        if now - due > STALL_MS / 1000:
            late.append(Stall(due, now))
    pipe.send(late)
