"""The robot hung up by its body, all six legs swinging free: free motion at a fraction of the cost.

Ten robot-hours of one leg swinging while five stand would be 35 hours of simulated time.  Here the
body is fixed in the air and every leg makes the same trials as in pose, each on its own; links,
servos, supply, friction and readings are the same code and the same constants, only the body does
not give way.  The report compares residuals here with those of the standing robot.
"""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact_sim.arrays import LegArrays
from adaptive_contact_sim.elements import LEGS, N_SERVOS
from adaptive_contact_sim.encoder import Encoder
from adaptive_contact_sim.motion import World
from adaptive_contact_sim.obstacles import ObstacleCourse
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.pose import PERIOD_S, PoseMotion
from adaptive_contact_sim.scene import robot_xml
from adaptive_contact_sim.servo import manufactured
from adaptive_contact_studies.paper.plan import GantrySettings
from adaptive_contact_studies.paper.recording import PatientGeometry

__all__ = ["record_gantry"]

Array = NDArray[np.float64]

_HEIGHT_M: Final = 1.0
_SETTLE_TICKS: Final = 50


def record_gantry(settings: GantrySettings, seconds: float) -> dict[str, LegArrays]:
    """Simulate all six legs in free air.

    Args:
        settings: robot, motion, seed.
        seconds: simulated time.

    Returns:
        Every leg's stream; no leg ever touches anything.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    plant = Plant(
        _hung_up(),
        manufactured(settings.robot_seed),
        period_s=PERIOD_S,
        supply_resistance_ohm=settings.supply_resistance_ohm,
    )
    geometry = PatientGeometry.patient()
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
            told_tick=(None,) * len(LEGS),
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


def _hung_up() -> mujoco.MjModel:
    """The robot's model with its body fixed in the air; no ground."""
    spec = mujoco.MjSpec.from_string(robot_xml())
    spec.delete(spec.joint("body"))
    spec.body("body").pos = [0.0, 0.0, _HEIGHT_M]
    return spec.compile()


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
