"""Service, simulator, recorder and a subscriber as processes of their own, over loopback."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.e2e

README = Path(__file__).parents[2] / "README.md"
SECONDS = 60
TICKS = 50 * SECONDS
# Faster than life, and well within what the service keeps up with.
SPEED = 4


def test_a_walk_over_rough_ground_is_told_as_it_happens(
    start: Callable[..., Any], command: Callable[..., str]
) -> None:
    service = start("serve", "--no-state", "--listen", "tcp/127.0.0.1:0")
    endpoint = service.wait_line(r"listening on (\S+);").group(1)
    recorder = start("record", "walk.mcap", "--connect", endpoint)
    recorder.wait_line("recording robot/")
    (code,) = re.findall(r"```python\n(import.*?)```", README.read_text("utf-8"), re.DOTALL)
    subscriber = start("-c", code.replace("tcp/127.0.0.1:7447", endpoint), script=True)

    walk = ["sim", "walk", "--terrain", "rough", "--seed", 5, "--connect", endpoint]
    simulator = start(*walk, "--seconds", SECONDS, "--speed", SPEED)
    simulator.wait_line("tripod walk on rough ground")
    holds = command("sim", "inject", "--connect", endpoint)
    assert "nothing drifts" in holds
    assert simulator.wait(120) == 0, simulator.lines

    # Two looks of the service later, all that was sent is worked off.
    watch = ["watch", "--once", "--json", "--seconds", "2.5", "--connect", endpoint]
    view = json.loads(command(*watch))
    # Streams are dropped where a busy machine cannot carry them, and until somebody subscribes.
    assert view["service"]["samples"] >= 0.95 * 6 * TICKS
    assert view["service"]["rejects"] == {}
    assert view["service"]["callback_faults"] == 0
    for leg in view["legs"]:
        # A machine too busy to keep up drops samples, and counts them.
        assert set(leg["rejects"]) <= {"overflow"}, leg
        assert leg["missed"] <= 0.05 * TICKS, leg
    assert recorder.stop() == 0
    assert service.stop() == 0, service.lines
    assert subscriber.process.poll() is None, "a subscriber outlives the service"
    assert len(subscriber.lines) > 200
    assert all(re.fullmatch(r"[lr][fmr] (touches|lets go) .*", line) for line in subscriber.lines)

    score = json.loads(command("score", "walk.mcap", "--json"))
    assert score["truncated"] is False
    assert score["rejects"] == {}
    assert score["counted"]["touches"] > 200
    assert score["counted"]["recall"] >= 0.95
    assert score["false_alarms"] <= 1
    assert score["rows"]["headline"]["latency_median_ms"] <= 25
    assert set(score["legs"]) == {"lf", "lm", "lr", "rf", "rm", "rr"}
    for leg, figures in score["legs"].items():
        assert figures["counted"]["recall"] >= 0.9, leg


# -- A gait that turns to stance as planned, seconds of it, through the real command line


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


# -- Files instead of a network: simulate, replay, score, fit, through the real command line
