"""Sends refits to another process, so that no tick waits for one.

A fit in a thread of the service raises a callback's latency from 0.4 to 12 ms (measured); in a
process of its own, with one BLAS thread, it costs the service nothing but the pipe.  The process is
started with the service, as its imports take seconds, and again when it dies; one that has not
answered in a minute is killed.  A job that loses its process twice is given up and answered as
lost, so that its leg goes on asking.
"""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import threading
from collections import OrderedDict
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
        self.failures = 0  # jobs that were given up
        self.timeout_s = timeout_s  # that of the jobs to come
        self._waiting: OrderedDict[str, Job] = OrderedDict()
        self._results: dict[str, tuple[int, object]] = {}
        self._changed = threading.Condition()
        self._ending = False
        self._thread: threading.Thread | None = None
        self._process = process

    def start(self) -> None:
        """Start the process, so that the first result is no later than others."""
        with self._changed:
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="refits", daemon=True)
                self._thread.start()

    def submit(self, job: Job) -> None:
        """Queue a job; it replaces one of the same leg that still waits."""
        with self._changed:
            self._results.pop(job.leg, None)
            self._waiting[job.leg] = job
            self._changed.notify_all()
        self.start()

    def collect(self, leg: str, number: int) -> object | None:
        """Return the result of a job; None while there is none."""
        with self._changed:
            found = self._results.get(leg)
            if found is None or found[0] != number:
                return None
            del self._results[leg]
            return found[1]

    def close(self) -> None:
        """End the process; what is under way is lost."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        process = self._process  # looked at once: the thread may let go of it at any moment
        if process is not None:
            process.kill()  # the thread notices, and reaps it
        if self._thread is not None:
            self._thread.join(1.0)
        elif process is not None:
            self._end_process()

    def _work(self) -> None:
        with contextlib.suppress(OSError):  # a job that finds no process says so
            if self._process is None:
                self._process = start_process()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._waiting) or self._ending)
                if self._ending:
                    break
                leg, job = self._waiting.popitem(last=False)
            try:
                result = self._do(job)
            except Exception as fault:  # no process could be started, say; the next may be
                why = " ".join(f"{type(fault).__name__}: {fault}".split())
                _log.warning("refit given up", leg=leg, job=job.number, why=why)
                self._end_process()
                self.failures += 1
                result = result_of_lost(job)
            with self._changed:
                if leg not in self._waiting:  # else it has been superseded
                    self._results[leg] = (job.number, result)
                    self._changed.notify_all()
        self._end_process()

    def _do(self, job: Job) -> object:
        for _ in range(_TRIES):
            if self._ending:
                break
            try:
                return self._exchange(job)
            except (EOFError, BrokenPipeError, pickle.UnpicklingError):  # it died, or was killed
                self._end_process()
        self.failures += 1
        if not self._ending:
            _log.warning("refit given up", leg=job.leg, job=job.number)
        return result_of_lost(job)

    def _exchange(self, job: Job) -> object:
        """Send a job and read its result."""
        process = self._process
        if process is None:
            process = self._process = start_process()
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
        with self._changed:
            self._changed.wait_for(
                lambda: self._results.get(leg, (None,))[0] == number,
                timeout=2 * _TRIES * self.timeout_s,
            )
        return super().collect(leg, number)


def result_of_lost(job: Job) -> object:
    """Return the result that stands for a job that cannot be done."""
    if isinstance(job, RefitJob):
        return RefitResult(job.number, FitStatus.LOST)
    return job.judge({}) if isinstance(job, MotionJob) else None
