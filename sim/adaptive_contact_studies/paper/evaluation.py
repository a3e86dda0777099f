"""Models and thresholds of every leg-run, and every detector on the report's streams.

Of free streams only counts are kept: alarms at every swept threshold, judged ticks, residuals.  Of
streams with contacts every score is kept, as the sweep has to be matched against the truth.

The product learns from training and tuning streams, as its own cross-validation keeps them apart.
What it reports as a contact it does not learn, so that no threshold of it can be swept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.fit.train import Stretch, learn
from adaptive_contact.model import Baseline, LegModel, LibraryName, Window
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.score import Events, LegOutcome, LegStream, match
from adaptive_contact_studies.evaluate import feed, leg_stream, samples_of
from adaptive_contact_studies.paper.data import Stream, streams_of
from adaptive_contact_studies.paper.detectors import (
    DETECTORS,
    MODELS,
    Bench,
    Evidence,
    alarm_ticks,
    alarms,
    tune_bench,
)
from adaptive_contact_studies.paper.plan import Plan, Role
from adaptive_contact_studies.paper.rows import PAPER_WINDOW
from adaptive_contact_studies.training import PlannedRun
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

# Swept thresholds, over those of the aim, 15 to a decade.  Far below it: a heavy tail sets an aim's
# threshold hundreds of times above what most ticks score.
FACTORS: Final = np.geomspace(1e-3, 10.0, 61)
AIM: Final = 45  # where the factor is 1
DEFAULT: Final = "default"
# The product is played: as it learns, and as its baseline is.
PLAYED: Final = {DEFAULT: LearnerMode.FULL, "frozen": LearnerMode.FROZEN}
_SOURCES: Final = (
    *(*SIMULATOR, *LEARNER, "adaptive_contact_studies.paper.data"),
    *("adaptive_contact_studies.paper.detectors", "adaptive_contact_studies.paper.rows"),
)


class Learned(NamedTuple):
    """What is learned of one robot before the report's streams are touched."""

    models: dict[str, dict[str, LegModel]]  # by leg, then by name of `MODELS`
    baseline: Baseline  # of the default detector


class Job(NamedTuple):
    """Runs that are read and predicted together."""

    plan: Plan
    role: Role
    runs: tuple[PlannedRun, ...]


@dataclass(frozen=True, eq=False)
class Evaluated:
    """What detectors made of a stream."""

    kind: str  # how the leg moves and what it meets
    leg_run: str
    truth: LegStream  # as the score takes it
    swing: Ints  # (n,) number of the swing
    descending: Mask  # (n,) the command in force is past the lift
    events: dict[str, Events]  # of what is played
    # by compared detector: alarms at every factor of free streams, -1 where it is absurdly low;
    # (n,) statistic over the threshold of streams with contacts
    alarms: dict[str, Ints]
    scores: dict[str, Array]
    squares: dict[str, Array]  # by model, (J,) sums of the residuals' squares on free ticks
    rows: dict[str, int]  # how many those are

    @property
    def slow(self) -> bool:
        """Whether the leg approaches slowly."""
        return self.kind == "hard slow"

    def outcome(self, name: str, factor: float = 1.0) -> LegOutcome:
        """A detector's events against the truth, of a stream with contacts."""
        if name in PLAYED:
            return match(self.truth, self.events[name])
        scores = self.scores[name]
        events = alarms(self.truth.t_ns, scores, self.swing, factor, self.descending)
        return match(self.truth, events)


@rests_on(*_SOURCES)
def learned(work: Work, item: tuple[Plan, int]) -> Learned:
    """Learn the legs of one robot from training and tuning streams."""
    plan, seed = item
    robot = shipped_robot()

    def fit(roles: tuple[Role, ...], library: LibraryName, **options: Any) -> Baseline:
        runs = [run for role in roles for run in plan.runs(role) if run.settings.robot_seed == seed]
        stretches: dict[str, list[Stretch]] = {}
        for stream in streams_of(work, runs):
            stretches.setdefault(stream.leg, []).append(stream.stretch)
        origin = f"experiments, robot {seed}"
        return learn(robot, stretches, origin=origin, library=library, **options).baseline

    servo = fit(("train",), "servo", window=Window())
    # λ of the paper's library, in units of the residual: on the plateau of the identification
    # study, where all thresholds predict alike.
    paper = fit(("train",), "paper", window=PAPER_WINDOW, threshold=0.5)
    models = {
        leg: {"servo": known.model, "paper": paper.legs[leg].model}
        for leg, known in servo.legs.items()
    }
    return Learned(models, fit(("train", "tune"), "servo", window=Window()))


@rests_on(*_SOURCES)
def tuned(work: Work, plan: Plan) -> Bench:
    """Choose lag, tails and joints on tuning streams."""
    robot = shipped_robot()
    streams = streams_of(work, plan.runs("tune"))
    evidence = [_evidence(work, plan, robot, stream) for stream in streams]
    touch = [e.stream.planned.name in plan.tune_touch_s for e in evidence]
    quiet, touched = (
        [e for e, t in zip(evidence, touch, strict=True) if t is which] for which in (False, True)
    )
    return tune_bench(robot, quiet, touched)


def jobs_of(plan: Plan, role: Role) -> list[Job]:
    """The runs of a role, six at a time.

    Learners side by side share what a tick costs once: eighteen take half the time of three.
    """
    runs = plan.runs(role)
    return [Job(plan, role, tuple(runs[i : i + 6])) for i in range(0, len(runs), 6)]


@rests_on(*_SOURCES)
def evaluate(work: Work, job: Job) -> list[Evaluated]:
    """Evaluate the streams of a job."""
    robot, bench = shipped_robot(), work.one(tuned, job.plan)
    streams = streams_of(work, job.runs)
    samples = [samples_of(s.run, s.leg) for s in streams]
    baselines = [_learned_of(work, job.plan, s).baseline for s in streams]
    played: list[dict[str, Events]] = [{} for _ in streams]
    for name, mode in PLAYED.items():
        learners = [
            ContactLearner(robot, s.leg, known, mode=mode)
            for s, known in zip(streams, baselines, strict=True)
        ]
        for of_stream, told in zip(played, feed(learners, samples), strict=True):
            of_stream[name] = Events.from_messages(told)
    quiet = job.role != "touch"
    found = []
    for stream, events in zip(streams, played, strict=True):
        own = _evidence(work, job.plan, robot, stream)
        scores = {name: bench.score(name, own) for name in DETECTORS}
        residuals = {name: own.residuals[name][own.free] for name in MODELS}
        known = {name: r[np.isfinite(r).all(axis=1)] for name, r in residuals.items()}
        found.append(
            Evaluated(
                kind=stream.planned.name,
                leg_run=stream.leg_run,
                truth=leg_stream(stream.run, stream.leg, robot),
                swing=own.swing_of_tick,
                descending=own.descending,
                events=events,
                alarms={n: _sweep(own, score) for n, score in scores.items()} if quiet else {},
                scores={} if quiet else scores,
                squares={name: np.square(r).sum(axis=0) for name, r in known.items()},
                rows={name: len(r) for name, r in known.items()},
            )
        )
    return found


def _learned_of(work: Work, plan: Plan, stream: Stream) -> Learned:
    return work.one(learned, (plan, stream.planned.settings.robot_seed))


def _evidence(work: Work, plan: Plan, robot: Robot, stream: Stream) -> Evidence:
    return Evidence.from_stream(robot, stream, _learned_of(work, plan, stream).models[stream.leg])


def _sweep(own: Evidence, score: Array) -> Ints:
    """Alarms at every threshold; -1 where it is absurdly low."""
    known = score[np.isfinite(score)]
    counts = np.full(len(FACTORS), -1, dtype=np.int64)
    for i, factor in enumerate(FACTORS):
        # A threshold that more than this share of the ticks pass is no detector's; it is left out.
        if np.count_nonzero(known > factor) <= 0.03 * len(known):
            counts[i] = len(alarm_ticks(score, own.swing_of_tick, float(factor), own.descending))
    return counts
