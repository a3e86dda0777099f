"""Simulates what robots send: walks, poses and changes, as rounds of plain samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final

import msgspec

from adaptive_contact.wire import Drift, DriftKind, ServoSample
from adaptive_contact_sim import (
    Injection,
    ObstacleSettings,
    PoseSettings,
    Simulation,
    SimulationSettings,
    TerrainSettings,
    WalkSettings,
)
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.obstacles import Approach
from adaptive_contact_studies.scenarios.spec import Staging
from adaptive_contact_studies.scenarios.staging import stagehand

# One leg's sample as plain values; what is left out has its default.
Sample = dict[str, Any]
Round = dict[str, Sample]
# Makes a bad sample of one and the one before; whether it comes instead, or besides.
Spoiler = Callable[[Sample, Sample], tuple[Sample, bool]]

PERIOD_NS: Final = 20_000_000
TRIPOD: Final = ("lm", "rf", "rr")


@dataclass
class Recording:
    """What learners are given, and when they are asked.

    Attributes:
        robot: content of ``robot.toml``.
        baseline: content of a baseline file, None for a cold start.
        rounds: samples, by leg.
        looks: after which round the status of which legs is noted.
        restarts: before which rounds the service that has the learners is started again.
        judged: whether score and p of every tick are noted.
    """

    robot: str
    baseline: bytes | None
    rounds: list[Round]
    looks: list[tuple[int, list[str]]] = field(default_factory=list)
    restarts: list[int] = field(default_factory=list)
    judged: bool = False


def simulated(
    settings: SimulationSettings,
    seconds: float,
    legs: Sequence[str],
    staging: Staging | None = None,
) -> list[Round]:
    sim = Simulation(settings)
    rounds = []
    with stagehand(sim, staging or Staging(), legs[0]) as hand:
        for _ in range(round(seconds / settings.period_s)):
            hand.before_tick()
            samples = sim.tick().samples
            rounds.append({leg: plain(samples[leg]) for leg in legs})
    return rounds


def plain(sample: ServoSample) -> Sample:
    fields: Sample = msgspec.to_builtins(sample)
    del fields["v"]
    return fields


def shipped(name: str, file: str) -> bytes:
    return resources.files("adaptive_contact_models").joinpath(name, file).read_bytes()


def hexapod(rounds: list[Round]) -> Recording:
    robot = shipped("hexapod", "robot.toml").decode()
    return Recording(robot, shipped("hexapod", "baseline.json"), rounds)


def hexapod_walk(seed: int, seconds: float) -> Recording:
    terrain = TerrainSettings(kind="rough")
    settings = SimulationSettings(motion=WalkSettings(gait="tripod"), terrain=terrain, seed=seed)
    return hexapod(simulated(settings, seconds, LEGS))


def hexapod_pose(
    seed: int,
    seconds: float,
    *,
    obstacles: float = 0.5,
    approach: Approach = "descent",
    drift: tuple[Injection, ...] = (),
    staging: Staging | None = None,
) -> list[Round]:
    settings = SimulationSettings(
        motion=PoseSettings(
            obstacles=ObstacleSettings(probability=obstacles, soft=0.3), approach=approach
        ),
        seed=seed,
        drift=drift,
    )
    return simulated(settings, seconds, ("rf",), staging)


def change(kind: DriftKind, value: float, at_s: float) -> tuple[Injection, ...]:
    return (Injection(Drift(kind=kind, value=value), at_s),)
