"""How fast the learners are, in one process."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from adaptive_contact.core.bank import LegGroup, compile_ahead
from adaptive_contact.core.detect.standing import Standing
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.service.refits import ProcessRefitter
from adaptive_contact_sim.arrays import Run
from adaptive_contact_studies.evaluate import samples_of


@dataclass(frozen=True)
class TickSpeed:
    """Time of one control tick in the learners, their refits in a worker as in `serve`."""

    legs: int
    ticks: int
    # median_ms, p99_ms: of a tick of all legs
    median_ms: float
    p99_ms: float
    event_ms: float  # the 99th percentile of the part that an event waits for
    leg_ticks_per_s: float  # of this process's time, messages not counted


def tick_speed(run: Run, robot: Robot, baseline: Baseline) -> TickSpeed:
    """Measure :class:`~adaptive_contact.core.bank.LegGroup` over a run of all legs."""
    legs = list(run.legs)
    rounds = list(zip(*(samples_of(run, leg) for leg in legs), strict=True))
    compile_ahead()
    refitter = ProcessRefitter()
    with threadpool_limits(1), contextlib.closing(refitter):
        standing = Standing()
        group = LegGroup(
            [
                ContactLearner(robot, leg, baseline, refitter=refitter, standing=standing)
                for leg in legs
            ]
        )
        spent, events = [], []
        begun = time.process_time()
        for samples in rounds:
            start = time.perf_counter()
            group.detect_contacts(samples)
            events.append(time.perf_counter() - start)
            group.learn_from_tick()
            spent.append(time.perf_counter() - start)
        total = time.process_time() - begun
    median, p99 = 1e3 * np.percentile(spent, (50, 99))
    return TickSpeed(
        legs=len(legs),
        ticks=len(spent),
        median_ms=float(median),
        p99_ms=float(p99),
        event_ms=1e3 * float(np.percentile(events, 99)),
        leg_ticks_per_s=len(spent) * len(legs) / total,
    )
