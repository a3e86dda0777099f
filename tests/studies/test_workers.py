"""Workers end with the process they work for, and compute in one thread."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from pathlib import Path

from adaptive_contact.service.refit_process import ONE_BLAS_THREAD

# A parent that is killed while its worker waits: the worker holds the pipe open until it ends.
_PARENT = """
import os, time
from adaptive_contact_studies.workers import worker_pool

def work(name):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(600)

if __name__ == "__main__":
    with worker_pool(1) as pool:
        pool.submit(work, "once").result()
"""

_THREADS = """
import os
import numpy
from threadpoolctl import threadpool_info
from adaptive_contact_studies.workers import worker_pool

def threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]

if __name__ == "__main__":
    with worker_pool(1) as pool:
        print(pool.submit(threads).result())
    print([os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("OMP_NUM_THREADS")])
"""


def test_a_worker_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE)
    assert parent.stdout is not None
    try:
        assert select.select([parent.stdout], [], [], 60.0)[0], "no worker came up"
        worker = int(parent.stdout.readline())
        assert worker != parent.pid
        parent.kill()
        parent.wait(60.0)
        # Its end of the pipe closes with the last process that has it.
        assert select.select([parent.stdout], [], [], 30.0)[0], "the worker stayed"
        assert parent.stdout.read() == b""
    finally:
        parent.kill()
        parent.stdout.close()


def test_a_worker_computes_in_one_thread_and_its_parent_as_before(tmp_path: Path) -> None:
    """Threads that spin took a third of the scenarios' replays on two cores."""
    script = tmp_path / "parent.py"
    script.write_text(_THREADS)
    env = {name: value for name, value in os.environ.items() if name not in ONE_BLAS_THREAD}
    ran = subprocess.run(
        [sys.executable, script],
        env=env | {"OMP_NUM_THREADS": "3"},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=True,
    )
    threads, environment = ran.stdout.splitlines()
    found = json.loads(threads)
    assert found, "a worker without BLAS says nothing here"
    assert set(found) == {1}
    assert environment == "[None, '3']"
