"""Obstacles put in a leg's way, and taken out of it.

One obstacle at a time and leg, on a mocap body.  Where a point of the foot's path is to be the
place of the touch, the obstacle's surface passes through that point; the true touch comes near it,
not on it, as a leg under load lags and its body tilts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.limits import check_number, check_word
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.scene import (
    OBSTACLE_TOP_M,
    OBSTACLES,
    PARKED_M,
    expose,
    obstacle_name,
    set_surface,
)

Approach = Literal["descent", "slow", "forward", "graze"]
_SHAPES: Final = ("plate", "sphere", "edge")


@dataclass(frozen=True)
class ObstacleSettings:
    """What stands in the way of descents."""

    probability: float = 0.0  # that a descent meets an obstacle
    shapes: tuple[str, ...] = _SHAPES  # drawn from for each: `plate`, `sphere`, `edge`
    soft: float = 0.0  # probability that the obstacle yields
    # lowest and highest of those that yield, drawn log-uniformly
    stiffness_n_m: tuple[float, float] = (300.0, 3000.0)
    # earliest and latest place on the commanded descent, as shares of it; the foot comes there
    # three to four ticks after the command
    where: tuple[float, float] = (0.05, 0.6)

    def __post_init__(self) -> None:
        check_number("obstacle probability", self.probability, 0.0, 1.0)
        check_number("soft obstacle probability", self.soft, 0.0, 1.0)
        for shape in self.shapes:
            check_word("obstacle shape", shape, _SHAPES)
        low, high = self.where
        if not 0.0 < low <= high <= 1.0:
            raise ConfigurationError(
                f"obstacles at {low} to {high} of a descent; expected shares in 0..1, rising"
            )


class ObstacleCourse:
    """Moves the obstacles of one scene.

    Args:
        settings: which, how often, where.
        plant: the scene; built with this set of obstacles.
        rng: what to draw from.
        owner: the leg whose own they are; None where they are of whichever leg is assigned.
    """

    def __init__(
        self,
        settings: ObstacleSettings,
        plant: Plant,
        rng: np.random.Generator,
        owner: str | None = None,
    ) -> None:
        self.settings = settings
        self.owner = owner
        self.names = frozenset(obstacle_name(shape, owner) for shape in OBSTACLES)
        self._plant = plant
        self._rng = rng
        layout = plant.elements.layout
        shin = plant.model.body(f"{layout.legs[0]}_{layout.joints[-1]}").id
        self._inverse_mass = float(plant.model.body_invweight0[shin, 0])
        self.standing: str | None = None
        self.surface: Literal["hard", "soft"] = "hard"

    def assign(self, leg: int) -> None:
        """Let obstacles collide with this leg only; a leg's own never do otherwise."""
        if self.owner is None:
            expose(self._plant.model, self._plant.elements, leg)

    def wanted(self) -> bool:
        """Draw whether the next descent meets an obstacle."""
        return bool(self._rng.random() < self.settings.probability)

    def share(self) -> float:
        """Draw where on a descent, as a share of it."""
        return float(self._rng.uniform(*self.settings.where))

    def place(self, point_m: Array, motion_m: Array, inward: Array, approach: Approach) -> None:
        """Put an obstacle where the foot will pass.

        Args:
            point_m: (3,) m in the world, of the foot point at the wanted touch.
            motion_m: (3,) direction of the foot there.
            inward: (3,) unit vector from the foot towards the body, level.
            approach: how the leg comes.
        """
        rng = self._rng
        along = motion_m / max(float(np.linalg.norm(motion_m)), 1e-9)
        yaw = rng.uniform(-np.pi, np.pi)
        quaternion = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        if approach == "graze":
            name = "plate"
            # Share of its velocity that points into a surface the foot is to graze.
            cosine = rng.uniform(0.08, 0.25)
            # Facing the body: the shin leans inwards, away from the block.
            across = inward - (inward @ along) * along
            across /= max(float(np.linalg.norm(across)), 1e-9)
            normal = np.sqrt(1.0 - cosine**2) * across - cosine * along
            # Height of the foot sphere's centre over the sole, m: surfaces are put against the
            # sole.
            centre = point_m - normal * (OBSTACLE_TOP_M[name] + 0.008)
            mujoco.mju_quatZ2Vec(quaternion, normal)
        elif approach == "forward":
            name = "post"
            level = np.array([along[0], along[1], 0.0])
            level /= max(float(np.linalg.norm(level)), 1e-9)
            # Half a post's thickness and the shin's radius beyond the point; the post's middle
            # at the height of the foot, so that shin or foot meets it.
            centre = point_m + 0.0175 * level
            half = 0.5 * np.arctan2(level[1], level[0])
            quaternion = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        else:
            name = str(rng.choice(self.settings.shapes))
            centre = point_m - np.array([0.0, 0.0, OBSTACLE_TOP_M[name]])
            if name == "edge":  # a capsule lies along its z axis
                quaternion = np.array(
                    [np.cos(yaw / 2), np.sin(yaw / 2), np.cos(yaw / 2), np.sin(yaw / 2)]
                ) / np.sqrt(2.0)
        self._soften(name)
        self._move(name, centre, quaternion)
        self.standing = name

    def clear(self) -> None:
        """Take the standing obstacle away."""
        if self.standing is not None:
            self._move(self.standing, np.array(PARKED_M), np.array([1.0, 0.0, 0.0, 0.0]))
            self.standing = None

    def _soften(self, name: str) -> None:
        model, settings = self._plant.model, self.settings
        geom = model.geom(obstacle_name(name, self.owner)).id
        stiffness = None
        if self._rng.random() < settings.soft:
            stiffness = float(np.exp(self._rng.uniform(*np.log(settings.stiffness_n_m))))
        self.surface = "hard" if stiffness is None else "soft"
        set_surface(model, geom, stiffness, self._inverse_mass)

    def _move(self, name: str, centre: Array, quaternion: Array) -> None:
        model, data = self._plant.model, self._plant.data
        mocap = int(model.body_mocapid[model.body(obstacle_name(name, self.owner)).id])
        data.mocap_pos[mocap] = centre
        data.mocap_quat[mocap] = quaternion
