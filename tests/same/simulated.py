"""Simulates what robots send: walks, poses and changes, as rounds of plain samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final

import msgspec

from adaptive_contact.wire import Drift, ServoSample
from adaptive_contact_sim import (
    EncoderSettings,
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

__all__ = [
    "CHANGE_S",
    "LONG_POSE_S",
    "PERIOD_NS",
    "TRIPOD",
    "WALK_S",
    "Recording",
    "Round",
    "Sample",
    "Spoiler",
    "change",
    "hexapod",
    "hexapod_pose",
    "hexapod_walk",
    "looks_of",
    "plain",
    "shipped",
    "simulated",
]

# One leg's sample as plain values; what is left out has its default.
Sample = dict[str, Any]
Round = dict[str, Sample]
# Makes a bad sample of one and the one before; whether it comes instead, or besides.
Spoiler = Callable[[Sample, Sample], tuple[Sample, bool]]

PERIOD_NS: Final = 20_000_000
POSE_S: Final = 90.0
LONG_POSE_S: Final = 180.0  # half a dozen refits
WALK_S: Final = 60.0  # the first refits
# When something about the leg changes: some 40 swings are long enough to know it by.
CHANGE_S: Final = 20.0
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
        probes: after which rounds, of which leg, scores and thresholds are asked for.
    """

    robot: str
    baseline: bytes | None
    rounds: list[Round]
    looks: list[tuple[int, list[str]]] = field(default_factory=list)
    restarts: list[int] = field(default_factory=list)
    probes: list[tuple[int, str]] = field(default_factory=list)

    @property
    def samples(self) -> int:
        """Of all legs."""
        return sum(map(len, self.rounds))


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


def looks_of(rounds: Sequence[Round]) -> list[tuple[int, list[str]]]:
    """After the first sample of every stance that follows a swing, and at the end."""
    swinging: set[str] = set()
    looks = []
    for number, samples in enumerate(rounds):
        ended = [leg for leg, s in samples.items() if s["phase"] != "swing" and leg in swinging]
        if ended:
            looks.append((number, ended))
        swinging = {leg for leg, s in samples.items() if s["phase"] == "swing"} | (
            swinging - set(samples)
        )
    legs = sorted({leg for samples in rounds for leg in samples})
    return [*looks, (len(rounds) - 1, legs)]


def shipped(name: str, file: str) -> bytes:
    return resources.files("adaptive_contact_models").joinpath(name, file).read_bytes()


def hexapod(rounds: list[Round]) -> Recording:
    robot = shipped("hexapod", "robot.toml").decode()
    return Recording(robot, shipped("hexapod", "baseline.json"), rounds, looks_of(rounds))


def hexapod_walk(
    seed: int, kind: str, gait: str = "tripod", *, phase: bool = True, seconds: float = WALK_S
) -> Recording:
    settings = SimulationSettings(
        motion=WalkSettings(gait=gait),  # type: ignore[arg-type]
        terrain=TerrainSettings(kind=kind),  # type: ignore[arg-type]
        seed=seed,
    )
    recording = hexapod(simulated(settings, seconds, LEGS))
    if not phase:
        for samples in recording.rounds:
            for sample in samples.values():
                del sample["phase"]
    return recording


def hexapod_pose(
    seed: int,
    *,
    seconds: float = POSE_S,
    obstacles: float = 0.5,
    approach: Approach = "descent",
    segment_ticks: int = 10,
    drift: tuple[Injection, ...] = (),
    encoder: EncoderSettings | None = None,
    staging: Staging | None = None,
) -> Recording:
    settings = SimulationSettings(
        motion=PoseSettings(
            segment_ticks=segment_ticks,
            obstacles=ObstacleSettings(probability=obstacles, soft=0.3),
            approach=approach,
        ),
        seed=seed,
        drift=drift,
        encoder=encoder or EncoderSettings(),
    )
    return hexapod(simulated(settings, seconds, ("rf",), staging))


def change(
    kind: str,
    value: float,
    at_s: float = CHANGE_S,
    *,
    joint: str | None = None,
    shape: str = "step",
    duration_s: float = 0.0,
) -> tuple[Injection, ...]:
    drift = Drift(
        kind=kind,  # type: ignore[arg-type]
        value=value,
        joint=joint,
        shape=shape,  # type: ignore[arg-type]
        duration_s=duration_s,
    )
    return (Injection(drift, at_s),)
