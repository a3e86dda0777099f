"""Refits in a process of their own: done, repeated when it dies, given up when that is no use."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.adapt.refit import InlineRefitter, RefitJob, RefitResult, Refitter
from adaptive_contact.identify import Factor, FitStatus
from adaptive_contact.service.refits import ProcessRefitter, WaitingRefitter

pytestmark = pytest.mark.e2e


def job(leg: str = "rf", number: int = 1) -> RefitJob:
    rng = np.random.default_rng(7)
    coefficients = np.array([[1.0, 0.0], [0.0, -2.0], [0.5, 0.0]])
    fit, held_out = Factor(3, 2), Factor(3, 2)
    for factor in (fit, held_out):
        theta = rng.normal(size=(200, 3))
        factor.add(theta, theta @ coefficients + rng.normal(scale=0.01, size=(200, 2)))
    return RefitJob(leg, number, fit, held_out, np.full(2, 0.01))


@dataclasses.dataclass(frozen=True)
class Stubborn:
    """A job that ends, or holds up, the process that does it, so many times."""

    leg: str
    number: int
    tries: str
    allowed: int

    def run(self) -> str:
        path = Path(self.tries)
        count = len(path.read_text()) if path.exists() else 0
        path.write_text("x" * (count + 1))
        if count < self.allowed:
            os.kill(os.getpid(), signal.SIGKILL)
        return "done"


@dataclasses.dataclass(frozen=True)
class Endless(RefitJob):
    """A fit that never ends."""

    def run(self) -> RefitResult:
        while True:
            time.sleep(1.0)


@pytest.fixture
def refitter(monkeypatch: pytest.MonkeyPatch) -> Iterator[ProcessRefitter]:
    # The worker unpickles jobs of this module, which pytest imports under a name of its own.
    here = Path(__file__)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(here.parent), *map(str, _paths())]))
    for kind in (Stubborn, Endless):
        monkeypatch.setattr(kind, "__module__", here.stem)
    import sys

    monkeypatch.setitem(sys.modules, here.stem, sys.modules[__name__])
    made = ProcessRefitter(timeout_s=20.0)
    yield made
    made.close()


def _paths() -> list[str]:
    import sys

    return [path for path in sys.path if path]


def wait(refitter: Refitter, leg: str, number: int) -> object:
    until = time.monotonic() + 30
    while (found := refitter.collect(leg, number)) is None:
        assert time.monotonic() < until
        time.sleep(0.01)
    return found


def test_the_result_is_that_of_a_refit_in_line(refitter: ProcessRefitter) -> None:
    inline = InlineRefitter()
    inline.submit(job())
    expected = inline.collect("rf", 1)
    assert isinstance(expected, RefitResult)
    refitter.submit(job())
    found = wait(refitter, "rf", 1)
    assert isinstance(found, RefitResult)
    assert found.status is FitStatus.OK
    assert np.array_equal(found.coefficients, expected.coefficients)
    assert refitter.collect("rf", 1) is None, "a result is given once"
    # The process is killed between two jobs: the next one starts another.
    assert refitter._process is not None
    refitter._process.kill()
    refitter.submit(job("lf", 5))
    assert isinstance(wait(refitter, "lf", 5), RefitResult)
    assert refitter.failures == 0


def test_a_replay_waits_for_its_results() -> None:
    inline = InlineRefitter()
    with contextlib.closing(WaitingRefitter(timeout_s=20.0)) as refitter:
        for number in (1, 2):
            for leg in ("rf", "lf"):
                inline.submit(job(leg, number))
                refitter.submit(job(leg, number))
            for leg in ("lf", "rf"):
                expected, found = inline.collect(leg, number), refitter.collect(leg, number)
                assert isinstance(expected, RefitResult)
                assert isinstance(found, RefitResult)
                assert np.array_equal(found.coefficients, expected.coefficients)


def test_a_replay_without_refits_leaves_no_process() -> None:
    refitter = WaitingRefitter()
    process = refitter._process
    assert process is not None
    refitter.close()
    assert process.poll() is not None


def test_a_job_that_kills_its_process_once_is_repeated(
    refitter: ProcessRefitter, tmp_path: Path
) -> None:
    refitter.submit(Stubborn("rf", 1, str(tmp_path / "tries"), allowed=1))
    assert wait(refitter, "rf", 1) == "done"
    assert refitter.failures == 0


def test_a_job_that_takes_too_long_is_answered_as_failed(refitter: ProcessRefitter) -> None:
    refitter._timeout_s = 1.0
    endless = Endless(**{f.name: getattr(job(), f.name) for f in dataclasses.fields(RefitJob)})
    refitter.submit(endless)
    found = wait(refitter, "rf", 1)
    assert isinstance(found, RefitResult)
    assert found.status is FitStatus.NOT_FINITE
    assert refitter.failures == 1


def test_only_the_newest_job_of_a_leg_waits() -> None:
    refitter = ProcessRefitter()
    refitter._thread = object()  # type: ignore[assignment]  # nothing is done
    for number in range(1, 50):
        refitter.submit(job("rf", number))
        refitter.submit(job("lf", number))
    assert [(leg, one.number) for leg, one in refitter._waiting.items()] == [("rf", 49), ("lf", 49)]
    assert refitter.collect("rf", 1) is None
