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
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from adaptive_contact.fit.recordings import untouched
from adaptive_contact.fit.train import Stretch, Training, learn
from adaptive_contact_sim.arrays import Run, record_run
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import TerrainKind
from adaptive_contact_studies.work import SIMULATOR, Work, rests_on


class PlannedRun(NamedTuple):
    """One run to learn from, or to score."""

    name: str  # of the run, or of the row it belongs to
    settings: SimulationSettings
    seconds: float


def planned_run(
    name: str,
    robot: str,
    seed: int,
    seconds: float,
    terrain: TerrainKind | None = None,
    **changes: Any,
) -> PlannedRun:
    """Plan a run: a robot's own settings, some of its motion's changed; without ground a pose."""
    mode: Literal["pose", "walk"] = "pose" if terrain is None else "walk"
    settings = SimulationSettings.from_robot(robot, mode, changes.get("gait"))
    motion = replace(settings.motion, **changes)
    ground = settings.terrain if terrain is None else replace(settings.terrain, kind=terrain)
    return PlannedRun(name, replace(settings, motion=motion, terrain=ground, seed=seed), seconds)


TRAINING_RUNS: Final = {
    "hexapod": (
        planned_run("pose, paper's subspaces", "hexapod", 1001, 900.0, legs=LEGS),
        planned_run("pose, whole reach", "hexapod", 1002, 1200.0, legs=LEGS, workspace="whole"),
        planned_run("pose, slow descents", "hexapod", 1003, 900.0, legs=LEGS, approach="slow"),
        planned_run("pose, level swings", "hexapod", 1004, 450.0, legs=LEGS, approach="forward"),
        planned_run("tripod, rough", "hexapod", 1011, 600.0, "rough", gait="tripod"),
        planned_run("ripple, rough", "hexapod", 1012, 600.0, "rough", gait="ripple"),
        planned_run("wave, rough", "hexapod", 1013, 600.0, "rough", gait="wave"),
        planned_run("tripod, steps", "hexapod", 1014, 300.0, "steps", gait="tripod"),
    ),
    "quadruped12": (
        planned_run("trot, rough", "quadruped12", 2001, 400.0, "rough", gait="trot"),
        planned_run(
            "slow trot, rough", "quadruped12", 2002, 400.0, "rough", gait="trot", swing_s=0.36
        ),
        planned_run("trot, steps", "quadruped12", 2003, 200.0, "steps", gait="trot"),
        planned_run("walk, rough", "quadruped12", 2011, 600.0, "rough", gait="walk"),
        planned_run(
            "fast walk, rough", "quadruped12", 2012, 400.0, "rough", gait="walk", swing_s=0.45
        ),
        planned_run("walk, steps", "quadruped12", 2013, 200.0, "steps", gait="walk"),
    ),
    "leg5": (
        planned_run("pose", "leg5", 3001, 900.0),
        planned_run("pose, fast", "leg5", 3002, 600.0, segment_ticks=13),
        planned_run("pose, long swings", "leg5", 3003, 600.0, segment_ticks=30),
        planned_run("pose, straight in the joints", "leg5", 3004, 600.0, path="joint"),
        planned_run("pose, slow descents", "leg5", 3005, 600.0, approach="slow"),
    ),
}


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
    """Record a run; of one in pose the legs that move."""
    legs = getattr(spec.settings.motion, "legs", None)
    return record_run(Simulation(spec.settings), spec.seconds, legs=legs)


def record_all(work: Work, runs: Sequence[PlannedRun]) -> list[Run]:
    """Record runs, several at a time."""
    return work.each("recording", recorded, runs)


def learn_shipped(
    name: str,
    work: Work,
    *,
    progress: Callable[[str], None] = lambda _: None,
) -> Training:
    """Record the runs and learn every leg of a simulated robot.

    Raises:
        ConfigurationError: the simulator has no such robot.
        SimulationDivergedError: a run did.
        IdentificationError: the runs do not suffice.
    """
    robot = simulated_robot(name).description
    runs = TRAINING_RUNS[name]
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
