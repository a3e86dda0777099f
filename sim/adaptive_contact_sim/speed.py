"""How fast the learners are, in one process."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from adaptive_contact.adapt import Baseline, ContactLearner
from adaptive_contact.adapt.advance import advance
from adaptive_contact.robot import Robot
from adaptive_contact_sim.arrays import Run
from adaptive_contact_sim.evaluate import samples_of

__all__ = ["TickSpeed", "tick_speed"]


@dataclass(frozen=True)
class TickSpeed:
    """Time of one control tick of all legs in the learners.

    Attributes:
        median_ms, p99_ms: of a tick.
        leg_ticks_per_s: of processor time, messages not counted.
    """

    legs: int
    median_ms: float
    p99_ms: float
    leg_ticks_per_s: float


def tick_speed(run: Run, robot: Robot, baseline: Baseline) -> TickSpeed:
    """Measure :func:`~adaptive_contact.adapt.learner.advance` over a run of all legs."""
    legs = list(run.legs)
    learners = [ContactLearner(robot, leg, baseline) for leg in legs]
    spent = []
    begun = time.process_time()
    for samples in zip(*(samples_of(run, leg) for leg in legs), strict=True):
        start = time.perf_counter()
        advance(list(zip(learners, samples, strict=True)))
        spent.append(time.perf_counter() - start)
    total = time.process_time() - begun
    median, p99 = np.percentile(spent, (50, 99)) * 1e3
    return TickSpeed(len(legs), float(median), float(p99), len(spent) * len(legs) / total)
