r"""What is done to a running simulation besides its settings: contacts on and off, a caught foot.

A caught foot hangs on a damped spring between the foot point and the place where it was caught,

.. math:: f = -k\,(x - x_0) - c\,\dot x,

as in roots or a loop of cable: stiffer than a leg's servos, so that it is the body that sways.  No
touch sensor feels the spring, so that the time it holds is added to the truth as one contact.  A
foot that trails a branch is pulled against its motion instead, as much in the lift as in the
descent,

.. math:: f = -F\,\tanh(|\dot x| / v_0)\,\dot x / |\dot x|,

and nothing of it is a touch: only touches of the ground are to be reported.  The engine calls both
through its hook for passive forces.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.pose import PoseMotion, PoseSettings
from adaptive_contact_sim.pose_group import PoseGroup, PoseGroupSettings
from adaptive_contact_sim.simulation import Simulation
from adaptive_contact_studies.scenarios.spec import Staging


class _LevelPose(PoseMotion):
    """The pose set-up with all obstacles at one height in the leg's frame."""

    level_m: float = 0.0

    def _trial(self) -> Any:
        plan = super()._trial()
        if plan.obstacle is not None:
            top, end = plan.points[plan.ascent - 1, 2], plan.points[plan.swing - 1, 2]
            share = (top - self.level_m) / (top - end)
            # Where on a descent a level obstacle may stand, as shares of it; beyond, it would come
            # too early for the lagging foot, or too late to be judged.
            plan.obstacle = float(np.clip(share, 0.15, 0.6))
        return plan


def _level_motion(sim: Simulation, level_m: float) -> PoseGroup | PoseMotion:
    """The simulation's motion in pose, with its obstacles at one height."""
    motion = sim.settings.motion
    poses = motion.poses if isinstance(motion, PoseGroupSettings) else (motion,)
    # Randomness of the motions made here, apart from all of the simulator's.
    rng = np.random.default_rng([sim.settings.seed, 0x1E7E1])
    members = []
    for pose, course in zip(poses, sim.courses, strict=True):
        assert isinstance(pose, PoseSettings)
        member = _LevelPose(pose, sim.geometry, course, rng)
        member.level_m = level_m
        members.append(member)
    return PoseGroup(members) if isinstance(motion, PoseGroupSettings) else members[0]


class Stagehand:
    """Does what a staging asks, tick by tick."""

    def __init__(self, sim: Simulation, staging: Staging, leg: str) -> None:
        self._sim, self._staging = sim, staging
        self._contacts = list(staging.contacts)
        self._leg = sim.layout.legs.index(leg)
        self._site = int(sim.plant.elements.foot_sites[self._leg])
        self._body = int(sim.plant.model.site_bodyid[self._site])
        self._anchor: Array | None = None
        self._jacobian = np.zeros((3, sim.plant.model.nv))
        # when something got hold of the foot and let go of it, None where nothing did
        self.caught_ns: tuple[int, int] | None = None
        if (staging.contacts or staging.level_m is not None) and not sim.courses:
            raise ConfigurationError("obstacles can be staged in pose only; this is a walk")
        if staging.level_m is not None:
            sim.motion = _level_motion(sim, staging.level_m)

    def before_tick(self) -> None:
        """Prepare the tick to come."""
        sim, now = self._sim, self._sim.time_s
        while self._contacts and self._contacts[0][0] <= now:
            _, probability = self._contacts.pop(0)
            for course in sim.courses:
                course.settings = replace(course.settings, probability=probability)
        if self._staging.caught_s is None:
            return
        begin, end = self._staging.caught_s
        if self.caught_ns is None and now >= begin and sim.phase[self._leg] == "stance":
            # Caught at rest, between two swings, where a foot gets under a root.
            self._anchor = sim.plant.data.site_xpos[self._site].copy()
            length = round((end - begin) * 1e9)
            self.caught_ns = (sim.t_ns, sim.t_ns + length)
        elif self._anchor is not None and self.caught_ns and sim.t_ns >= self.caught_ns[1]:
            self._anchor = None

    @property
    def held_ns(self) -> tuple[int, int] | None:
        """When the foot was held, and touched something by that."""
        return self.caught_ns if self._staging.trails_n is None else None

    def pull(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Add what pulls at the foot; the engine's hook for passive forces."""
        if self._anchor is None or model is not self._sim.plant.model:
            return
        point = data.site_xpos[self._site]
        mujoco.mj_jac(model, data, self._jacobian, None, point, self._body)
        velocity = self._jacobian @ data.qvel
        if self._staging.trails_n is None:
            # A damper of about half of critical for the 60 g that move with a foot: it must not
            # ring through the gait.
            force = -3000.0 * (point - self._anchor) - 13.0 * velocity
        else:
            speed = max(float(np.linalg.norm(velocity)), 1e-9)
            # Speed up to which what trails is not pulled taut.
            force = -self._staging.trails_n * np.tanh(speed / 0.02) * velocity / speed
        data.qfrc_passive += self._jacobian.T @ force


@contextmanager
def stagehand(sim: Simulation, staging: Staging, leg: str) -> Iterator[Stagehand]:
    """A stagehand at work; the engine's hook, which is the whole process's, is given back."""
    hand = Stagehand(sim, staging, leg)
    if staging.caught_s is None:
        yield hand
        return
    mujoco.set_mjcb_passive(hand.pull)
    try:
        yield hand
    finally:
        mujoco.set_mjcb_passive(None)
