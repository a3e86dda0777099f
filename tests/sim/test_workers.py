"""Workers end with the process they work for."""

from __future__ import annotations

import select
import subprocess
import sys
from pathlib import Path

# A parent that is killed while its worker waits: the worker holds the pipe open until it ends.
_PARENT = """
import multiprocessing, os, sys, time
from adaptive_contact_sim.workers import leave_with_parent

def work(name):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(600)

if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(1, leave_with_parent) as pool:
        pool.map(work, ["once"])
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
        parent.wait(10.0)
        # Its end of the pipe closes with the last process that has it.
        assert select.select([parent.stdout], [], [], 30.0)[0], "the worker stayed"
        assert parent.stdout.read() == b""
    finally:
        parent.kill()
        parent.stdout.close()
