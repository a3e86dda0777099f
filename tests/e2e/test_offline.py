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
    """The paper's set-up for two minutes, half of the descents onto obstacles."""
    obstacles = ["--leg", "rf", "--obstacles", "0.5", "--workspace", "whole"]
    run = ["--seconds", "120", "--seed", "11", "--offline", "--record", "pose.mcap"]
    command("sim", "pose", *obstacles, *run)
    return tmp_path / "pose.mcap"


def test_pose_replay_and_score(command: Callable[..., str], pose: Path, tmp_path: Path) -> None:
    command("replay", pose, "--events", "one.jsonl")
    events = (tmp_path / "one.jsonl").read_bytes()
    assert {json.loads(line)["leg"] for line in events.splitlines()} == {"rf"}

    score = json.loads(command("score", pose, "--events", "one.jsonl", "--json"))
    assert score["counted"]["touches"] > 60
    assert score["counted"]["recall"] >= 0.95
    assert score["rows"]["headline"]["latency_median_ms"] <= 20
    assert score["false_alarms"] <= 1


@pytest.mark.slow
def test_fit_a_baseline_and_use_it(command: Callable[..., str], tmp_path: Path) -> None:
    walk = ["sim", "walk", "--offline"]
    command(*walk, "--seconds", "240", "--seed", "21", "--record", "learn.mcap")
    told = json.loads(command("fit", "learn.mcap", "-o", "legs.json", "--json"))
    assert set(told["equations"]) == set(SIX)
    assert (tmp_path / "legs.json").stat().st_size > 10_000

    command(*walk, "--seconds", "30", "--seed", "22", "--record", "walk.mcap")
    command("replay", "walk.mcap", "--events", "own.jsonl", "--baseline", "legs.json")
    score = json.loads(command("score", "walk.mcap", "--events", "own.jsonl", "--json"))
    # Four minutes do not hold every motion: where they did not, the model must not cry wolf.
    assert score["counted"]["recall"] >= 0.9
    assert score["false_alarms"] == 0
