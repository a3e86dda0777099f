"""Servos of a robot on a stand: their mounting, and physics that only the bus moves."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.virtual.backend import Backend

STEP_S: Final = 0.001
# Further behind than this, lost time is let go.
LET_GO_S: Final = 0.5


@dataclass(frozen=True, eq=False)
class Horns:
    """Mounting of a robot's servos, in the order of the simulator's joints.

    A joint's angle is ``direction * horn + offset``, as in ``robot.toml``.
    """

    direction: Array  # (n,) 1 or -1
    offset_rad: Array  # (n,) joint angle with the horn in its centre

    @classmethod
    def of(cls, plans: Sequence[PortPlan], order: Sequence[tuple[str, str]]) -> Horns:
        """Take them from what a description says.

        Args:
            plans: the robot's ports.
            order: (leg, joint) of every simulated joint.

        Raises:
            ConfigurationError: the description lacks one of them.
        """
        known = {
            (leg.id, joint.name): joint
            for plan in plans
            for leg in plan.legs
            for joint in leg.joints
        }
        missing = [f"{leg} {joint}" for leg, joint in order if (leg, joint) not in known]
        if missing:
            raise ConfigurationError(
                f"the description has no servo for {', '.join(missing)}; give the simulated "
                "robot's own robot.toml, or one with the same legs and joints"
            )
        joints = [known[pair] for pair in order]
        return cls(
            np.array([float(joint.direction) for joint in joints]),
            np.array([joint.offset_rad for joint in joints]),
        )

    def horn(self, index: int, joint_rad: float) -> float:
        """Horn angle of a joint angle."""
        return float(self.direction[index] * (joint_rad - self.offset_rad[index]))

    def joint(self, index: int, horn_rad: float) -> float:
        """Joint angle of a horn angle."""
        return float(self.direction[index] * horn_rad + self.offset_rad[index])


class OnStand(Backend):
    """A backend of virtual servos whose physics goes on step by step as time goes by.

    A goal written at any moment acts from that moment on.

    Args:
        horns: how the servos are mounted.
        plant: the robot's physics: its steps, and angles and speeds of its joints.
        start_rad: (n,) joint angles at first.
    """

    def __init__(self, horns: Horns, plant: Any, start_rad: Array) -> None:
        self._horns, self._plant = horns, plant
        self._goal = start_rad.copy()
        self._on = np.zeros(len(start_rad), dtype=np.bool_)
        self._start_s: float | None = None

    @abstractmethod
    def step(self) -> None:
        """Make one."""

    def target(self) -> Array:
        """(n,) rad, goals in force; a servo without torque has its goal where it is."""
        return np.where(self._on, self._goal, self._plant.joint_angles)

    def advance(self, now_s: float) -> float:
        """Bring the robot up to a moment."""
        if self._start_s is None:
            self._start_s = now_s
        behind = int((now_s - self._start_s) / STEP_S) - self._plant.steps
        if behind * STEP_S > LET_GO_S:
            self._start_s += behind * STEP_S
            behind = 0
        for _ in range(min(behind, 5)):  # Steps made at one call: more would keep the bus waiting.
            self.step()
        return float(self._start_s + (self._plant.steps + 1) * STEP_S)

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""
        return self._horns.horn(index, float(self._plant.joint_angles[index]))

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""
        return float(self._horns.direction[index] * self._plant.joint_speeds[index])

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Write a servo's goal."""
        self._goal[index] = self._horns.joint(index, angle_rad)

    def set_torque(self, index: int, on: bool) -> None:
        """Switch a servo's drive on or off."""
        self._on[index] = on
