"""Work handed to a Dask cluster: a real scheduler and two workers on loopback."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError, MissingExtraError
from adaptive_contact_sim import SimulationSettings, WalkSettings
from adaptive_contact_sim.arrays import record_arrays
from adaptive_contact_studies import cluster
from adaptive_contact_studies.workers import alone, on_cluster, worker_pool

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

Start = Callable[..., subprocess.Popen[bytes]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts a program of Dask; all of them are ended."""
    running: list[subprocess.Popen[bytes]] = []

    def begin(*words: str) -> subprocess.Popen[bytes]:
        with (tmp_path / f"log-{len(running)}").open("wb") as log:
            command = [sys.executable, "-m", "dask", *words, "--no-dashboard"]
            running.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=tmp_path))
        return running[-1]

    yield begin
    for process in reversed(running):
        process.terminate()
    for process in running:
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.fixture
def scheduler(start: Start, tmp_path: Path) -> str:
    """Address of a scheduler without workers."""
    file = tmp_path / "scheduler.json"
    start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s:
        if file.exists() and file.stat().st_size:
            address: str = json.loads(file.read_text())["address"]
            return address
        time.sleep(0.05)
    raise TimeoutError((tmp_path / "log-0").read_text())


@pytest.fixture
def workers(start: Start, scheduler: str) -> list[subprocess.Popen[bytes]]:
    """Two of them, which have joined it."""
    from distributed import Client

    # Without a nanny: a worker that is killed stays dead.
    options = ("worker", scheduler, "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1")
    own = [start(*options) for _ in range(2)]
    with Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    return own


def walk(seed: int) -> SimulationSettings:
    """One to simulate."""
    return SimulationSettings(motion=WalkSettings(), seed=seed)


def test_what_a_cluster_makes_is_what_is_made_here_though_a_worker_is_killed(
    scheduler: str, workers: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    seeds = range(6)
    with on_cluster(scheduler, tmp_path), worker_pool(1) as pool:
        assert not alone(1, 2)
        futures = {pool.submit(record_arrays, walk(seed), 2.0): seed for seed in seeds}
        found = {}
        for future in as_completed(futures):
            found[futures[future]] = future.result()
            if len(found) == 1:
                workers[0].kill()
    for seed in seeds:
        here = record_arrays(walk(seed), 2.0).legs["rf"].measured
        np.testing.assert_array_equal(found[seed].legs["rf"].measured, here)
    assert alone(1, 2)


def test_what_cannot_work_is_one_line(
    start: Start, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(folder: Path | None = tmp_path, at: str = scheduler) -> str:
        with (
            pytest.raises(ConfigurationError) as caught,
            on_cluster(at, folder),
            worker_pool(2) as pool,
        ):
            pool.submit(record_arrays, walk(0), 2.0)
        line = str(caught.value)
        assert at in line
        assert "\n" not in line
        return line

    assert "it has no workers; start `dask worker" in refused()
    from distributed import Client

    several = start("worker", scheduler, "--nthreads", "2", "--no-nanny", "--host", "127.0.0.1")
    with Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=60)
    assert "has 2 threads; start it with --nthreads 1" in refused()
    several.terminate()
    several.wait(10)
    start("worker", scheduler, "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1")
    with Client(scheduler, set_as_default=False) as client:
        while set(client.nthreads().values()) != {1}:
            time.sleep(0.05)
    monkeypatch.setattr(cluster, "same_here", lambda: {"adaptive-contact": "other"})
    assert "has another adaptive-contact" in refused()
    monkeypatch.undo()
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    assert "no scheduler of Dask answers there" in refused(at="tcp://127.0.0.1:9")


def test_a_worker_that_lacks_something_is_told_what_to_install() -> None:
    here = cluster.same_here()
    lacking = ModuleNotFoundError("No module named 'mujoco'", name="mujoco")
    assert "lacks mujoco; install there" in str(cluster.why_not(lacking, here, None))
    assert "cannot be asked (gone)" in str(cluster.why_not(OSError("gone"), here, None))
    seen = {**here, "sees": False}
    assert "does not see out; give an --out" in str(cluster.why_not(seen, here, Path("out")))
    assert cluster.why_not({**here, "sees": True}, here, Path("out")) is None


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(MissingExtraError, match=r"pip install 'adaptive-contact\[cluster\]'"),
        on_cluster("tcp://127.0.0.1:9", tmp_path),
        worker_pool(2),
    ):
        pass


@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.usefixtures("workers")
def test_a_run_on_a_cluster_goes_on_after_an_interruption_and_ends_with_the_same_figures(
    scheduler: str, tmp_path: Path
) -> None:
    def command(out: str, *more: str) -> list[str]:
        run = [sys.executable, "-m", "adaptive_contact", "scenarios", "run", "step-offset3"]
        return [*run, "--quick", "--no-pages", "--out", str(tmp_path / out), *more]

    far = command("far", "--scheduler", scheduler)
    with subprocess.Popen(far, stderr=subprocess.PIPE, cwd=tmp_path) as first:
        while not list((tmp_path / "far").glob("re*/*.npz")) and first.poll() is None:
            time.sleep(0.05)
        first.send_signal(signal.SIGINT)
        assert first.wait(60) in (0, 130)
    for one in (far, command("here")):
        subprocess.run(one, check=True, cwd=tmp_path, env=dict(os.environ), capture_output=True)
    ours, theirs = ((tmp_path / o / "results-quick.json").read_bytes() for o in ("here", "far"))
    assert ours == theirs
