"""Samples of legs: the shipped hexapod's as it steps in place, and a stream of two joints."""

from __future__ import annotations

from adaptive_contact.robot import inverse, shipped_robot
from adaptive_contact.wire import Phase, ServoSample

STEP = 20_000_000


def step(tick: int) -> tuple[list[float], Phase]:
    """Angles in a tick, rad, and whether it swings: 40 ticks a step, 30 of them in the air."""
    phase = tick % 40
    height = -0.1 + 0.05 * (1 - abs(phase - 15) / 15 if phase < 30 else 0)
    angles = inverse([0.13, 0.0, height], shipped_robot().leg("rf").lengths_m)
    return [float(q) for q in angles], "swing" if phase < 30 else "stance"


def sample(k: int, *, run: int | None = 1, t0: int = 0, **other: object) -> ServoSample:
    """Sample ``k`` of a source that counts from ``t0`` on; all other fields as they are given."""
    fields: dict[str, object] = {
        "t_ns": t0 + k * STEP, "seq": k, "measured": [0.1, 0.2], "desired": [0.1, 0.2], "run": run,
    }  # fmt: skip
    return ServoSample(**{**fields, **other})  # type: ignore[arg-type]
