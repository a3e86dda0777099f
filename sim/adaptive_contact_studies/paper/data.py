"""Streams of one leg with their truth: the standing robot, and the robot hung up by its body.

A robot that stands is simulated as for everything else, with one difference: where a leg has come
to a pocket of its workspace out of which no straight way to a new point leads, the way is bent to
the nearest reachable one instead of being drawn again without end.

Ten robot-hours of one leg swinging while five stand would be 35 hours of simulated time.  A robot
hung up by its body has six legs that swing at once, each on its own: links, servos, supply,
friction and readings are the same code and constants, only the body does not give way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import msgspec
import mujoco
import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.fit.train import Stretch
from adaptive_contact_sim.arrays import LegArrays, Run, record_run
from adaptive_contact_sim.elements import LEGS, N_SERVOS
from adaptive_contact_sim.encoder import Encoder
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.motion import World
from adaptive_contact_sim.obstacles import ObstacleCourse
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.pose import PERIOD_S, PoseMotion, PoseSettings
from adaptive_contact_sim.scene import on_a_stand
from adaptive_contact_sim.servo import manufactured
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_studies.paper.plan import GantrySettings, Piece, Shot
from adaptive_contact_studies.training import stretch_of
from adaptive_contact_studies.work import SIMULATOR, Work, rests_on

TICK_NS: Final = 20_000_000


class PatientGeometry(LegGeometry):
    """Accepts any point after many refusals: ``joints`` pulls points within reach anyway."""

    _refused = 0  # in a row

    def reachable(self, points_m: Array) -> Mask:
        """Return which points are in reach; after :data:`_TRIES` refusals in a row, all are."""
        inside = super().reachable(points_m)
        self._refused = 0 if inside.all() else self._refused + 1
        # Ways drawn in vain before one is bent: the acceptance elsewhere is above a tenth.
        if self._refused > 500:
            self._refused = 0
            return np.ones_like(inside)
        return inside


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


@dataclass(frozen=True, eq=False)
class Stream:
    """One leg's stream with its truth, row k being control tick k."""

    piece: Piece  # what was simulated
    arrays: LegArrays  # the leg's samples and truth

    @property
    def leg(self) -> str:
        """Id of the leg."""
        return self.piece.leg_run.leg

    @property
    def measured(self) -> Array:
        """(n, 3) rad."""
        return self.arrays.measured

    @property
    def desired(self) -> Array:
        """(n, 3) rad."""
        return self.arrays.desired

    @property
    def swing(self) -> Mask:
        """(n,) phase."""
        return self.arrays.swing

    @cached_property
    def run(self) -> Run:
        """As a run of one leg; the body's motion is not kept."""
        n = len(self.swing)
        return Run(
            t_ns=np.arange(n, dtype=np.int64) * TICK_NS,
            legs={self.leg: self.arrays},
            position_m=np.zeros((n, 3)),
            rotation=np.broadcast_to(np.eye(3), (n, 3, 3)),
        )

    @cached_property
    def stretch(self) -> Stretch:
        """To learn from; ticks near a touch are marked as not free."""
        return stretch_of(self.run, self.leg)


def simulation_of(settings: SimulationSettings) -> Simulation:
    """A simulation whose leg never waits for a way out of a pocket."""
    motion = settings.motion
    assert isinstance(motion, PoseSettings)
    # Its own motion is made, and thrown away: over the paper's subspaces that always succeeds.
    harmless = replace(motion, workspace="paper", approach="descent")
    sim = Simulation(replace(settings, motion=harmless))
    # Stream of randomness of the motion, apart from the simulation's own.
    rng = np.random.default_rng([settings.seed, 0x90F3])
    sim.motion = PoseMotion(motion, PatientGeometry(), sim.courses[0], rng)
    return sim


@rests_on(*SIMULATOR)
def recorded(_: Work, shot: Shot) -> dict[str, LegArrays]:
    """Simulate; the arrays of the legs that are kept.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    if isinstance(shot.settings, GantrySettings):
        return _hung_up(shot.settings, shot.seconds)
    return record_run(simulation_of(shot.settings), shot.seconds, legs=shot.legs).legs


def load(work: Work, piece: Piece) -> Stream:
    """A piece; simulated now unless it is kept."""
    return Stream(piece, work.one(recorded, piece.shot)[piece.leg_run.leg])


def record_all(work: Work, what: str, pieces: Sequence[Piece]) -> None:
    """Simulate what is not kept of some pieces, several at a time."""
    shots = {repr(piece.shot): piece.shot for piece in pieces}
    work.each(f"simulating {what}", recorded, [*shots.values()], lambda shot: shot.seconds)


def join(streams: Sequence[Stream]) -> Stream:
    """One stream of several of the same leg, one after the other.

    Every part begins with the leg standing, so that no window of swing ticks reaches back over a
    seam.
    """
    starts = np.cumsum([0, *(len(s.swing) for s in streams[:-1])]).tolist()
    parts = list(zip(starts, (s.arrays for s in streams), strict=True))
    rows = ("measured", "desired", "valid", "swing", "contact", "force_n", "angle")
    arrays = LegArrays(
        **{name: np.concatenate([getattr(a, name) for _, a in parts]) for name in rows},
        changes=tuple(
            msgspec.structs.replace(change, t_ns=change.t_ns + start * TICK_NS)
            for start, a in parts
            for change in a.changes
        ),
    )
    return Stream(streams[0].piece, arrays)


def _hung_up(settings: GantrySettings, seconds: float) -> dict[str, LegArrays]:
    """Simulate all six legs in free air; no leg ever touches anything."""
    plant = Plant(
        on_a_stand(1.0).compile(),
        manufactured(settings.robot_seed),
        period_s=PERIOD_S,
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
    for _ in range(50):
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
        goals = [motion.step(world) for motion in motions]
        swing[k] = [goal.phase[i] == "swing" for i, goal in enumerate(goals)]
        wanted = np.array([goal.joints_rad[i] for i, goal in enumerate(goals)])
        desired[k] = plant.servos.write_goal(wanted.reshape(-1))
        plant.advance()
    of_leg = (n, len(LEGS), -1)
    return {
        leg: LegArrays(
            measured=measured.reshape(of_leg)[:, i],
            desired=desired.reshape(of_leg)[:, i],
            valid=np.ones((n, 3), dtype=bool),
            swing=swing[:, i],
            contact=np.zeros(n, dtype=bool),
            force_n=np.zeros(n),
            angle=angle.reshape(of_leg)[:, i],
            changes=(),
        )
        for i, leg in enumerate(LEGS)
    }
