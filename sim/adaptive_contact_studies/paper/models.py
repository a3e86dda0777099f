"""Learned models, noise and thresholds of every leg-run, kept as text.

A baseline file is what the product itself writes; the compared detectors' thresholds are kept
beside it as plain numbers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive_contact.fit.train import Training, learn
from adaptive_contact.model import LibraryName, Window
from adaptive_contact.model.model_file import Baseline, dump_baseline, parse_baseline
from adaptive_contact.model.noise import NoiseModel
from adaptive_contact.model.tail import Tail
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_studies.cache import Store, plain
from adaptive_contact_studies.paper.analytical import Gains, NominalLeg, predict, tune_gains
from adaptive_contact_studies.paper.comparison_rules import Calibration
from adaptive_contact_studies.paper.data import Stream, load
from adaptive_contact_studies.paper.detectors import (
    Bench,
    LegModels,
    evidence_of,
    tune_bench,
)
from adaptive_contact_studies.paper.plan import LegRun, Piece, Plan
from adaptive_contact_studies.paper.recording import physics_fingerprint, source_fingerprint
from adaptive_contact_studies.paper.rows import PAPER_WINDOW, rms_deg

# Streams on which the observer's gains are chosen: enough to distinguish gains.
_GAIN_STREAMS: Final = 6
# λ of the paper's library, in units of the residual: on the plateau of the identification study,
# where all thresholds predict alike.
_PAPER_THRESHOLD: Final = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Learned:
    """Everything learned before the report's streams are touched."""

    models: dict[str, LegModels]  # by leg-run's name
    baselines: dict[int, Baseline]  # of the default detector, by seed of the robot
    gains: Gains  # of the analytical observer
    bench: Bench  # of the compared detectors
    figures: dict[str, Any]  # how well every leg was learned, and the analytical model's residuals


def models_key(plan: Plan) -> list[Any]:
    """All that decides the learned models."""
    pieces = [plain(p) for role in ("train", "tune") for p in plan.pieces(role)]
    return [physics_fingerprint(), source_fingerprint(), pieces]


def learn_robot(item: tuple[Path, Plan, int]) -> int:
    """Learn the legs of one robot, unless it was done: a work item for a process."""
    root, plan, robot_seed = item
    _robot_tree(Store(root), plan, robot_seed)
    return robot_seed


def learned(store: Store, plan: Plan) -> Learned:
    """Read or make everything learned."""
    robot = shipped_robot()
    models: dict[str, LegModels] = {}
    baselines: dict[int, Baseline] = {}
    figures: dict[str, Any] = {"legs": {}}
    for seed in plan.robots:
        tree = _robot_tree(store, plan, seed)
        servo, paper, default = (
            parse_baseline(tree[name].encode(), source=f"{name} of robot {seed}")
            for name in ("servo", "paper", "default")
        )
        baselines[seed] = default
        for leg in plan.legs:
            name = LegRun(seed, leg).name
            models[name] = LegModels(servo.legs[leg].model, paper.legs[leg].model)
            figures["legs"][name] = tree["figures"][leg]
    tree = store.tree("bench", models_key(plan), lambda: _tune(store, plan, robot, models))
    gains = Gains(np.array(tree["gains"]["angle"]), np.array(tree["gains"]["speed"]))
    figures["analytical"] = tree["analytical"]
    kept = tree["bench"]
    bench = Bench(
        lag=kept["lag"],
        noise={
            model: {
                name: NoiseModel(np.array(entry["covariance"]), np.array(entry["ticks"]))
                for name, entry in known.items()
            }
            for model, known in kept["noise"].items()
        },
        calibrations={
            name: Calibration(
                tuple(Tail(**tail) for tail in entry["tails"]), tuple(entry["channels"])
            )
            for name, entry in kept["calibrations"].items()
        },
        quantum_rad=robot.quantum_rad,
        aim_per_hour=robot.detector.false_alarms_per_hour,
        tuned=kept["tuned"],
    )
    figures["lag"], figures["tuned"] = bench.lag, bench.tuned
    figures["channels"] = {name: c.channels for name, c in bench.calibrations.items()}
    figures["gains"] = tree["gains"]
    return Learned(models, baselines, gains, bench, figures)


def _robot_tree(store: Store, plan: Plan, robot_seed: int) -> dict[str, Any]:
    found: dict[str, Any] = store.tree(
        "models", [*models_key(plan), robot_seed], lambda: _learn(store, plan, robot_seed)
    )
    return found


def _learn(store: Store, plan: Plan, robot_seed: int) -> dict[str, Any]:
    robot = shipped_robot()
    train = _streams(store, plan.pieces("train"), robot_seed)
    tune = _streams(store, plan.pieces("tune"), robot_seed)
    both = {leg: train[leg] + tune[leg] for leg in train}

    def fit(
        streams: dict[str, list[Stream]],
        library: LibraryName,
        window: Window,
        threshold: float | None = None,
    ) -> Training:
        return learn(
            robot,
            {leg: [s.stretch for s in own] for leg, own in streams.items()},
            origin=f"experiments, robot {robot_seed}",
            library=library,
            window=window,
            threshold=threshold,
        )

    servo = fit(train, "servo", Window())
    paper = fit(train, "paper", PAPER_WINDOW, _PAPER_THRESHOLD)
    default = fit(both, "servo", Window())
    return {
        "servo": dump_baseline(servo.baseline),
        "paper": dump_baseline(paper.baseline),
        "default": dump_baseline(default.baseline),
        "figures": {
            leg: {
                name: dataclasses.asdict(training.figures[leg])
                for name, training in (("servo", servo), ("paper", paper), ("default", default))
            }
            for leg in train
        },
    }


def _streams(store: Store, pieces: Sequence[Piece], robot_seed: int) -> dict[str, list[Stream]]:
    found: dict[str, list[Stream]] = {}
    for piece in pieces:
        if piece.leg_run.robot_seed == robot_seed:
            found.setdefault(piece.leg_run.leg, []).append(load(store, piece))
    return found


def _tune(store: Store, plan: Plan, robot: Robot, models: dict[str, LegModels]) -> dict[str, Any]:
    """Choose everything that is chosen on tuning streams, as a tree."""
    streams = [load(store, piece) for piece in plan.pieces("tune")]
    free = [s for s in streams if s.piece.kind not in plan.tune_touch_s]
    some = free[:: max(1, len(free) // _GAIN_STREAMS)]
    pairs = [(s.measured, s.desired) for s in some]
    masks = [s.swing for s in some]
    leg = NominalLeg.of()
    gains = tune_gains(leg, pairs, masks)
    assert gains.speed is not None
    analytical = {
        "observer": _analytical_rms(leg, pairs, masks, gains),
        "positions only": _analytical_rms(leg, pairs, masks, Gains(np.ones(3), None)),
    }
    evidence = evidence_of(robot, streams, models, gains)
    touch = [e for e in evidence if e.stream.piece.kind in plan.tune_touch_s]
    quiet = [e for e in evidence if e.stream.piece.kind not in plan.tune_touch_s]
    bench = tune_bench(robot, quiet, touch, robot.detector.false_alarms_per_hour)
    return {"gains": gains, "analytical": analytical, "bench": bench}


def _analytical_rms(
    leg: NominalLeg,
    pairs: list[tuple[Any, Any]],
    masks: list[Any],
    gains: Gains,
) -> list[float]:
    predicted = predict(leg, pairs, gains)
    parts = [(p[0] - t)[m] for p, t, m in zip(pairs, predicted, masks, strict=True)]
    return rms_deg(np.concatenate(parts))
