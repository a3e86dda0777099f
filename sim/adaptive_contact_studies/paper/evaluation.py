"""The default detector itself, sample by sample, on many streams at once.

The product's learner with other settings, on the same streams: other target rates, and ungated.

A target rate moves more than a threshold: what is reported as a contact is not learned from.  So
every target rate is one more play of the streams.  The ungated learner is the design's: recursive
least squares over every tick, contact or not.

Every detector on the report's streams, piece by piece, in processes.

Of free streams only counts are kept: alarms at every swept threshold, ticks above it, judged ticks,
residuals.  Of streams with contacts every score is kept, as the sweep has to be matched against the
truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.learn.mode import LearnerMode
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.score import Events
from adaptive_contact_studies.cache import Store, plain
from adaptive_contact_studies.evaluate import feed, samples_of
from adaptive_contact_studies.paper.comparison_rules import alarm_ticks
from adaptive_contact_studies.paper.data import Stream, load
from adaptive_contact_studies.paper.detectors import DETECTORS, Evidence, evidence_of
from adaptive_contact_studies.paper.models import Learned, learned, models_key
from adaptive_contact_studies.paper.plan import GantrySettings, Piece, Plan


def play_streams(
    robot: Robot,
    baselines: Mapping[int, Baseline],
    streams: Sequence[Stream],
    *,
    per_hour: float | None = None,
    mode: LearnerMode = LearnerMode.FULL,
) -> list[Events]:
    """Feed every stream to a learner of its own.

    Args:
        robot: its description.
        baselines: what the learners start from, by seed of the robot.
        streams: of any length.
        per_hour: false alarms per robot-hour that thresholds are for, the robot's own if None.
        mode: of the learners.

    Returns:
        The events of each.
    """
    if per_hour is not None:
        detector = msgspec.structs.replace(robot.detector, false_alarms_per_hour=per_hour)
        robot = msgspec.structs.replace(robot, detector=detector)
    learners = [
        ContactLearner(robot, s.leg, baselines[s.piece.leg_run.robot_seed], mode=mode)
        for s in streams
    ]
    samples = [samples_of(s.run, s.leg) for s in streams]
    return [Events.of(own) for own in feed(learners, samples)]


# False alarms per robot-hour beside the product's own target of one: the default's curve.
AIMS: Final = (0.1, 10.0, 100.0)


def aim_name(per_hour: float) -> str:
    """Such as ``aim 0.1``."""
    return f"aim {per_hour:g}"


def at_other_aims(plan: Plan, piece: Piece) -> bool:
    """Whether a piece is one of those played at every target rate.

    All collisions, so that the curve is of the same touches as every other; of the free motion
    that of the first robot: three more plays of everything would take longer than all the rest.
    """
    return piece.role == "touch" or piece.leg_run.robot_seed == plan.robots[0]


# Swept thresholds, over those of the aim, 15 to a decade.  Far below it: a heavy tail sets an aim's
# threshold hundreds of times above what most ticks score.
FACTORS: Final = np.geomspace(1e-3, 10.0, 61)
AIM: Final = 45  # where the factor is 1
# Detectors that run sample by sample and learn as they go.
DEFAULT: Final = "default"
UNGATED: Final = "ungated"
ONLINE: Final = {
    DEFAULT: "default: servo law, likelihood ratio, online",
    UNGATED: "servo law, likelihood ratio, ungated recursive least squares",
}
# Free ticks that set a tail: above this score, and how many of those are among the first after the
# turn from lift to descent, where the command runs away from the leg and the servos saturate.
TOP_SCORE: Final = 0.1
NEAR_TURN_TICKS: Final = 5
MODELS: Final = ("servo", "paper", "analytical")
# Runs of a hung-up robot, of six streams each, that are evaluated side by side.
_RUNS_TOGETHER: Final = 3
# A threshold that more than this share of the ticks pass is no detector's; it is left out.
_ABSURD_SHARE: Final = 0.03


class Job(NamedTuple):
    """One work item: pieces that are read and predicted together."""

    root: Path
    plan: Plan
    pieces: tuple[Piece, ...]

    @property
    def key(self) -> list[Any]:
        """All that decides the result."""
        return [*models_key(self.plan), [plain(p) for p in self.pieces]]


def jobs_of(root: Path, plan: Plan, pieces: Sequence[Piece]) -> list[Job]:
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
            name = f"{piece.role} {piece.leg_run.robot_seed} {run // _RUNS_TOGETHER}"
        groups.setdefault(name, []).append(piece)
    return [Job(root, plan, tuple(group)) for group in groups.values()]


_known: dict[str, Learned] = {}


def evaluate(job: Job) -> int:
    """Evaluate a job unless it was done, and keep the result; how many pieces it held."""
    read_job(job)
    return len(job.pieces)


def read_job(job: Job) -> dict[str, NDArray[Any]]:
    """The result of a job, made now if it is not there."""
    store = Store(job.root)
    return store.arrays("evaluation", job.key, lambda: _evaluate(store, job))


def _evaluate(store: Store, job: Job) -> dict[str, NDArray[Any]]:
    name = f"{job.root} {job.plan}"
    if name not in _known:
        _known[name] = learned(store, job.plan)
    known = _known[name]
    robot = shipped_robot()
    streams = [load(store, piece) for piece in job.pieces]
    evidence = evidence_of(robot, streams, known.models, known.gains)
    out = _online(robot, job.plan, known, streams)
    for index, own in enumerate(evidence):
        prefix = f"{index}/"
        free = own.stream.piece.role in ("free", "stand")
        out |= {prefix + k: v for k, v in _residuals(own).items()}
        out[prefix + "descending"] = own.descending
        out[prefix + "judged"] = np.array(np.count_nonzero(own.motion.judged & own.free))
        out[prefix + "swing"] = np.array(np.count_nonzero(own.stream.swing))
        for detector in DETECTORS:
            score = known.bench.score(detector, own)
            if free:
                out[f"{prefix}alarms/{detector}"] = _sweep(own, score)
                out |= {f"{prefix}{k}/{detector}": v for k, v in tail_of(own, score).items()}
            else:
                out[f"{prefix}score/{detector}"] = score.astype(np.float32)
    return out


def _online(
    robot: Robot, plan: Plan, known: Learned, streams: Sequence[Stream]
) -> dict[str, NDArray[Any]]:
    """Events of the learners: at the product's target rate, ungated, and at others if asked."""
    played = {
        DEFAULT: play_streams(robot, known.baselines, streams),
        UNGATED: play_streams(robot, known.baselines, streams, mode=LearnerMode.UNGATED),
    }
    if all(at_other_aims(plan, stream.piece) for stream in streams):
        for per_hour in AIMS:
            played[aim_name(per_hour)] = play_streams(
                robot, known.baselines, streams, per_hour=per_hour
            )
    return {
        f"{index}/online/{name}/{field}": getattr(of_stream, field)
        for name, events in played.items()
        for index, of_stream in enumerate(events)
        for field in Events._fields
    }


def tail_of(own: Evidence, score: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """How high free ticks score: how many, above every threshold, the top ones after the turn."""
    known = own.free & np.isfinite(score)
    ordered = np.sort(score[known])
    turn = np.flatnonzero(np.diff(own.descending.astype(np.int8)) == 1)
    near = np.zeros(len(score), dtype=np.bool_)
    for shift in range(1, NEAR_TURN_TICKS + 1):
        near[np.minimum(turn + shift, len(score) - 1)] = True
    top = known & (score > TOP_SCORE)
    return {
        "known": np.array(len(ordered)),
        "above": len(ordered) - np.searchsorted(ordered, FACTORS, side="right"),
        "top": np.array([np.count_nonzero(top), np.count_nonzero(top & near)]),
        "near": np.array(np.count_nonzero(known & near)),
    }


def _residuals(own: Evidence) -> dict[str, NDArray[Any]]:
    """Sums of squares of every model's residuals on free ticks, and how many."""
    out: dict[str, NDArray[Any]] = {}
    for model in MODELS:
        residual = own.predictions[model].residual[own.free]
        residual = residual[np.isfinite(residual).all(axis=1)]
        out[f"squares/{model}"] = np.square(residual).sum(axis=0)
        out[f"rows/{model}"] = np.array(len(residual))
    return out


def _sweep(own: Evidence, score: NDArray[np.float64]) -> NDArray[np.int64]:
    """Alarms at every threshold; -1 where it is absurdly low."""
    known = score[np.isfinite(score)]
    counts = np.full(len(FACTORS), -1, dtype=np.int64)
    for i, factor in enumerate(FACTORS):
        if np.count_nonzero(known > factor) <= _ABSURD_SHARE * len(known):
            counts[i] = len(alarm_ticks(score, own.swing_of_tick, float(factor), own.descending))
    return counts


def online_events(result: dict[str, NDArray[Any]], index: int, name: str) -> Events | None:
    """A learner's events of a job's piece; None where it was not played."""
    prefix = f"{index}/online/{name}/"
    if f"{prefix}t_ns" not in result:
        return None
    return Events(*(result[prefix + field] for field in Events._fields))
