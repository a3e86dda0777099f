"""From joints to horns: how the robot's owner has mounted the servos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.errors import ConfigurationError

__all__ = ["Horns"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Horns:
    """Mounting of a robot's servos, in the order of the simulator's joints.

    A joint's angle is ``direction * horn + offset``, as in ``robot.toml``.

    Attributes:
        direction: (n,) 1 or -1.
        offset_rad: (n,) joint angle with the horn in its centre.
    """

    direction: Array
    offset_rad: Array

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
