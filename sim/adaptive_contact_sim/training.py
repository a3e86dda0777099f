"""The shipped baseline: which runs it is learned from, and how.

Every leg is recorded in pose (the paper's subspaces and its whole reach, fast and slow) and walking
in every gait over rough ground and steps, on a robot with its own manufacturing spread.  Ticks
near a touch are left out by the truth.  Seeds are kept apart: learning uses 1000 and up, tests and
benchmarks others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.fit.recordings import untouched
from adaptive_contact.fit.train import Stretch, Training, learn
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.arrays import LegArrays, Run, record_arrays
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.terrain import TerrainKind, TerrainSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_sim.workers import worker_pool

__all__ = ["TRAINING_RUNS", "TrainingRun", "learn_shipped", "stretch_of", "truth_of"]


class TrainingRun(NamedTuple):
    """One run to learn from."""

    name: str
    settings: SimulationSettings
    seconds: float


def _pose(name: str, seed: int, seconds: float, motion: PoseSettings) -> TrainingRun:
    return TrainingRun(name, SimulationSettings(motion=motion, seed=seed), seconds)


def _walk(
    name: str, seed: int, seconds: float, motion: WalkSettings, terrain: TerrainKind
) -> TrainingRun:
    ground = TerrainSettings(kind=terrain)
    return TrainingRun(name, SimulationSettings(motion=motion, seed=seed, terrain=ground), seconds)


TRAINING_RUNS: Final = (
    _pose("pose, paper's subspaces", 1001, 900.0, PoseSettings(legs=LEGS)),
    _pose("pose, whole reach", 1002, 1200.0, PoseSettings(legs=LEGS, workspace="whole")),
    _pose("pose, slow descents", 1003, 900.0, PoseSettings(legs=LEGS, approach="slow")),
    _pose("pose, level swings", 1004, 450.0, PoseSettings(legs=LEGS, approach="forward")),
    _walk("tripod, rough", 1011, 600.0, WalkSettings(gait="tripod"), "rough"),
    _walk("ripple, rough", 1012, 600.0, WalkSettings(gait="ripple"), "rough"),
    _walk("wave, rough", 1013, 600.0, WalkSettings(gait="wave"), "rough"),
    _walk("tripod, steps", 1014, 300.0, WalkSettings(gait="tripod"), "steps"),
)


def truth_of(leg: LegArrays) -> list[ContactTruth]:
    """A leg's changes of contact as messages, in order of time."""
    onsets = [
        ContactTruth(
            t_ns=o.t_ns,
            contact=True,
            force=o.force_n,
            speed_m_s=o.speed_m_s,
            surface=o.surface,
            part=o.part,
            grazing=o.grazing,
        )
        for o in leg.onsets
    ]
    releases = [ContactTruth(t_ns=t, contact=False, force=0.0) for t in leg.releases_ns]
    return sorted([*onsets, *releases], key=lambda change: (change.t_ns, change.contact))


def stretch_of(run: Run, leg: str, period_s: float = 0.02) -> Stretch:
    """A leg's run as a stretch to learn from, ticks near a touch marked as not free."""
    arrays = run.legs[leg]
    return Stretch(
        measured=arrays.measured,
        desired=arrays.desired,
        swing=arrays.swing,
        free=untouched(run.t_ns, truth_of(arrays), round(period_s * 1e9)),
        sound=np.asarray(arrays.valid.all(axis=1)),
    )


def learn_shipped(
    robot: Robot,
    *,
    runs: tuple[TrainingRun, ...] = TRAINING_RUNS,
    processes: int = 2,
    progress: Callable[[str], None] = lambda _: None,
) -> Training:
    """Record the runs and learn every leg of the simulated robot.

    Args:
        robot: its description.
        runs: what to learn from.
        processes: how many runs to simulate at a time; the result does not depend on it.
        progress: told of every run recorded and every leg fitted.

    Returns:
        The baseline with its figures.

    Raises:
        SimulationDivergedError: a run did.
        IdentificationError: the runs do not suffice.
    """
    streams: dict[str, list[Stretch]] = {leg: [] for leg in LEGS}
    for run in _record(runs, processes, progress):
        for leg in LEGS:
            if run.legs[leg].swing.any():
                streams[leg].append(stretch_of(run, leg, robot.period_s))
    seconds = sum(run.seconds for run in runs)
    seeds = f"{runs[0].settings.seed} to {runs[-1].settings.seed}"
    return learn(
        robot,
        streams,
        origin=(
            f"adaptive-contact sim baseline: {len(runs)} simulated runs, {seconds:.0f} s, "
            f"seeds {seeds}: " + "; ".join(run.name for run in runs)
        ),
        progress=lambda leg: progress(f"fitting leg {leg}"),
    )


def _record(
    runs: tuple[TrainingRun, ...], processes: int, progress: Callable[[str], None]
) -> Iterator[Run]:
    """The runs in their order, however many at a time."""
    if processes <= 1:
        for spec in runs:
            yield record_arrays(spec.settings, spec.seconds)
            progress(f"recorded {spec.name}")
        return
    with worker_pool(processes) as pool:
        futures = {pool.submit(record_arrays, s.settings, s.seconds): s for s in runs}
        for future in as_completed(futures):
            future.result()  # a failed run ends the others early
            progress(f"recorded {futures[future].name}")
        done = {spec.name: future.result() for future, spec in futures.items()}
    for spec in runs:
        yield done[spec.name]
