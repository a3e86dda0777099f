"""Where the moving leg of the pose set-up goes: parts of its workspace.

The subspaces are layers 5 cm high with 5 cm between them, in the coxa's frame: reach 13 to 22 cm
from the coxa axis and yaw within 30 degrees (assumed; the paper draws them without figures).  A
reach below 0 lies behind the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["WORKSPACES", "Space"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Space:
    """A part of the leg's workspace: yaw, reach and height in the coxa's frame."""

    yaw_rad: tuple[float, float]
    reach_m: tuple[float, float]
    height_m: tuple[float, float]

    def draw(self, rng: np.random.Generator) -> Array:
        """Draw a point, (3,) m, uniform in yaw, reach and height."""
        yaw, reach = rng.uniform(*self.yaw_rad), rng.uniform(*self.reach_m)
        height = rng.uniform(*self.height_m)
        return np.array([reach * math.cos(yaw), reach * math.sin(yaw), height])


# Lower and upper subspace, by name of the workspace.
WORKSPACES: Final = {
    "paper": (
        Space((-math.radians(30), math.radians(30)), (0.13, 0.22), (-0.125, -0.075)),
        Space((-math.radians(30), math.radians(30)), (0.13, 0.22), (-0.025, 0.025)),
    ),
    "whole": (
        Space((-math.radians(50), math.radians(50)), (0.09, 0.24), (-0.13, -0.03)),
        Space((-math.radians(50), math.radians(50)), (0.09, 0.25), (-0.03, 0.12)),
    ),
    # Of a leg that hangs down 0.38 m: under its hip, to the front, to the back and to the sides.
    "hung": (
        Space((-math.radians(60), math.radians(60)), (-0.09, 0.09), (-0.355, -0.315)),
        Space((-math.radians(60), math.radians(60)), (-0.09, 0.09), (-0.285, -0.235)),
    ),
}
