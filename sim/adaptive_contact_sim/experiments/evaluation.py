"""Every detector on the report's streams, piece by piece, in processes.

Of free streams only counts are kept: alarms at every swept threshold, judged ticks, residuals.  Of
streams with contacts every score is kept, as the sweep has to be matched against the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.detect.baseline_events import alarm_ticks
from adaptive_contact.robot import shipped_robot
from adaptive_contact.score import Events
from adaptive_contact_sim.experiments.data import load
from adaptive_contact_sim.experiments.detectors import DETECTORS, Evidence, evidence_of
from adaptive_contact_sim.experiments.models import Learned, learned, models_key
from adaptive_contact_sim.experiments.online import play_streams
from adaptive_contact_sim.experiments.plan import GantrySettings, Piece, Plan
from adaptive_contact_sim.experiments.store import Store, plain

__all__ = ["FACTORS", "MODELS", "evaluate", "jobs_of", "read_job"]

# Swept thresholds, over those of the aim; the middle one is the aim itself.
FACTORS: Final = np.geomspace(0.1, 10.0, 41)
AIM: Final = 20
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
    events = play_streams(robot, known.baselines, streams)
    out: dict[str, NDArray[Any]] = {}
    for index, (own, told) in enumerate(zip(evidence, events, strict=True)):
        prefix = f"{index}/"
        free = own.stream.piece.role in ("free", "stand")
        out |= {prefix + k: v for k, v in _default(told).items()}
        out |= {prefix + k: v for k, v in _residuals(own).items()}
        out[prefix + "descending"] = own.descending
        out[prefix + "judged"] = np.array(np.count_nonzero(own.motion.judged & own.free))
        out[prefix + "swing"] = np.array(np.count_nonzero(own.stream.swing))
        for detector in DETECTORS:
            score = known.bench.score(detector, own)
            if free:
                out[f"{prefix}alarms/{detector}"] = _sweep(own, score)
            else:
                out[f"{prefix}score/{detector}"] = score.astype(np.float32)
    return out


def _default(events: Events) -> dict[str, NDArray[Any]]:
    return {
        "default/t_ns": events.t_ns,
        "default/contact": events.contact,
        "default/onset_ns": events.onset_ns,
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


def default_events(result: dict[str, NDArray[Any]], index: int) -> Events:
    """The default detector's events of a job's piece."""
    prefix = f"{index}/default/"
    return Events(*(result[prefix + field] for field in ("t_ns", "contact", "onset_ns")))
