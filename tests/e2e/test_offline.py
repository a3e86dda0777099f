"""Files instead of a network: simulate, replay, score, fit, through the real command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.e2e

SIX = ("lf", "lm", "lr", "rf", "rm", "rr")


@pytest.fixture
def pose(command: Callable[..., str], tmp_path: Path) -> Path:
    """The paper's set-up for three minutes, half of the descents onto obstacles."""
    obstacles = ["--leg", "rf", "--obstacles", "0.5", "--workspace", "whole"]
    run = ["--seconds", "180", "--seed", "11", "--offline", "--record", "pose.mcap"]
    command("sim", "pose", *obstacles, *run)
    return tmp_path / "pose.mcap"


def test_pose_replay_and_score(command: Callable[..., str], pose: Path, tmp_path: Path) -> None:
    for out in ("one.jsonl", "two.jsonl"):
        command("replay", pose, "--events", out)
    events = (tmp_path / "one.jsonl").read_bytes()
    assert events == (tmp_path / "two.jsonl").read_bytes(), "the same file gives the same events"
    assert {json.loads(line)["leg"] for line in events.splitlines()} == {"rf"}

    score = json.loads(command("score", pose, "--events", "one.jsonl", "--json"))
    assert score["counted"]["touches"] > 60
    assert score["counted"]["recall"] >= 0.95
    assert score["rows"]["headline"]["latency_median_ms"] <= 20
    assert score["false_alarms"] <= 1


def test_the_simulator_is_deterministic(command: Callable[..., str], tmp_path: Path) -> None:
    run = ["sim", "walk", "--seconds", "10", "--seed", "4", "--offline", "--record"]
    for name in ("one.mcap", "two.mcap"):
        command(*run, name)
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()


def test_fit_a_baseline_and_use_it(command: Callable[..., str], pose: Path, tmp_path: Path) -> None:
    free = ["sim", "pose", "--leg", "rf", "--workspace", "whole", "--seconds", "600"]
    command(*free, "--seed", "12", "--offline", "--record", "free.mcap")
    told = command("fit", "free.mcap", "-o", "legs.json")
    assert "rf" in told
    assert "thresholds" in told
    command("replay", pose, "--events", "own.jsonl", "--baseline", "legs.json")
    score = json.loads(command("score", pose, "--events", "own.jsonl", "--json"))
    assert score["counted"]["recall"] >= 0.9
    assert score["false_alarms"] <= 2
