"""All stages of a run on a plan that takes a minute, interrupted again and again."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from threadpoolctl import threadpool_limits

from adaptive_contact.model import Window, tail
from adaptive_contact_studies import cache
from adaptive_contact_studies.paper import identification, models
from adaptive_contact_studies.paper.analytical import Gains
from adaptive_contact_studies.paper.plan import QUICK
from adaptive_contact_studies.paper.run import STAGES, run_paper
from adaptive_contact_studies.paper.tables import write_document

TINY = dataclasses.replace(
    QUICK,
    legs=("rf", "lm"),
    train_segments=120,
    test_segments=60,
    train_s={"descent": 20.0},
    tune_s={"descent": 10.0},
    train_hung_s={"descent": 20.0},
    tune_hung_s={"descent": 15.0},
    free_s={"descent": 10.0},
    stand_s={"descent": 8.0},
    touch_s={"hard": 20.0, "hard slow": 12.0},
    tune_touch_s={"hard": 10.0},
    collisions=2,
)
# Measured times are the machine's, not the run's.
_TIMES = ("raw_s", "compressed_s", "factor_s", "library_s", "speed_up")
_WRITES_A_RUN = 9
# Of a tail: what is fitted to so few ticks is no threshold to be trusted, but it is one.
_EXCEEDANCES = 5


@pytest.fixture
def quick_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few λ, windows and ticks, and the observer's gains given: what is slow and no matter here."""
    monkeypatch.setattr(tail, "MIN_EXCEEDANCES", _EXCEEDANCES)
    small = Window(past_measured=1, past_desired=1, preview=0)
    monkeypatch.setattr(identification, "LAMBDAS", (0.01, 5.0))
    monkeypatch.setattr(identification, "OUR_LAMBDAS", (0.0, 0.3))
    monkeypatch.setattr(identification, "CONVENTIONS", (("rad", True, small),))
    monkeypatch.setattr(identification, "_WINDOWS", (("servo", (3, 3, 0)),))
    gains = Gains(np.array([0.2, 0.4, 0.4]), np.full(3, 0.8))
    monkeypatch.setattr(models, "tune_gains", lambda *_: gains)


def write_arm(path: Path) -> None:
    """Six motions of two servos of limited speed."""
    rng = np.random.default_rng(6)
    t = np.arange(300) * 0.02
    arrays = {}
    for i in range(6):
        goal = np.sin(2.0 * np.pi * rng.uniform(0.2, 1.2, 2) * t[:, None])
        position = np.zeros_like(goal)
        for k in range(len(t) - 1):
            error = np.clip((goal[k] - position[k]) / 0.16, -1.0, 1.0)
            position[k + 1] = position[k] + 0.08 * error
        noisy = position + rng.normal(scale=1e-3, size=position.shape)
        arrays |= {f"m{i}/t": t, f"m{i}/goal": goal, f"m{i}/pos": noisy}
    np.savez(path, **arrays)


def run(out: Path, logs: Path) -> dict[str, Any]:
    with threadpool_limits(1):
        results = run_paper(out, TINY, workers=1, logs=logs, console=Console(quiet=True))
    assert results == json.loads((out / "results.json").read_text())
    for row in results["compression"]:
        for name in _TIMES:
            del row[name]
    return results


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.usefixtures("quick_fits")
def test_a_run_interrupted_at_every_stage_ends_with_the_same_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = tmp_path / "arm.npz"
    write_arm(logs)
    write, left = cache.write_file, 0

    def interrupted(path: Path, data: bytes | str, *, advice: str) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        write(path, data, advice=advice)

    broken, interruptions, results = tmp_path / "broken", 0, None
    with monkeypatch.context() as patched:
        patched.setattr(cache, "write_file", interrupted)
        while results is None:
            left = _WRITES_A_RUN
            try:
                results = run(broken, logs)
            except KeyboardInterrupt:
                interruptions += 1
                assert not (broken / "results.json").exists()
    assert interruptions > 2
    assert set(STAGES) <= set(results)

    # The recordings are the same files; everything made of them is made anew, in one go.
    whole = tmp_path / "whole"
    (whole / "cache").mkdir(parents=True)
    for recording in (broken / "cache").glob("data-*"):
        (whole / "cache" / recording.name).write_bytes(recording.read_bytes())
    assert run(whole, logs) == results

    figures = results["detection"]["figures"]
    assert set(results["detection"]["detectors"]) >= {"default", "ungated"}
    assert figures["default"]["summary"]["rows"]["headline"]["touches"] > 5
    assert len(results["workspace"]["by_leg_run"]) == len(TINY.leg_runs)
    assert results["logs"]["recordings"] == 6
    document = tmp_path / "docs" / "paper.md"
    write_document(results | {"compression": None}, document, tmp_path / "docs" / "pictures")
    text = document.read_text()
    for picture in ("roc", "tails", "limits", "residual-map", "collision", "sweep", "responses"):
        assert f"pictures/paper-{picture}.png" in text
    assert "nan" not in text.lower().split()
