"""How fast the learners are, in one process."""

from __future__ import annotations

import contextlib
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.fit.refit_job import Job
from adaptive_contact.leg_group import LegGroup
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.service.refits import ProcessRefitter
from adaptive_contact.service.state import Identity, Record, Refused, StateStore
from adaptive_contact_sim.arrays import Run
from adaptive_contact_sim.evaluate import samples_of

__all__ = ["RestoreSpeed", "TickSpeed", "restore_speed", "tick_speed"]


@dataclass(frozen=True)
class TickSpeed:
    """Time of one control tick of all legs in the learners, their refits in a worker as in `serve`.

    Attributes:
        median_ms, p99_ms: of a tick.
        refitting_ms: the 99th percentile of the ticks during which a refit was under way.
        refitting: how many of the ticks those were.
        leg_ticks_per_s: of this process's time, messages not counted.
    """

    legs: int
    ticks: int
    median_ms: float
    p99_ms: float
    refitting_ms: float
    refitting: int
    leg_ticks_per_s: float


@dataclass(frozen=True)
class RestoreSpeed:
    """Time from opening a folder of states to all legs going on from theirs, imports apart.

    Attributes:
        seconds: the slowest of a few times.
        kilobytes: of the states, together.
    """

    legs: int
    seconds: float
    kilobytes: float


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
    """Measure :class:`~adaptive_contact.leg_group.Team` over a run of all legs."""
    legs = list(run.legs)
    refitter = _Watched()
    with threadpool_limits(1), contextlib.closing(refitter):
        learners = [ContactLearner(robot, leg, baseline, refitter=refitter) for leg in legs]
        team = LegGroup(learners)
        spent, during = [], []
        begun = time.process_time()
        for samples in zip(*(samples_of(run, leg) for leg in legs), strict=True):
            start = time.perf_counter()
            team.advance(samples)
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
        refitting_ms=float(np.percentile(took[refitting], 99)) if refitting.any() else float("nan"),
        refitting=int(refitting.sum()),
        leg_ticks_per_s=len(spent) * len(legs) / total,
    )


def restore_speed(run: Run, robot: Robot, baseline: Baseline, repeat: int = 5) -> RestoreSpeed:
    """Measure how fast the learners of a run go on from what they have saved of it.

    Raises:
        AdaptiveContactError: a leg could not be saved or restored.
    """

    def bank() -> dict[str, ContactLearner]:
        return {leg: ContactLearner(robot, leg, baseline) for leg in run.legs}

    learners = bank()
    team = LegGroup(list(learners.values()))
    for samples in zip(*(samples_of(run, leg) for leg in run.legs), strict=True):
        team.advance(samples)
    who = {leg: Identity(robot.name, leg, "", "") for leg in run.legs}
    with tempfile.TemporaryDirectory() as folder:
        store = StateStore.open(Path(folder), robot.name)
        for leg, learner in learners.items():
            if learner.model is None:
                raise AdaptiveContactError(f"leg {leg} has no model to save")
            store.save(
                Record(
                    identity=who[leg],
                    saved_ns=0,
                    package="",
                    model_version=learner.status.model_version,
                    run=None,
                    seq=None,
                    body=learner.snapshot(),
                )
            )
        store.close()
        kilobytes = sum(path.stat().st_size for path in Path(folder).rglob("*.state")) / 1e3
        took = []
        for _ in range(repeat):
            fresh = bank()
            start = time.perf_counter()
            store = StateStore.open(Path(folder), robot.name)
            for leg, learner in fresh.items():
                _, record = next(store.candidates(who[leg]))
                why = record.why if isinstance(record, Refused) else learner.restore(record.body)
                if why is not None:
                    raise AdaptiveContactError(f"leg {leg} was not restored: {why}")
            took.append(time.perf_counter() - start)
            store.close()
    return RestoreSpeed(legs=len(run.legs), seconds=max(took), kilobytes=kilobytes)
