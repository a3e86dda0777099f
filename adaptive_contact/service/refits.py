"""Sends refits to another process, so that no tick waits for one.

A fit in a thread of the service raises a callback's latency from 0.4 to 12 ms (measured); in a
process of its own, with one BLAS thread, it costs the service nothing but the pipe.  The process is
started with the service, as its imports take seconds, and again when it dies; one that has not
answered in a minute is killed.  A job that loses its process twice is given up and answered as
lost, so that its leg goes on asking.
"""

from __future__ import annotations

import pickle
import subprocess
import threading
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Final

import structlog

from adaptive_contact.checks.watch import MotionJob
from adaptive_contact.fit import FitStatus
from adaptive_contact.fit.refit_job import Job, RefitJob, RefitResult
from adaptive_contact.service.refit_process import (
    end_process,
    start_process,
)

_log = structlog.get_logger()

JOB_TIMEOUT_S: Final = 60.0
_TRIES: Final = 2


class ProcessRefitter:
    """Does jobs one at a time in a process; at most one of each leg waits.

    Args:
        timeout_s: longest time for a job, from its first byte written to the last of its answer.
        process: the first, where there is one already; ended by :meth:`close`.
    """

    def __init__(
        self, timeout_s: float = JOB_TIMEOUT_S, *, process: subprocess.Popen[bytes] | None = None
    ) -> None:
        self.timeout_s = timeout_s  # that of the jobs to come
        self._jobs: dict[str, tuple[int, Future[object]]] = {}  # the newest of each leg
        self._thread = ThreadPoolExecutor(1, "refits")
        self._ending = False
        self._process = process

    def start(self) -> None:
        """Start the process, so that the first result is no later than others."""
        self._thread.submit(self._running)  # a job that finds no process says so

    def submit(self, job: Job) -> None:
        """Queue a job; it replaces one of the same leg that still waits.  None after the end."""
        if self._ending:
            return
        if job.leg in self._jobs:
            self._jobs[job.leg][1].cancel()
        self._jobs[job.leg] = job.number, self._thread.submit(self._do, job)

    def collect(self, leg: str, number: int) -> object | None:
        """Return the result of a job; None while there is none."""
        known, result = self._jobs.get(leg, (None, None))
        if result is None or known != number or not result.done() or result.cancelled():
            return None
        return self._jobs.pop(leg)[1].result()

    def close(self) -> None:
        """End the process; what is under way is lost.  Calling it twice is safe."""
        if self._ending:
            return
        self._ending = True
        process = self._process  # looked at once: the thread may let go of it at any moment
        if process is not None:
            process.kill()  # the thread notices, and reaps it
        wait([self._thread.submit(self._end_process)], 1.0)
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _running(self) -> subprocess.Popen[bytes]:
        """Return the process; start one where there is none."""
        if self._process is None:
            self._process = start_process()
        return self._process

    def _do(self, job: Job) -> object:
        why = ""
        for _ in range(_TRIES):
            if self._ending:
                break
            try:
                return self._exchange(job)
            except Exception as fault:  # it died, or was killed, or none could be started
                why = " ".join(f"{type(fault).__name__}: {fault}".split())
                self._end_process()
        if not self._ending:
            _log.warning("refit given up", leg=job.leg, job=job.number, why=why)
        return result_of_lost(job)

    def _exchange(self, job: Job) -> object:
        """Send a job and read its result."""
        process = self._running()
        if self._ending:  # `close` may have looked for a process before there was this one
            raise EOFError
        assert process.stdin is not None
        assert process.stdout is not None
        # A process that hangs takes no more of a job than the pipe holds (64 kB, a job may have
        # ten times that), and may stop within its answer.  Its end ends the write and the read.
        deadline = threading.Timer(self.timeout_s, process.kill)
        deadline.daemon = True
        deadline.start()
        try:
            pickle.dump(job, process.stdin)
            process.stdin.flush()
            return pickle.load(process.stdout)
        finally:
            deadline.cancel()

    def _end_process(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            end_process(process)


class WaitingRefitter(ProcessRefitter):
    """Waits for results that are asked for: a replay has no clock to keep.

    So the events are the same every time, while ticks and fits go on side by side.  The process
    is started at once, and imports what fits need with the first of them: a short recording asks
    for none, and its judgements of the motion would wait for seconds.
    """

    def __init__(self, timeout_s: float = JOB_TIMEOUT_S) -> None:
        super().__init__(timeout_s, process=start_process(prepared=False))

    def collect(self, leg: str, number: int) -> object | None:
        """Return the result of a submitted job, as soon as it is there."""
        if leg in self._jobs:
            wait([self._jobs[leg][1]], 2 * _TRIES * self.timeout_s)
        return super().collect(leg, number)


def result_of_lost(job: Job) -> object:
    """Return the result that stands for a job that cannot be done."""
    if isinstance(job, RefitJob):
        return RefitResult(job.number, FitStatus.LOST)
    return job.judge({}) if isinstance(job, MotionJob) else None
