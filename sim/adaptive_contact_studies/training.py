"""The shipped baselines: which runs they are learned from, and how.

Every leg of the hexapod is recorded in pose (the paper's subspaces and its whole reach, fast and
slow) and walking in every gait over rough ground and steps, on a robot with its own manufacturing
spread; the quadruped in both of its gaits, faster and slower; the leg on a stand in free air.
Ticks near a touch are left out by the truth.  Seeds are kept apart: learning uses 1000 and up of
the hexapod, 2000 and up of the quadruped, 3000 and up of the leg, tests and benchmarks others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.fit.recordings import untouched
from adaptive_contact.fit.train import Stretch, Training, learn
from adaptive_contact_sim.arrays import Run, record_arrays
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.terrain import TerrainKind, TerrainSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.work import SIMULATOR, Work, rests_on


class PlannedRun(NamedTuple):
    """One run to learn from, or to score."""

    name: str  # of the run, or of the row it belongs to
    settings: SimulationSettings
    seconds: float


def _pose(name: str, seed: int, seconds: float, motion: PoseSettings) -> PlannedRun:
    return PlannedRun(name, SimulationSettings(motion=motion, seed=seed), seconds)


def _walk(
    name: str, seed: int, seconds: float, motion: WalkSettings, terrain: TerrainKind
) -> PlannedRun:
    ground = TerrainSettings(kind=terrain)
    return PlannedRun(name, SimulationSettings(motion=motion, seed=seed, terrain=ground), seconds)


def _other(
    name: str, robot: str, seed: int, seconds: float, terrain: TerrainKind | None, **changes: Any
) -> PlannedRun:
    """A run of another robot: its own settings, some of its motion's changed."""
    gait = changes.get("gait")
    settings = SimulationSettings.of(robot, "pose" if terrain is None else "walk", gait)
    motion = replace(settings.motion, **changes)
    ground = settings.terrain if terrain is None else replace(settings.terrain, kind=terrain)
    return PlannedRun(name, replace(settings, motion=motion, terrain=ground, seed=seed), seconds)


_HEXAPOD: Final = (
    _pose("pose, paper's subspaces", 1001, 900.0, PoseSettings(legs=LEGS)),
    _pose("pose, whole reach", 1002, 1200.0, PoseSettings(legs=LEGS, workspace="whole")),
    _pose("pose, slow descents", 1003, 900.0, PoseSettings(legs=LEGS, approach="slow")),
    _pose("pose, level swings", 1004, 450.0, PoseSettings(legs=LEGS, approach="forward")),
    _walk("tripod, rough", 1011, 600.0, WalkSettings(gait="tripod"), "rough"),
    _walk("ripple, rough", 1012, 600.0, WalkSettings(gait="ripple"), "rough"),
    _walk("wave, rough", 1013, 600.0, WalkSettings(gait="wave"), "rough"),
    _walk("tripod, steps", 1014, 300.0, WalkSettings(gait="tripod"), "steps"),
)
_QUADRUPED12: Final = (
    _other("trot, rough", "quadruped12", 2001, 400.0, "rough", gait="trot"),
    _other("slow trot, rough", "quadruped12", 2002, 400.0, "rough", gait="trot", swing_s=0.36),
    _other("trot, steps", "quadruped12", 2003, 200.0, "steps", gait="trot"),
    _other("walk, rough", "quadruped12", 2011, 600.0, "rough", gait="walk"),
    _other("fast walk, rough", "quadruped12", 2012, 400.0, "rough", gait="walk", swing_s=0.45),
    _other("walk, steps", "quadruped12", 2013, 200.0, "steps", gait="walk"),
)
_LEG5: Final = (
    _other("pose", "leg5", 3001, 900.0, None),
    _other("pose, fast", "leg5", 3002, 600.0, None, segment_ticks=13),
    _other("pose, long swings", "leg5", 3003, 600.0, None, segment_ticks=30),
    _other("pose, straight in the joints", "leg5", 3004, 600.0, None, path="joint"),
    _other("pose, slow descents", "leg5", 3005, 600.0, None, approach="slow"),
)
TRAINING_RUNS: Final = {"hexapod": _HEXAPOD, "quadruped12": _QUADRUPED12, "leg5": _LEG5}


def stretch_of(run: Run, leg: str, period_s: float = 0.02) -> Stretch:
    """A leg's run as a stretch to learn from, ticks near a touch marked as not free."""
    arrays = run.legs[leg]
    return Stretch(
        measured=arrays.measured,
        desired=arrays.desired,
        swing=arrays.swing,
        free=untouched(run.t_ns, arrays.changes, round(period_s * 1e9)),
        sound=np.asarray(arrays.valid.all(axis=1)),
    )


@rests_on(*SIMULATOR)
def recorded(_: Work, spec: PlannedRun) -> Run:
    """Record a run."""
    return record_arrays(spec.settings, spec.seconds)


def record_all(work: Work, runs: Sequence[PlannedRun]) -> list[Run]:
    """Record runs, several at a time."""
    return work.each("recording", recorded, runs, lambda spec: spec.seconds)


def learn_shipped(
    name: str,
    work: Work,
    *,
    runs: tuple[PlannedRun, ...] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Training:
    """Record the runs and learn every leg of a simulated robot.

    Raises:
        ConfigurationError: the simulator has no such robot.
        SimulationDivergedError: a run did.
        IdentificationError: the runs do not suffice.
    """
    robot = simulated_robot(name).description
    runs = TRAINING_RUNS[name] if runs is None else runs
    streams: dict[str, list[Stretch]] = {leg: [] for leg in robot.leg_ids}
    for run in record_all(work, runs):
        for leg in robot.leg_ids:
            if run.legs[leg].swing.any():
                streams[leg].append(stretch_of(run, leg, robot.period_s))
    seconds = sum(spec.seconds for spec in runs)
    seeds = f"{runs[0].settings.seed} to {runs[-1].settings.seed}"
    return learn(
        robot,
        streams,
        origin=(
            f"adaptive-contact sim baseline: {len(runs)} simulated runs, {seconds:.0f} s, "
            f"seeds {seeds}: " + "; ".join(spec.name for spec in runs)
        ),
        progress=lambda leg: progress(f"fitting leg {leg}"),
    )
