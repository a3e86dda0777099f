"""Publishers of docs/robots.md, run with what they call "yours" in place."""

from __future__ import annotations

import math
import re
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest

from adaptive_contact.wire import ServoSample, decode

PAGE = Path(__file__).resolve().parents[2] / "docs" / "robots.md"
LEGS = {"FL": [0, 1, 2], "FR": [3, 4, 5]}


def snippet(words: str) -> str:
    (found,) = (b for b in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S) if words in b)
    return str(found)


class Publisher:
    """Keeps what is put, decoded."""

    def __init__(self) -> None:
        self.samples: list[Any] = []

    def put(self, payload: bytes) -> None:
        self.samples.append(decode(payload, ServoSample))


def test_a_policy_publishes_samples_of_every_leg() -> None:
    publishers = {leg: Publisher() for leg in LEGS}
    scope: dict[str, Any] = {
        "time": time, "msgpack": msgpack, "LEGS": LEGS, "publishers": publishers, "run": 7,
        "default_pose": np.zeros(6), "policy": lambda _: np.arange(6.0),
        "send": lambda *_, **__: None,
        "steps": lambda: [SimpleNamespace(joint_positions=np.full(6, 0.1 * k)) for k in range(3)],
    }  # fmt: skip
    exec(snippet("default_pose"), scope)
    for leg, columns in LEGS.items():
        found = publishers[leg].samples
        assert [sample.seq for sample in found] == [0, 1, 2]
        assert [sample.run for sample in found] == [7] * 3
        assert found[1].measured == pytest.approx([0.1] * 3)
        assert found[1].desired == pytest.approx([0.25 * j for j in columns])
        assert found[0].t_ns <= found[1].t_ns


def test_lerobot_s_bus_is_read_in_degrees_before_the_goal() -> None:
    written: list[dict[str, float]] = []
    bus = SimpleNamespace(
        sync_read=lambda _: {"hip": 90.0 + len(written), "knee": -90.0},
        sync_write=lambda _, goals: written.append(goals),
    )
    scope: dict[str, Any] = {
        "time": time, "math": math, "robot": SimpleNamespace(bus=bus), "sample": {},
        "joints": ["hip", "knee"], "policy": lambda read: {j: a + 9.0 for j, a in read.items()},
    }  # fmt: skip
    exec(snippet("sync_read"), scope)
    assert written == [{"hip": 99.0, "knee": -81.0}]
    assert scope["sample"]["measured"] == pytest.approx([math.pi / 2, -math.pi / 2])
    assert scope["sample"]["desired"] == pytest.approx([0.55 * math.pi, -0.45 * math.pi])
