"""The robots that the simulator knows, by name.

A robot is a folder of ``adaptive_contact_models``: its model (MJCF) and its ``robot.toml``.  What
is here is what neither file says: which servos it has, the posture it rests in, and how it moves
where nothing else is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.printable import did_you_mean
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_sim.elements import HEXAPOD, Layout
from adaptive_contact_sim.gait import GaitName
from adaptive_contact_sim.legs import ChainLegs, Geometry, LegGeometry
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.servo import AX12A, STS3215, XM430_W210, ServoKind
from adaptive_contact_sim.walk import WalkSettings


@dataclass(frozen=True)
class SimulatedRobot:
    """A robot as the simulator has it."""

    name: str  # of its folder
    about: str  # one line
    layout: Layout  # its elements' names
    servo: ServoKind  # its servos
    # (L, J) rad, a posture in the middle of what the legs do; empty where a closed form needs none
    rest: tuple[tuple[float, ...], ...] = ()
    walk: WalkSettings | None = None  # how it walks; None where it cannot
    # of gaits with settings of their own, how it walks in those
    walks: tuple[WalkSettings, ...] = ()
    pose: PoseSettings | None = None  # how single legs move; None where they cannot
    relief_m: float = 0.035  # of rough ground, lowest to highest, that it walks over

    @cached_property
    def description(self) -> Robot:
        """Its ``robot.toml``."""
        return shipped_robot(self.name)

    def walking(self, gait: GaitName | None = None) -> WalkSettings | None:
        """How it walks in a gait, its usual one where None; None where it cannot walk."""
        if self.walk is None or gait is None:
            return self.walk
        own = next((walk for walk in self.walks if walk.gait == gait), self.walk)
        return replace(own, gait=gait)

    def geometry(self) -> Geometry:
        """Its legs, for controllers."""
        if self.layout == HEXAPOD:
            return LegGeometry(self.description)
        return ChainLegs(self.description, np.array(self.rest))


_TROT: Final = WalkSettings(
    gait="trot",
    stride_m=0.05,
    swing_s=0.26,
    body_height_m=0.155,
    clearance_m=0.035,
    depth_m=(0.012, 0.02),
    reach_m=0.075,
    react_ms=30.0,
    preload_m=0.006,
    lag_s=0.1,
)
_ROBOTS: Final = (
    SimulatedRobot(
        name="hexapod",
        about="PhantomX-class hexapod, 18 AX-12A",
        layout=HEXAPOD,
        servo=AX12A,
        walk=WalkSettings(),
        pose=PoseSettings(),
    ),
    SimulatedRobot(
        name="quadruped12",
        about="quadruped, hips roll-pitch-pitch, 12 XM430-W210",
        layout=Layout(
            ("fl", "fr", "rl", "rr"),
            ("roll", "hip", "knee"),
            ("roll", "hip", "knee", "foot"),
        ),
        servo=XM430_W210,
        # Knees towards the middle.
        rest=(
            (0.0, -0.75, 1.45),
            (0.0, -0.75, 1.45),
            (0.0, 0.75, -1.45),
            (0.0, 0.75, -1.45),
        ),
        walk=_TROT,
        walks=(
            # Slow swings: servos that lag press a foot down by what its command is ahead of it,
            # and of four stiff legs one that presses lifts two others off.
            replace(_TROT, gait="walk", swing_s=0.6, depth_m=(0.01, 0.014), sway=0.6, land_m=0.001),
        ),
        relief_m=0.025,
    ),
    SimulatedRobot(
        name="leg5",
        about="a leg of five joints on a stand, 5 STS3215",
        layout=Layout(
            ("leg",),
            ("yaw", "roll", "pitch", "knee", "ankle"),
            ("yaw", "roll", "pitch", "knee", "foot"),
        ),
        servo=STS3215,
        # Thigh forward, shank back, the sole level.
        rest=((0.0, 0.0, 0.6, -1.2, 0.6),),
        pose=PoseSettings(
            legs=("leg",),
            segment_ticks=18,
            hold_ticks=6,
            workspace="hung",
            obstacles=ObstacleSettings(shapes=("plate",), where=(0.35, 0.75)),
            clear_m=0.025,
            vary_rad=(0.7, 0.4, 0.3, 0.3, 0.4),
        ),
    ),
)
ROBOTS: Final = {robot.name: robot for robot in _ROBOTS}


def simulated_robot(name: str) -> SimulatedRobot:
    """The robot of this name.

    Raises:
        ConfigurationError: the simulator has none of that name.
    """
    if name not in ROBOTS:
        hint = did_you_mean(name, ROBOTS, f"there are {', '.join(ROBOTS)}")
        raise ConfigurationError(f"no robot '{name}' is simulated; {hint}")
    return ROBOTS[name]
