"""A gait that turns to stance as planned, seconds of it, through the real command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.e2e


def test_feet_that_come_late_are_found(command: Callable[..., str], tmp_path: Path) -> None:
    """Most of them after the turn, by servos that lag: of what can be seen nearly all."""
    walk = ["sim", "walk", "--phase", "planned", "--terrain", "rough", "--gait", "ripple"]
    command(*walk, "--seconds", "40", "--seed", "53", "--offline", "--record", "walk.mcap")
    command("replay", "walk.mcap", "--events", "events.jsonl")
    score = json.loads(command("score", "walk.mcap", "--events", "events.jsonl", "--json"))
    late, after = score["rows"]["late"], score["late_after_turn"]
    assert after["touches"] >= 50
    assert late["found"] >= 0.8 * late["touches"]
    assert after["found"] >= 0.75 * after["touches"]
    assert after["latency_median_ms"] <= 30.0
    assert score["false_alarms_after_turn"] <= 1
    assert score["false_alarms"] <= 2
    # A controller that acts on them is told what it does.
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    assert any(json.loads(line)["contact"] for line in lines)
