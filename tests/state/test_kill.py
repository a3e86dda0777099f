"""kill -9 at any instant: the state opens, and holds at least what was said to be saved."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.service.state import Record, StateStore

SAVER = Path(__file__).with_name("saver.py")
LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")


def numbers(folder: Path) -> list[int]:
    """What each leg would go on from; every file that is there must be whole."""
    spec = importlib.util.spec_from_file_location("saver", SAVER)
    assert spec is not None
    assert spec.loader is not None
    saver = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(saver)
    store = StateStore.open(folder, "mini")
    assert store.trouble is None, "a killed service must not keep its folder locked"
    found = []
    for leg in LEGS:
        records = [record for _, record in store.candidates(saver.identity(leg))]
        assert records, leg
        for record in records:
            assert isinstance(record, Record), (leg, record)
            number = record.body["number"]
            assert record.body["rows"] == bytes([number % 251]) * 300_000
        found.append(records[0].body["number"])
    store.close()
    return found


def kill_over_and_over(folder: Path, kills: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    paths = os.pathsep.join(path for path in sys.path if path)
    newest = 0
    said = 0  # rounds that were wholly on disk
    for _ in range(kills):
        with subprocess.Popen(
            [sys.executable, "-u", str(SAVER), str(folder), str(newest + 1)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": paths},
        ) as process:
            assert process.stdout is not None
            # Not before a first round: until then there may be nothing to open.
            for _ in range(1 if said else 2):
                process.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.1))  # the instant of the kill, not a synchronisation
            process.kill()
            lines = process.stdout.read().split()
        said = max([said, *(int(line) for line in lines if line.isdigit())])
        found = numbers(folder)
        assert min(found) >= said, "what was said to be on disk is there"
        newest = max(found)


@pytest.mark.e2e
@pytest.mark.timeout(1800)
def test_random_kills(tmp_path: Path) -> None:
    """A few; ``KILLS=100 pytest tests/state/test_kill.py`` for as many as were asked for."""
    kill_over_and_over(tmp_path, int(os.environ.get("KILLS", "4")), seed=1)
