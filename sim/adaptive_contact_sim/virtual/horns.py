"""How the servos of a robot are mounted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.errors import ConfigurationError

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
