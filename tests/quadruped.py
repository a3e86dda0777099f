"""Recordings of the shipped quadruped on its stand, simulated once; legs of two joints.

Each leg makes trials of its own: an ascent and a descent of 14 ticks between random foot points, a
hold of three ticks marked stance.  In ``collisions`` a hard plate is in the way of half of the
descents.  The servos are XL330 with their delivered gains (docs/simulator.md).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from adaptive_contact.wire import ContactTruth, ServoSample
from scoring import Samples, Truth

LEGS = ("fl", "fr", "rl", "rr")
STEP_RAD = 2 * math.pi / 4096
PERIOD_NS = 20_000_000


def recorded(name: str) -> tuple[Samples, Truth]:
    """Samples and truth of ``free`` or ``collisions``, in order of time."""
    with np.load(Path(__file__).parent / "recorded" / f"quadruped-{name}.npz") as table:
        measured, desired = (
            STEP_RAD * np.cumsum(table[of], axis=0, dtype=np.int64)
            for of in ("measured", "desired")
        )
        swing, touches = table["swing"], table["truth"]
    samples = [
        (leg, ServoSample(t_ns=k * PERIOD_NS, seq=k, measured=measured[k, i].tolist(),
                          desired=desired[k, i].tolist(),
                          phase="swing" if swing[k, i] else "stance"))
        for k in range(len(swing))
        for i, leg in enumerate(LEGS)
    ]  # fmt: skip
    truth = []
    for leg, t_ns, contact, force, speed in touches.tolist():
        of = {"speed_m_s": speed, "surface": "hard", "part": "foot"} if contact else {}
        change = ContactTruth(t_ns=int(t_ns), contact=bool(contact), force=force, **of)
        truth.append((LEGS[int(leg)], change))
    return samples, truth
