"""How fast the learners, the simulator and the export of recordings are, in one process."""

from __future__ import annotations

import contextlib
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from adaptive_contact.bank import LegGroup, compile_ahead
from adaptive_contact.errors import AdaptiveContactError, MissingExtraError
from adaptive_contact.fit.refit_job import Job
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.service.recording import read_recording
from adaptive_contact.service.recording.export import ExportFormat, export_recording
from adaptive_contact.service.refits import ProcessRefitter
from adaptive_contact.service.state import Identity, Record, Refused, StateStore
from adaptive_contact_sim.arrays import Run
from adaptive_contact_sim.recorder import record_file
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import TerrainSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.evaluate import samples_of

# Restores of which the slowest counts.
_RESTORES: Final = 5


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


@dataclass(frozen=True)
class RestoreSpeed:
    """Time from opening a folder of states to all legs going on from theirs, imports apart."""

    legs: int
    seconds: float  # the slowest of a few times
    kilobytes: float  # of the states, together


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


def restore_speed(run: Run, robot: Robot, baseline: Baseline) -> RestoreSpeed:
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
        for _ in range(_RESTORES):
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


def real_time_factor(*, seconds: float) -> float:
    """Measure simulated seconds per second of one core: physics, servo law, gait, readings.

    What runs is the tripod gait on the rough field.
    """
    rough = TerrainSettings(kind="rough")
    sim = Simulation(SimulationSettings(motion=WalkSettings(), terrain=rough, seed=1))
    for _ in sim.run(2.0):  # into the walk
        pass
    start = time.process_time()
    for _ in sim.run(seconds):
        pass
    return seconds / (time.process_time() - start)


def export_speed(settings: SimulationSettings, seconds: float = 60.0) -> dict[str, float]:
    """Measure how fast a recording is exported, reading and writing included, imports apart.

    Returns:
        Recorded seconds per second, by format; without those whose library is not installed.

    Raises:
        RecordingError: the recording cannot be written or read.
    """
    ratios = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "walk.mcap"
        record_file(settings, seconds, file)
        for form in (*ExportFormat, *ExportFormat):  # the second time counts: all is imported
            with contextlib.suppress(MissingExtraError):
                start = time.perf_counter()
                exported = export_recording(read_recording(file), Path(folder) / form, form)
                ratios[form.value] = exported.span_s / (time.perf_counter() - start)
    return ratios
