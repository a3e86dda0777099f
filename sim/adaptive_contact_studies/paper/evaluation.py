"""Models and thresholds of every leg-run, and every detector on the report's streams.

Of free streams only counts are kept: alarms at every swept threshold, judged ticks, residuals.  Of
streams with contacts every score is kept, as the sweep has to be matched against the truth.

The default detector learns from training and tuning streams, as its own cross-validation keeps them
apart.  What it reports as a contact it does not learn, so that no threshold of it can be swept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.fit.train import learn
from adaptive_contact.model import Baseline, LegModel, LibraryName, Window
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.score import Events, LegStream
from adaptive_contact_studies.evaluate import feed, leg_stream, samples_of
from adaptive_contact_studies.paper.data import Stream, load
from adaptive_contact_studies.paper.detectors import (
    DETECTORS,
    MODELS,
    Bench,
    Evidence,
    alarm_ticks,
    tune_bench,
)
from adaptive_contact_studies.paper.plan import GantrySettings, Piece, Plan, Role
from adaptive_contact_studies.paper.rows import PAPER_WINDOW
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

# Swept thresholds, over those of the aim, 15 to a decade.  Far below it: a heavy tail sets an aim's
# threshold hundreds of times above what most ticks score.
FACTORS: Final = np.geomspace(1e-3, 10.0, 61)
AIM: Final = 45  # where the factor is 1
DEFAULT: Final = "default"
_SOURCES: Final = (
    *(*SIMULATOR, *LEARNER, "adaptive_contact_studies.paper.data"),
    *("adaptive_contact_studies.paper.detectors", "adaptive_contact_studies.paper.rows"),
)


class Learned(NamedTuple):
    """What is learned of one robot before the report's streams are touched."""

    models: dict[str, dict[str, LegModel]]  # by leg, then by name of `MODELS`
    baseline: Baseline  # of the default detector


class Job(NamedTuple):
    """Pieces that are read and predicted together."""

    plan: Plan
    pieces: tuple[Piece, ...]


@dataclass(frozen=True, eq=False)
class Evaluated:
    """What detectors made of a piece."""

    truth: LegStream  # as the score takes it
    swing: Ints  # (n,) number of the swing
    descending: Mask  # (n,) the command in force is past the lift
    events: Events  # of the default
    # by compared detector: alarms at every factor of free streams, -1 where it is absurdly low;
    # (n,) statistic over the threshold of streams with contacts
    alarms: dict[str, Ints]
    scores: dict[str, Array]
    squares: dict[str, Array]  # by model, (J,) sums of the residuals' squares on free ticks
    rows: dict[str, int]  # how many those are


@rests_on(*_SOURCES)
def learned(work: Work, item: tuple[Plan, int]) -> Learned:
    """Learn the legs of one robot from training and tuning streams."""
    plan, seed = item
    robot = shipped_robot()

    def fit(roles: tuple[Role, ...], library: LibraryName, **options: Any) -> Baseline:
        streams: dict[str, list[Stream]] = {leg: [] for leg in plan.legs}
        for piece in (p for role in roles for p in plan.pieces(role)):
            if piece.leg_run.robot_seed == seed:
                streams[piece.leg_run.leg].append(load(work, piece))
        stretches = {leg: [s.stretch for s in own] for leg, own in streams.items()}
        origin = f"experiments, robot {seed}"
        return learn(robot, stretches, origin=origin, library=library, **options).baseline

    servo = fit(("train",), "servo", window=Window())
    # λ of the paper's library, in units of the residual: on the plateau of the identification
    # study, where all thresholds predict alike.
    paper = fit(("train",), "paper", window=PAPER_WINDOW, threshold=0.5)
    models = {
        leg: {"servo": servo.legs[leg].model, "paper": paper.legs[leg].model} for leg in plan.legs
    }
    return Learned(models, fit(("train", "tune"), "servo", window=Window()))


@rests_on(*_SOURCES)
def tuned(work: Work, plan: Plan) -> Bench:
    """Choose lag, noise, tails and joints on tuning streams."""
    robot = shipped_robot()
    evidence = [_evidence(work, plan, robot, load(work, p)) for p in plan.pieces("tune")]
    touch = [e.stream.piece.kind in plan.tune_touch_s for e in evidence]
    quiet, touched = (
        [e for e, t in zip(evidence, touch, strict=True) if t is which] for which in (False, True)
    )
    return tune_bench(robot, quiet, touched)


def jobs_of(plan: Plan, pieces: Sequence[Piece]) -> list[Job]:
    """Pieces in groups: some runs of one hung-up robot, or all of one leg-run.

    Learners side by side share what a tick costs once: eighteen take half the time of three.
    """
    groups: dict[str, list[Piece]] = {}
    runs: dict[int, dict[str, int]] = {}
    for piece in pieces:
        name = f"{piece.role} {piece.leg_run.name}"
        if isinstance(piece.settings, GantrySettings):
            known = runs.setdefault(piece.leg_run.robot_seed, {})
            run = known.setdefault(repr(piece.settings), len(known))
            # Three runs of six streams are evaluated side by side.
            name = f"{piece.role} {piece.leg_run.robot_seed} {run // 3}"
        groups.setdefault(name, []).append(piece)
    return [Job(plan, tuple(group)) for group in groups.values()]


@rests_on(*_SOURCES)
def evaluate(work: Work, job: Job) -> list[Evaluated]:
    """Evaluate the pieces of a job."""
    robot, bench = shipped_robot(), work.one(tuned, job.plan)
    streams = [load(work, piece) for piece in job.pieces]
    baselines = [
        work.one(learned, (job.plan, s.piece.leg_run.robot_seed)).baseline for s in streams
    ]
    learners = [ContactLearner(robot, s.leg, b) for s, b in zip(streams, baselines, strict=True)]
    played = feed(learners, [samples_of(s.run, s.leg) for s in streams])
    found = []
    for stream, events in zip(streams, played, strict=True):
        own = _evidence(work, job.plan, robot, stream)
        scores = {name: bench.score(name, own) for name in DETECTORS}
        quiet = stream.piece.role != "touch"
        residuals = {name: own.predictions[name].residual[own.free] for name in MODELS}
        known = {name: r[np.isfinite(r).all(axis=1)] for name, r in residuals.items()}
        found.append(
            Evaluated(
                truth=leg_stream(stream.run, stream.leg, robot),
                swing=own.swing_of_tick,
                descending=own.descending,
                events=Events.of(events),
                alarms={n: _sweep(own, score) for n, score in scores.items()} if quiet else {},
                scores={} if quiet else scores,
                squares={name: np.square(r).sum(axis=0) for name, r in known.items()},
                rows={name: len(r) for name, r in known.items()},
            )
        )
    return found


def _evidence(work: Work, plan: Plan, robot: Robot, stream: Stream) -> Evidence:
    run = stream.piece.leg_run
    return Evidence.of(robot, stream, work.one(learned, (plan, run.robot_seed)).models[run.leg])


def _sweep(own: Evidence, score: Array) -> Ints:
    """Alarms at every threshold; -1 where it is absurdly low."""
    known = score[np.isfinite(score)]
    counts = np.full(len(FACTORS), -1, dtype=np.int64)
    for i, factor in enumerate(FACTORS):
        # A threshold that more than this share of the ticks pass is no detector's; it is left out.
        if np.count_nonzero(known > factor) <= 0.03 * len(known):
            counts[i] = len(alarm_ticks(score, own.swing_of_tick, float(factor), own.descending))
    return counts
