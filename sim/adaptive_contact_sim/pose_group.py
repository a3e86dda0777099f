"""Several legs in pose at the same time, each with its own trials and its own obstacles.

The body stands on the other legs, as in the paper's set-up, and gives way under all of them at
once.  Engine steps are what a simulation costs; here they serve three legs instead of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Phase
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.motion import Goal, World
from adaptive_contact_sim.pose import PoseMotion, PoseSettings

# Legs that can be in the air together while the robot stands on the others.
TRIPODS: Final = (("lf", "lr", "rm"), ("lm", "rf", "rr"))


@dataclass(frozen=True)
class PoseGroupSettings:
    """Which legs move together, and how each does."""

    # of one leg each, all of them of one tripod: the robot stands on the other
    poses: tuple[PoseSettings, ...]

    def __post_init__(self) -> None:
        legs = [leg for pose in self.poses for leg in pose.legs]
        single = all(len(pose.legs) == 1 for pose in self.poses)
        if not single or len(set(legs)) < len(legs):
            raise ConfigurationError(
                f"legs in pose together are {[list(pose.legs) for pose in self.poses]}; expected "
                "one leg each, none of them twice"
            )
        if not any(legs and set(legs) <= set(tripod) for tripod in TRIPODS):
            raise ConfigurationError(
                f"legs in pose together are {legs}; expected some of "
                + ", or of ".join(" ".join(tripod) for tripod in TRIPODS)
                + ": the robot stands on the others"
            )

    @property
    def legs(self) -> tuple[str, ...]:
        """Those that move."""
        return tuple(pose.legs[0] for pose in self.poses)


class PoseGroup:
    """Goals of several legs in pose; the others stand."""

    def __init__(self, members: Sequence[PoseMotion]) -> None:
        self.members = tuple(members)
        self.start_joints = members[0].start_joints
        self.start_height_m = members[0].start_height_m

    def step(self, world: World) -> Goal:
        """Goals for this tick."""
        joints = self.start_joints.copy()
        phase: list[Phase] = ["stance"] * len(LEGS)
        for member in self.members:
            goal, leg = member.step(world), member.leg
            joints[leg], phase[leg] = goal.joints_rad[leg], goal.phase[leg]
        return Goal(joints, tuple(phase))
