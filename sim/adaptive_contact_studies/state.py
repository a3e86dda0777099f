"""The state in every tick against the truth, on robots that its weights do not come from.

Each robot's walk is judged with weights that were fitted to all others (a logistic regression,
every robot with the same weight).  Commands of the walks know nothing of the ground: nothing stops
a descent, and the phase is as planned.

``python -m adaptive_contact_studies.state [SECONDS [WALK ...]]``
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import Annotated, Final, NamedTuple

import numpy as np
import typer

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.core.bank import LegGroup
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.model.model_file import shipped_baseline
from adaptive_contact.robot.description import DetectorSettings
from adaptive_contact_bullet.gait import GAITS
from adaptive_contact_bullet.plant import Ground, Kind
from adaptive_contact_bullet.record import Plan, record
from adaptive_contact_sim import (
    PoseSettings,
    SimulationSettings,
    WalkSettings,
    record_arrays,
    simulated_robot,
)
from adaptive_contact_sim.arrays import Run
from adaptive_contact_sim.scenario import parse_drift
from adaptive_contact_studies.evaluate import samples_of

# robot, gait, ground; those of the second engine begin with its name
_WALKS: Final = (
    "hexapod tripod rough", "hexapod ripple flat", "hexapod tripod soft", "hexapod wave steps",
    "hexapod tripod rough friction:value=4@20s", "quadruped12 walk rough", "quadruped12 trot rough",
    "leg5 pose obstacles", "bullet-hexapod tripod-planned hard", "bullet-hexapod tripod-fast rough",
    "bullet-geared tripod-planned hard", "bullet-light tripod-planned rough",
    "bullet-worm tripod-planned hard", "bullet-quadruped trot-planned hard",
    "bullet-quadruped trot-slow hard", "bullet-arm steps plates",
)  # fmt: skip
_HUNG: Final = (
    "bullet-hexapod tripod-planned none", "bullet-geared tripod-planned none",
    "bullet-light tripod none", "bullet-worm tripod-planned none",
    "bullet-quadruped trot-planned none", "bullet-arm steps none", "leg5 pose none",
)  # fmt: skip
_BINS: Final = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)


class Leg(NamedTuple):
    """What is known of a leg in n ticks."""

    walk: str
    period_s: float
    features: Array  # (n, 3) constant, sum of pushes, misfit
    odds: Array  # (n,) of the command
    p: Array  # (n,) of the product, NaN while unknown
    truth: Mask
    stance: Mask  # by the phase
    event: Mask  # by the last event

    @property
    def robot(self) -> str:
        """Its name."""
        return self.walk.split()[0]

    @property
    def known(self) -> Mask:
        """(n,) whether there is a state."""
        return ~np.isnan(self.p)


def recorded(walk: str, seconds: float, seed: int) -> tuple[Run, ContactLearner]:
    """Record a walk; the learner is the first leg's, whose robot the others share."""
    robot, gait, ground, *drift = walk.split()
    if robot.startswith("bullet-"):
        name, hangs = robot.removeprefix("bullet-"), ground in ("none", "plates")
        kind: Kind = "none" if hangs else ground  # type: ignore[assignment]
        planned = dataclasses.replace(GAITS[gait], stop="never", linger_s=0.0)
        plates = 0.6 if ground == "plates" else 0.0
        if not plates:
            # Below the ground, of gaits that nothing stops.
            planned = dataclasses.replace(planned, below_m=0.004)
        made = record(Plan(name, planned, Ground(kind), seconds, seed, seed, plates=plates))
        description, run = made.shape.description, made.run
        return run, ContactLearner(description, description.leg_ids[0])
    mode = "pose" if gait == "pose" else "walk"
    settings = SimulationSettings.from_robot(robot, mode, None if mode == "pose" else gait)  # type: ignore[arg-type]
    motion = settings.motion
    if isinstance(motion, PoseSettings):
        share = 0.6 if ground == "obstacles" else 0.0
        obstacles = dataclasses.replace(motion.obstacles, probability=share)
        settings = dataclasses.replace(
            settings, motion=dataclasses.replace(motion, obstacles=obstacles)
        )
    elif isinstance(motion, WalkSettings):
        settings = dataclasses.replace(
            settings,
            motion=dataclasses.replace(motion, stop_on="never", phase="planned"),
            terrain=dataclasses.replace(settings.terrain, kind=ground),  # type: ignore[arg-type]
        )
    settings = dataclasses.replace(
        settings, seed=seed, robot_seed=seed, drift=tuple(parse_drift(text) for text in drift)
    )
    described = simulated_robot(robot).description
    run = record_arrays(settings, seconds)
    return run, ContactLearner(described, next(iter(run.legs)), shipped_baseline(robot))


def played(walk: str, seconds: float, seed: int) -> list[Leg]:
    """Play a walk to the product, from nothing on the second engine, and keep every tick."""
    run, first = recorded(walk, seconds, seed)
    robot = first.robot
    legs = [leg for leg, arrays in run.legs.items() if arrays.swing.any()]
    learners = [ContactLearner(robot, leg, shipped_baseline(robot.name)) for leg in legs]
    group = LegGroup(learners)
    kept = np.zeros((len(legs), len(run.t_ns), 5))
    for k, samples in enumerate(zip(*(samples_of(run, leg) for leg in legs), strict=True)):
        group.advance(samples)
        for row, learner in zip(kept, learners, strict=True):
            leg = learner.place.leg
            row[k] = leg.push_sum, leg.misfit, leg.command_odds, leg.p, learner.contact
    return [
        Leg(
            walk, robot.period_s, np.column_stack([np.ones(len(row)), row[:, :2]]), row[:, 2],
            row[:, 3], run.legs[leg].contact, ~run.legs[leg].swing, row[:, 4] > 0.0,
        )
        for leg, row in zip(legs, kept, strict=True)
    ]  # fmt: skip


def fitted(legs: Sequence[Leg]) -> Array:
    """Fit the weights, every robot with the same weight; the command's odds are as they are."""
    # Its drives hold what they carry: nothing of it shows, and weights are not fitted to it.
    legs = [leg for leg in legs if leg.robot != "bullet-worm" and leg.known.any()]
    ticks = {leg.robot: 0 for leg in legs}
    for leg in legs:
        ticks[leg.robot] += int(leg.known.sum())
    x = np.concatenate([leg.features[leg.known] for leg in legs])
    odds = np.concatenate([leg.odds[leg.known] for leg in legs])
    truth = np.concatenate([leg.truth[leg.known] for leg in legs])
    weight = np.concatenate([np.full(leg.known.sum(), 1.0 / ticks[leg.robot]) for leg in legs])
    weights = np.zeros(x.shape[1])
    for _ in range(20):  # Newton's steps
        p = _logistic(x @ weights + odds)
        curvature = (x * (weight * p * (1.0 - p))[:, None]).T @ x
        weights += np.linalg.solve(curvature, x.T @ (weight * (truth - p)))
    return weights


def _logistic(odds: Array) -> Array:
    return np.asarray(1.0 / (1.0 + np.exp(-odds)))


def judged(leg: Leg, weights: Array) -> Array:
    """(n,) p of a leg by other weights, NaN while unknown."""
    return np.where(leg.known, _logistic(leg.features @ weights + leg.odds), np.nan)


def released_ms(leg: Leg, p: Array) -> list[float]:
    """How long after each true lift-off the state says so, of lift-offs that last 60 ms."""
    truth, ticks = leg.truth, round(0.06 / leg.period_s)
    late = []
    for k in np.flatnonzero(truth[:-1] & ~truth[1:]) + 1:
        if leg.known[k - 1] and not truth[k : k + ticks].any() and k + 50 < len(p):
            said = np.flatnonzero(~(p[k : k + 50] > DetectorSettings().touches_above))
            late.append(1e3 * leg.period_s * (said[0] if len(said) else 50))
    return late


def table(legs: Sequence[Leg], hung: Sequence[Leg]) -> str:
    """Write what was found as Markdown."""
    lines = [
        "| walk | known | phase right | events right | state right | Brier "
        "| lift-off to release, median / p95 "
        "| truly loaded where p is below 0.1, 0.3, 0.5, 0.7, 0.9, 1 |",
        "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    robots = dict.fromkeys(leg.robot for leg in legs)
    weights = {
        robot: fitted([leg for leg in legs if leg.robot != robot] or legs) for robot in robots
    }
    for walk in dict.fromkeys(leg.walk for leg in legs):
        own = [leg for leg in legs if leg.walk == walk]
        ps = [judged(leg, weights[leg.robot]) for leg in own]
        known = np.concatenate([leg.known for leg in own])
        p = np.concatenate(ps)[known]
        truth, stance, event = (
            np.concatenate([np.asarray(getattr(leg, name)) for leg in own])[known]
            for name in ("truth", "stance", "event")
        )
        late = [ms for leg, one in zip(own, ps, strict=True) for ms in released_ms(leg, one)]
        of_bin = np.digitize(p, _BINS[1:-1])
        share = [
            f"{100 * truth[of_bin == b].mean():.0f}" if (of_bin == b).any() else "–"
            for b in range(len(_BINS) - 1)
        ]
        release = "–" if not late else " / ".join(f"{q:.0f}" for q in np.percentile(late, (50, 95)))
        right = [100 * np.mean(one == truth) for one in (stance, event, p > 0.5)]
        lines.append(
            f"| {walk} | {100 * known.mean():.0f} % | "
            + " | ".join(f"{one:.1f} %" for one in right)
            + f" | {np.square(p - truth).mean():.3f} | {release} ms | {', '.join(share)} % |"
        )
    lines += ["", "| hangs | ticks in touch | known |", "|---|---|---|"]
    for walk in dict.fromkeys(leg.walk for leg in hung):
        p = np.concatenate([leg.p for leg in hung if leg.walk == walk])
        touching, known_share = 100 * np.mean(p > 0.5), 100 * np.mean(~np.isnan(p))
        lines.append(f"| {walk} | {touching:.2f} % | {known_share:.1f} % |")
    if len(robots) > 1:
        every = ", ".join(f"{w:.2f}" for w in fitted(legs))
        lines += ["", f"Weights of all robots: {every}."]
    return "\n".join(lines)


def main(
    seconds: Annotated[float, typer.Argument(help="Of each walk.")] = 60.0,
    names: Annotated[list[str] | None, typer.Argument(help="Walks, as the table has them.")] = None,
) -> None:
    """Judge all walks, or some, and print what was found."""
    wanted = [walk for walk in (*_WALKS, *_HUNG) if not names or walk in names]
    legs: list[Leg] = []
    for seed, walk in enumerate(wanted, start=21):
        legs += played(walk, seconds, seed)
        print(walk, file=sys.stderr)
    hung = [leg for leg in legs if leg.walk in _HUNG]
    print(table([leg for leg in legs if leg.walk not in _HUNG], hung))


if __name__ == "__main__":
    typer.run(main)
