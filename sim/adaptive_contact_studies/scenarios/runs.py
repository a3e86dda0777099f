"""The runs behind the scenarios: which leg, which seed, how long, what changes.

Every run in pose moves the legs of one tripod, each with its own trials and obstacles, while the
robot stands on the other: three leg-runs.  Runs take turns between the tripods and between the
workspaces, with the same seeds in every scenario, so that figures compare like with like.  Every
run of a walk gives six leg-runs.  What drifts, drifts in all legs that are kept.  Seeds from 7000
on are for reporting only: baselines are learned from 1000 on, tests use others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from adaptive_contact.wire import Drift, DriftKind, DriftShape
from adaptive_contact_sim.drift import Injection
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.pose_group import TRIPODS, PoseGroupSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.terrain import TerrainKind, TerrainSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.scenarios.spec import Phase, RecordingSpec, Staging

# A trial in pose: 10 ticks up, 10 down, 3 of hold.  A cycle of the tripod at its mean speed.
POSE_SWING_S: Final = 0.46
WALK_SWING_S: Final = 0.64 / 0.46
# Places on a descent, as shares of it: earlier, the lagging foot is still rising; later, it often
# touches in the last ticks of a swing, which cannot be judged.  With the probabilities below about
# half of the swings have a touch that counts; the rest is obstacles that could not be put in time.
_WHERE: Final = (0.15, 0.4)


@dataclass(frozen=True)
class Sizes:
    """How much of everything; times in s of simulated time."""

    leg_runs: int = 20  # behind every figure, at least
    # before_s, after_s: around a step
    before_s: float = 30.0
    after_s: float = 80.0
    # walk_before_s, walk_after_s: around a step while walking
    walk_before_s: float = 60.0
    walk_after_s: float = 180.0
    slow_s: float = 600.0  # length of a ramp or a random walk, with `before_s` before it
    slow_after_s: float = 60.0  # after a ramp or a random walk
    pulse_s: float = 60.0  # length of a pulse
    contact_swings: int = 500  # in a row that end in contact
    turn_trials: int = 262  # of a leg between two long rests, each of which lasts five turns
    caught_s: float = 30.0  # how long a foot is caught
    start_s: float = 140.0  # of a start without a baseline, or with a wrong one
    steady_walks: float = 3.0  # walks without drift, per leg-run asked for
    first_seed: int = 7000  # of all runs


FULL_SIZES: Final = Sizes()
QUICK_SIZES: Final = Sizes(
    leg_runs=2,
    before_s=15.0,
    after_s=45.0,
    walk_before_s=20.0,
    walk_after_s=60.0,
    slow_s=60.0,
    slow_after_s=20.0,
    pulse_s=20.0,
    contact_swings=60,
    turn_trials=40,
    caught_s=10.0,
    start_s=60.0,
    steady_walks=0.5,
)


@dataclass(frozen=True)
class What:
    """A change: of what, by how much; ``turning`` takes another joint in every run."""

    kind: DriftKind
    value: float
    turning: bool = False
    shape: DriftShape = "step"


def pose_run(
    sizes: Sizes, run: int, seconds: float, staging: Staging | None = None
) -> RecordingSpec:
    """A tripod in pose; half of its swings, about, end in a touch that can be judged."""
    legs = TRIPODS[run % len(TRIPODS)]
    turn = run // len(TRIPODS)
    motion = PoseGroupSettings(tuple(_pose(leg, turn + i) for i, leg in enumerate(legs)))
    settings = SimulationSettings(motion=motion, seed=sizes.first_seed + run)
    return RecordingSpec(settings, seconds, legs, staging or Staging())


def pose_runs(
    sizes: Sizes, seconds: float, staging: Staging | None = None
) -> tuple[RecordingSpec, ...]:
    """As many of them as give the leg-runs."""
    count = math.ceil(sizes.leg_runs / len(TRIPODS[0]))
    return tuple(pose_run(sizes, run, seconds, staging) for run in range(count))


def lone_runs(sizes: Sizes, seconds: float, staging: Staging) -> tuple[RecordingSpec, ...]:
    """One leg in pose per run, for what is done to one leg at a time."""
    runs = []
    for run in range(sizes.leg_runs):
        leg = LEGS[run % len(LEGS)]
        settings = SimulationSettings(
            motion=_pose(leg, run + run // len(LEGS)), seed=sizes.first_seed + run
        )
        runs.append(RecordingSpec(settings, seconds, (leg,), staging))
    return tuple(runs)


def _pose(leg: str, turn: int) -> PoseSettings:
    """In the paper's workspace and the whole one by turns."""
    whole = turn % 2 == 1
    obstacles = ObstacleSettings(probability=0.9 if whole else 0.65, where=_WHERE)
    return PoseSettings(legs=(leg,), workspace="whole" if whole else "paper", obstacles=obstacles)


def walk_run(
    sizes: Sizes, run: int, seconds: float, ground: TerrainKind = "rough"
) -> RecordingSpec:
    """A tripod over some ground, legs stopping 60 ms after the true touch."""
    settings = SimulationSettings(
        motion=WalkSettings(),
        terrain=TerrainSettings(kind=ground),
        seed=sizes.first_seed + 200 + run,  # apart from those of other kinds of run
    )
    return RecordingSpec(settings, seconds, LEGS)


def walk_runs(
    sizes: Sizes, seconds: float, ground: TerrainKind = "rough"
) -> tuple[RecordingSpec, ...]:
    """As many walks as give the leg-runs."""
    count = math.ceil(sizes.leg_runs / len(LEGS))
    return tuple(walk_run(sizes, run, seconds, ground) for run in range(count))


def walks_without_change(sizes: Sizes) -> int:
    """How many walks are without drift."""
    return max(1, round(sizes.steady_walks * sizes.leg_runs))


def turn_runs(sizes: Sizes) -> tuple[tuple[RecordingSpec, ...], float]:
    """All legs in pose, each in its turn, twice; and how long it takes until all had one, s."""
    round_s = len(LEGS) * (sizes.turn_trials * POSE_SWING_S + 2.0)
    motion = PoseSettings(
        legs=LEGS,
        trials_per_turn=sizes.turn_trials,
        obstacles=ObstacleSettings(probability=0.65, where=_WHERE),
    )
    count = math.ceil(sizes.leg_runs / len(LEGS))
    seeds = [sizes.first_seed + 400 + run for run in range(count)]  # apart from those of walks
    runs = [
        RecordingSpec(SimulationSettings(motion=motion, seed=seed), 2 * round_s, LEGS)
        for seed in seeds
    ]
    return tuple(runs), round_s


def drifting(
    spec: RecordingSpec, run: int, at_s: float, *whats: What, duration_s: float = 0.0
) -> RecordingSpec:
    """The recording with changes in every leg that it keeps, from a moment on."""
    injections = []
    layout = simulated_robot(spec.settings.robot).layout
    legs, joints = layout.legs, layout.joints
    for what in whats:
        for leg in spec.legs:
            place = legs.index(leg)
            joint = joints[(run + run // len(legs) + place) % len(joints)]
            shared = what.kind == "supply"
            drift = Drift(
                kind=what.kind,
                value=what.value,
                leg=None if shared else leg,
                joint=joint if what.turning else None,
                shape=what.shape,
                duration_s=duration_s,
                seed=len(legs) * run + place,
            )
            injections.append(Injection(drift, at_s))
            if shared:
                break
    return spec.with_settings(drift=tuple(injections))


def all_touch(
    sizes: Sizes, seconds: float, staging: Staging, soft: float = 0.0
) -> tuple[RecordingSpec, ...]:
    """Tripods in the paper's workspace, where an obstacle can always be put in time."""
    # Lower than 0.2 of the descent the foot is still rising; below 0.4 some touch too late.
    obstacles = ObstacleSettings(
        probability=0.55, soft=soft, where=(0.2, 0.4), shapes=("plate", "sphere")
    )

    def within_reach(spec: RecordingSpec) -> RecordingSpec:
        motion = spec.settings.motion
        assert isinstance(motion, PoseGroupSettings)
        poses = tuple(replace(p, workspace="paper", obstacles=obstacles) for p in motion.poses)
        return spec.with_settings(motion=PoseGroupSettings(poses))

    return tuple(within_reach(spec) for spec in pose_runs(sizes, seconds, staging))


def minutes(seconds: float) -> str:
    """Such as ``10 min`` or ``30 s``."""
    return f"{seconds / 60:g} min" if seconds % 60 == 0 else f"{seconds:g} s"


def around(at_s: float, end_s: float, swing_s: float) -> tuple[Phase, ...]:
    """Phases around a change: before, the swings on the way, and after.

    The swing during which it happens belongs to none.
    """
    # Swings after a change that are on the way, not after it: the goal for the 95th percentile.
    settled = min(at_s + 20 * swing_s, end_s)
    return (
        Phase("before", 0.0, at_s - swing_s),
        Phase("on the way", at_s, settled),
        Phase("after", settled, end_s),
    )
