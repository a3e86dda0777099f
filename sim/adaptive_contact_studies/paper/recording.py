"""One leg of the standing robot, recorded for the experiments.

The same simulation as :func:`~adaptive_contact_sim.arrays.record_arrays`, of which one leg is kept,
with one difference: where a leg has come to a pocket of its workspace out of which no straight way
to a new point leads, the way is bent to the nearest reachable one instead of being drawn again
without end.

The robot hung up by its body, all six legs swinging free: free motion at a fraction of the cost.

Ten robot-hours of one leg swinging while five stand would be 35 hours of simulated time.  Here the
body is fixed in the air and every leg makes the same trials as in pose, each on its own; links,
servos, supply, friction and readings are the same code and the same constants, only the body does
not give way.  The report compares residuals here with those of the standing robot.

What names of the paper's results depend on besides their settings.

The name of recorded data holds a fingerprint of the simulator's *behaviour* (a short run, hashed),
that of an evaluation a hash of the source that evaluates: a changed simulator or detector is never
shown old numbers.
"""

from __future__ import annotations

import functools
import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

import adaptive_contact
from adaptive_contact.arrays import Array, Mask
from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim import arrays, truth
from adaptive_contact_sim.arrays import LegArrays, record_run
from adaptive_contact_sim.elements import LEGS, N_SERVOS
from adaptive_contact_sim.encoder import Encoder
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.motion import World
from adaptive_contact_sim.obstacles import ObstacleCourse, ObstacleSettings
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.pose import PERIOD_S, PoseMotion, PoseSettings
from adaptive_contact_sim.scene import on_a_stand
from adaptive_contact_sim.servo import manufactured
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_studies import evaluate, training
from adaptive_contact_studies.cache import learner_sources, sources_digest
from adaptive_contact_studies.paper.plan import GantrySettings

# Ways drawn in vain before one is bent: the acceptance elsewhere is above a tenth.
_TRIES: Final = 500
# Stream of randomness of the motion, apart from the simulation's own.
_MOTION_STREAM: Final = 0x90F3


class PatientGeometry(LegGeometry):
    """Accepts any point after many refusals: ``joints`` pulls points within reach anyway."""

    _refused = 0  # in a row

    def reachable(self, points_m: Array) -> Mask:
        """Return which points are in reach; after :data:`_TRIES` refusals in a row, all are."""
        inside = super().reachable(points_m)
        self._refused = 0 if inside.all() else self._refused + 1
        if self._refused > _TRIES:
            self._refused = 0
            return np.ones_like(inside)
        return inside


def simulation_of(settings: SimulationSettings) -> Simulation:
    """A simulation whose leg never waits for a way out of a pocket."""
    motion = settings.motion
    assert isinstance(motion, PoseSettings)
    # Its own motion is made, and thrown away: over the paper's subspaces that always succeeds.
    harmless = replace(motion, workspace="paper", approach="descent")
    sim = Simulation(replace(settings, motion=harmless))
    rng = np.random.default_rng([settings.seed, _MOTION_STREAM])
    sim.motion = PoseMotion(motion, PatientGeometry(), sim.courses[0], rng)
    return sim


def record_leg(settings: SimulationSettings, leg: str, seconds: float) -> LegArrays:
    """Simulate, and keep one leg.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    return record_run(simulation_of(settings), seconds, legs=(leg,)).legs[leg]


_HEIGHT_M: Final = 1.0
_SETTLE_TICKS: Final = 50


def record_gantry(settings: GantrySettings, seconds: float) -> dict[str, LegArrays]:
    """Simulate all six legs in free air.

    Returns:
        Every leg's stream; no leg ever touches anything.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    plant = Plant(
        on_a_stand(_HEIGHT_M).compile(),
        manufactured(settings.robot_seed),
        period_s=PERIOD_S,
        supply_resistance_ohm=settings.supply_resistance_ohm,
    )
    geometry = PatientGeometry()
    seeds = np.random.SeedSequence(settings.seed).spawn(len(LEGS) + 1)
    motions = [
        PoseMotion(motion, geometry, _NoObstacles(), np.random.default_rng(seed))
        for motion, seed in zip(settings.motions, seeds, strict=False)
    ]
    encoder = Encoder(settings.encoder, np.random.default_rng(seeds[-1]))
    start = motions[0].start_joints.reshape(-1)
    plant.joint_angles[:] = start
    mujoco.mj_forward(plant.model, plant.data)
    plant.servos.write_goal(start)
    for _ in range(_SETTLE_TICKS):
        plant.advance()

    n = round(seconds / PERIOD_S)
    measured, desired, angle = (np.zeros((n, N_SERVOS)) for _ in range(3))
    swing = np.zeros((n, len(LEGS)), dtype=bool)
    position, rotation = plant.body_pose()
    for k in range(n):
        angle[k] = plant.joint_angles
        measured[k] = encoder.read(plant.joint_angles).angle_rad
        world = World(
            tick=k,
            step=plant.steps,
            step_s=plant.step_s,
            measured_rad=measured[k].reshape(len(LEGS), -1),
            position_m=position,
            rotation=rotation,
            feet_m=plant.foot_positions(),
            touch_step=(None,) * len(LEGS),
            reported_tick=(None,) * len(LEGS),
        )
        goals = np.zeros((len(LEGS), 3))
        for i, motion in enumerate(motions):
            goal = motion.step(world)
            goals[i] = goal.joints_rad[i]
            swing[k, i] = goal.phase[i] == "swing"
        desired[k] = plant.servos.write_goal(goals.reshape(-1))
        plant.advance()
    shape = (n, len(LEGS), -1)
    return {
        leg: LegArrays(
            measured=measured.reshape(shape)[:, i],
            desired=desired.reshape(shape)[:, i],
            valid=np.ones((n, 3), dtype=bool),
            swing=swing[:, i],
            contact=np.zeros(n, dtype=bool),
            force_n=np.zeros(n),
            angle=angle.reshape(shape)[:, i],
            onsets=(),
            releases_ns=(),
        )
        for i, leg in enumerate(LEGS)
    }


class _NoObstacles(ObstacleCourse):
    """A course with nothing on it, which needs no scene."""

    def __init__(self) -> None:
        self.standing = None

    def assign(self, leg: int | None) -> None:
        """Nothing to collide with."""

    def wanted(self) -> bool:
        """Never."""
        return False

    def clear(self) -> None:
        """Nothing stands."""


# Of the experiments, what only counts and shows what was evaluated: a new table is no reason to
# evaluate ten robot-hours again.
_SHOWING: Final = frozenset(
    f"{name}.py" for name in ("detection", "detection_figures", "figures", "tables", "touched")
) | {"verdicts.py"}
# What turns recordings into samples, rows and truth.
_MATCHING: Final = [Path(str(m.__file__)) for m in (evaluate, training, arrays, truth)]


@functools.cache
def physics_fingerprint() -> str:
    """Hash of a second of every kind of motion: what the simulator does, not how it is written."""
    digest = hashlib.sha256()
    approaches: tuple[Any, ...] = ("descent", "slow", "forward", "graze")
    for approach in approaches:
        motion = PoseSettings(
            workspace="whole",
            approach=approach,
            obstacles=ObstacleSettings(probability=1.0, soft=0.5),
        )
        leg = record_leg(SimulationSettings(motion=motion, seed=12345), "rf", 2.0)
        for part in (leg.measured, leg.desired, leg.swing, leg.force_n):
            digest.update(np.ascontiguousarray(part).tobytes())
        digest.update(repr(leg.onsets).encode())
    for leg in record_gantry(GantrySettings(seed=12345), 1.0).values():
        for part in (leg.measured, leg.desired, leg.swing):
            digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()[:16]


@functools.cache
def source_fingerprint() -> str:
    """Hash of the source that evaluates, as this process found it first."""
    return source_now()


def require_unchanged_source() -> None:
    """Refuse to go on with other source than the run began with.

    A process started now would load what is on disk now, and keep its results under another key.

    Raises:
        ConfigurationError: a file was changed meanwhile.
    """
    if source_now() != source_fingerprint():
        raise ConfigurationError(
            "the source of adaptive-contact was changed while the run was going on; start the same "
            "command again (what still holds is kept)"
        )


def source_now() -> str:
    """Compute the digest of what identifies, detects, learns and scores, and of its evaluation."""
    product = Path(adaptive_contact.__file__).parent
    files = [*learner_sources(), *sorted((product / "score").glob("*.py"))]
    here = sorted(Path(__file__).parent.glob("*.py"))
    files += [file for file in here if file.name not in _SHOWING]
    files += _MATCHING
    return sources_digest(files).hexdigest()[:16]
