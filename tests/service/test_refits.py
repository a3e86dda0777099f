"""Refits in a process of their own: done, repeated when it dies, given up when that is no use."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs
from threadpoolctl import threadpool_info

from adaptive_contact.fit import FitStatus
from adaptive_contact.fit.refit_job import InlineRefitter, RefitJob, RefitResult, Refitter
from adaptive_contact.model import Library
from adaptive_contact.model.leg_prior import leg_prior
from adaptive_contact.priority import raise_priority
from adaptive_contact.service import refits
from adaptive_contact.service.refit_process import end_process, start_process
from adaptive_contact.service.refits import ProcessRefitter, WaitingRefitter
from waiting import until

# A worker that reads a job and hangs within its answer.
HALF_AN_ANSWER = """
import pickle, sys, threading
pickle.load(sys.stdin.buffer)
sys.stdout.buffer.write(pickle.dumps("half" * 100)[:50])
sys.stdout.buffer.flush()
threading.Event().wait()
"""


def job(leg: str = "rf", number: int = 1) -> RefitJob:
    """Of a leg that moves as a slope of a quarter says."""
    library = Library("servo", ("a", "b"), ("yaw", "pitch"))
    window = np.random.default_rng(7).uniform(-0.4, 0.4, (400, 16))
    other = leg_prior(dataclasses.replace(library, slope_rad=0.041), 0.005).model
    target = other.library.evaluate_flat(window) @ other.coefficients
    values = np.concatenate([library.evaluate_flat(window), target], axis=1)
    return RefitJob(leg, number, values, library, 0.005)


def coefficients(found: object) -> np.ndarray:
    return found.start.model.coefficients


@dataclasses.dataclass(frozen=True)
class Large(RefitJob):
    """A fit of so many rows that the pipe does not hold it."""

    ballast: bytes = bytes(600_000)


@dataclasses.dataclass(frozen=True)
class Standing:
    """Tells how the process stands: its priority, its threads, and what it would have to import."""

    leg: str
    number: int

    def run(self) -> tuple[int, int, set[int], list[str]]:
        threads = {of["num_threads"] for of in threadpool_info() if of["user_api"] == "blas"}
        lacks = [name for name in ("pysindy.optimizers", "sklearn") if name not in sys.modules]
        return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0), threads, lacks


@pytest.fixture
def refitter(monkeypatch: pytest.MonkeyPatch) -> Iterator[ProcessRefitter]:
    # The worker unpickles jobs of this module, which pytest imports under a name of its own.
    here = Path(__file__)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(here.parent), *filter(None, sys.path)]))
    for kind in (Large, Standing):
        monkeypatch.setattr(kind, "__module__", here.stem)
    monkeypatch.setitem(sys.modules, here.stem, sys.modules[__name__])
    made = ProcessRefitter(timeout_s=120.0)
    yield made
    made.close()


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The processes that refitters started."""
    processes = []

    def start(**options: bool) -> subprocess.Popen[bytes]:
        processes.append(start_process(**options))
        return processes[-1]

    monkeypatch.setattr(refits, "start_process", start)
    return processes


def large(number: int) -> Large:
    of = job("rf", number)
    return Large(**{f.name: getattr(of, f.name) for f in dataclasses.fields(RefitJob)})


def wait(refitter: Refitter, leg: str, number: int) -> object:
    return until(lambda: refitter.collect(leg, number))


def refitted(refitter: Refitter, job: RefitJob) -> RefitResult:
    refitter.submit(job)
    found = wait(refitter, job.leg, job.number)
    assert isinstance(found, RefitResult)
    return found


@pytest.mark.e2e
def test_the_result_is_that_of_a_refit_in_line(
    refitter: ProcessRefitter, started: list[subprocess.Popen[bytes]]
) -> None:
    inline = InlineRefitter()
    inline.submit(job())
    expected = inline.collect("rf", 1)
    found = refitted(refitter, job())
    assert found.status is FitStatus.OK
    assert np.array_equal(coefficients(found), coefficients(expected))
    assert refitter.collect("rf", 1) is None, "a result is given once"
    # The process is killed between two jobs: the next one starts another.
    started[0].kill()
    assert refitted(refitter, job("lf", 5)).status is FitStatus.OK
    assert len(started) == 2


@pytest.mark.e2e
def test_a_replay_waits_for_its_results_and_leaves_no_process(
    started: list[subprocess.Popen[bytes]],
) -> None:
    inline = InlineRefitter()
    with contextlib.closing(WaitingRefitter(timeout_s=120.0)) as refitter:
        for number in (1, 2):
            for leg in ("rf", "lf"):
                inline.submit(job(leg, number))
                refitter.submit(job(leg, number))
            for leg in ("lf", "rf"):
                expected, found = inline.collect(leg, number), refitter.collect(leg, number)
                assert np.array_equal(coefficients(found), coefficients(expected))
    (process,) = started
    assert process.poll() is not None


@pytest.mark.e2e
@pytest.mark.parametrize("where", ["before the job", "within the answer"])
def test_processes_that_hang_are_given_up(
    refitter: ProcessRefitter, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = start_process

    def hangs() -> subprocess.Popen[bytes]:
        if where == "before the job":
            process = start()
            process.send_signal(signal.SIGSTOP)
        else:
            process = subprocess.Popen(
                [sys.executable, "-c", HALF_AN_ANSWER],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
        started.append(process)
        return process

    monkeypatch.setattr(refits, "start_process", hangs)
    refitter.timeout_s = 1.0
    with capture_logs() as logs:
        assert refitted(refitter, large(1)).status is FitStatus.LOST
    assert [line["event"] for line in logs] == ["refit given up"]
    assert [process.wait(60) for process in started] == [-signal.SIGKILL] * 2
    # The next job has a process of its own again.
    monkeypatch.setattr(refits, "start_process", start)
    refitter.timeout_s = 120.0
    assert refitted(refitter, job("rf", 2)).status is FitStatus.OK


@pytest.mark.e2e
def test_closing_does_not_wait_for_a_process_that_hangs(
    refitter: ProcessRefitter, started: list[subprocess.Popen[bytes]]
) -> None:
    assert refitted(refitter, job()).status is FitStatus.OK
    (hanging,) = started
    hanging.send_signal(signal.SIGSTOP)
    refitter.submit(large(2))
    until(lambda: not (select.select([], [hanging.stdin], [], 0)[1]))
    began = time.monotonic()
    refitter.close()
    assert time.monotonic() - began < 20.0
    assert hanging.wait(60) == -signal.SIGKILL


@pytest.mark.e2e
def test_a_process_that_cannot_be_started_costs_its_job_and_no_other(
    refitter: ProcessRefitter, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_memory() -> subprocess.Popen[bytes]:
        raise OSError(12, "Cannot allocate memory")

    with monkeypatch.context() as short, capture_logs() as logs:
        short.setattr(refits, "start_process", no_memory)
        assert refitted(refitter, job("rf", 1)).status is FitStatus.LOST
    assert [(line["event"], line["leg"]) for line in logs] == [("refit given up", "rf")]
    assert refitted(refitter, job("rf", 2)).status is not FitStatus.LOST


@pytest.mark.e2e
def test_the_current_folder_has_no_say_in_the_process(
    refitter: ProcessRefitter, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It may be anybody's, and what it imports there would run as the service's user."""
    (tmp_path / "numpy.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nraise SystemExit(1)")
    monkeypatch.chdir(tmp_path)
    assert refitted(refitter, job("rf", 1)).status is not FitStatus.LOST
    assert not (tmp_path / "ran").exists()


@pytest.mark.e2e
def test_it_stands_behind_others_in_one_thread_and_has_loaded_all(
    refitter: ProcessRefitter,
    started: list[subprocess.Popen[bytes]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also behind a service that runs before all ordinary processes, where that is allowed."""
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    for name in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM"):
        monkeypatch.setenv(f"{name}_NUM_THREADS", "2")

    def hurried() -> None:
        raise_priority()
        for _ in range(2):
            refitter.start()  # its thread, and the process, have what this one has

    starter = threading.Thread(target=hurried)
    starter.start()
    starter.join()
    until(lambda: started)
    refitter.submit(Standing("rf", 1))  # type: ignore[arg-type]
    assert wait(refitter, "rf", 1) == (os.SCHED_OTHER, min(nice + 5, 19), {1}, [])
    assert len(started) == 1


@pytest.mark.e2e
def test_one_that_was_started_before_is_used_and_ended(
    started: list[subprocess.Popen[bytes]],
) -> None:
    process = start_process()
    with contextlib.closing(ProcessRefitter(timeout_s=120.0, process=process)) as refitter:
        assert refitted(refitter, job("rf", 1)).status is FitStatus.OK
    assert not started, "no other was needed"
    assert process.wait(60) == -signal.SIGKILL
    end_process(process)  # once more does no harm


# -- What a leg is told of a refit that was given up


def test_a_job_after_the_end_is_dropped() -> None:
    refitter = ProcessRefitter()
    refitter.close()
    refitter.submit(job())
    assert refitter.collect("rf", 1) is None
