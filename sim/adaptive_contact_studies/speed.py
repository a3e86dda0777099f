"""How fast the learners are, in one process."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from adaptive_contact.bank import LegGroup, compile_ahead
from adaptive_contact.fit.refit_job import Job
from adaptive_contact.leg_learner import ContactLearner
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
    refitting_ms: float  # the 99th percentile of the ticks during which a refit was under way
    refitting: int  # how many of the ticks those were
    leg_ticks_per_s: float  # of this process's time, messages not counted


class _Watched(ProcessRefitter):
    """Counts the jobs that are under way."""

    def __init__(self) -> None:
        super().__init__()
        self.open: set[str] = set()

    def submit(self, job: Job) -> None:
        self.open.add(job.leg)
        super().submit(job)

    def collect(self, leg: str, number: int) -> object | None:
        result = super().collect(leg, number)
        if result is not None:
            self.open.discard(leg)
        return result


def tick_speed(run: Run, robot: Robot, baseline: Baseline) -> TickSpeed:
    """Measure :class:`~adaptive_contact.bank.LegGroup` over a run of all legs."""
    legs = list(run.legs)
    rounds = list(zip(*(samples_of(run, leg) for leg in legs), strict=True))
    compile_ahead()
    refitter = _Watched()
    with threadpool_limits(1), contextlib.closing(refitter):
        group = LegGroup([ContactLearner(robot, leg, baseline, refitter=refitter) for leg in legs])
        spent, events, during = [], [], []
        begun = time.process_time()
        for samples in rounds:
            start = time.perf_counter()
            group.judge(samples)
            events.append(time.perf_counter() - start)
            group.finish()
            spent.append(time.perf_counter() - start)
            during.append(bool(refitter.open))
        total = time.process_time() - begun
    took, refitting = np.array(spent) * 1e3, np.array(during)
    median, p99 = np.percentile(took, (50, 99))
    return TickSpeed(
        legs=len(legs),
        ticks=len(spent),
        median_ms=float(median),
        p99_ms=float(p99),
        event_ms=1e3 * float(np.percentile(events, 99)),
        refitting_ms=float(np.percentile(took[refitting], 99)) if refitting.any() else float("nan"),
        refitting=int(refitting.sum()),
        leg_ticks_per_s=len(spent) * len(legs) / total,
    )
