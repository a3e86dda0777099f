"""A run that is interrupted from outside goes on, and ends with the same numbers."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

# The command itself, on a plan that takes seconds: two processes, and parts enough that some are
# left when a busy machine holds the test up between the first of them and its Ctrl-C.
_COMMAND = """
import dataclasses, signal, sys
# A suite that a shell runs in the background inherits that SIGINT is ignored; a terminal's is not.
signal.signal(signal.SIGINT, signal.default_int_handler)
from adaptive_contact_studies.paper import plan
plan.QUICK = dataclasses.replace(plan.QUICK, train_segments=240, test_segments=40)
plan._PART_SEGMENTS = 20
from adaptive_contact.cli.main import main
sys.argv = ["adaptive-contact", "paper", "--quick", "--stage", "dataset", "--stage",
            "compression", "--workers", "2", "--out", sys.argv[1]]
main()
"""
_PARTS = 14
_LIMIT_S = 240.0
# Measured times are the machine's, not the run's.
_TIMES = ("raw_s", "compressed_s", "factor_s", "library_s", "speed_up")


def start(out: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", _COMMAND, str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


def results(out: Path) -> dict[str, Any]:
    tree = json.loads((out / "results.json").read_text())
    # Where results go is told with them, and is another folder each time.
    assert tree.pop("command").startswith("adaptive-contact paper --quick --out ")
    for row in tree["compression"]:
        for name in _TIMES:
            del row[name]
    assert isinstance(tree, dict)
    return tree


def parts(out: Path) -> set[str]:
    return {p.name for p in (out / "cache").glob("data-*.npz")}


def test_a_run_stopped_by_ctrl_c_goes_on_and_ends_with_the_same_numbers(tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    first = start(broken)
    deadline = time.monotonic() + _LIMIT_S
    while not parts(broken) and first.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(first.pid, signal.SIGINT)  # as a terminal does: to the workers, too
    told, _ = first.communicate(timeout=_LIMIT_S)
    assert first.returncode == 130, told
    assert "goes on from here" in told
    assert "Traceback" not in told
    done = parts(broken)
    assert 0 < len(done) < _PARTS
    assert not (broken / "results.json").exists()
    stamps = {name: (broken / "cache" / name).stat().st_mtime_ns for name in done}

    second, unbroken = start(broken), start(whole)
    for process in (second, unbroken):
        told, _ = process.communicate(timeout=_LIMIT_S)
        assert process.returncode == 0, told
    # What was done is used, not made again.
    assert {n: (broken / "cache" / n).stat().st_mtime_ns for n in done} == stamps
    assert len(parts(broken)) == _PARTS
    assert results(broken) == results(whole)


def test_a_run_that_is_killed_leaves_no_worker_behind(tmp_path: Path) -> None:
    """Workers hold their parent's pipe: it is at its end when the last of them is gone."""
    run = start(tmp_path)
    deadline = time.monotonic() + _LIMIT_S
    while not parts(tmp_path) and run.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    run.kill()
    run.communicate(timeout=60.0)
    assert run.returncode == -signal.SIGKILL
