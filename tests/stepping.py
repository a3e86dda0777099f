"""A leg of the shipped hexapod that steps in place: 40 ticks a step, 30 of them in the air."""

from __future__ import annotations

from adaptive_contact.robot import inverse, shipped_robot
from adaptive_contact.wire import Phase


def step(tick: int) -> tuple[list[float], Phase]:
    """Its angles in a tick, rad, and whether it swings."""
    phase = tick % 40
    height = -0.1 + 0.05 * (1 - abs(phase - 15) / 15 if phase < 30 else 0)
    angles = inverse([0.13, 0.0, height], shipped_robot().leg("rf").lengths_m)
    return [float(q) for q in angles], "swing" if phase < 30 else "stance"
