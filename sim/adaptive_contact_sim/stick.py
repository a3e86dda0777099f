"""A drawn stick figure: the picture for machines without OpenGL.

The same view as the rendered one, in parallel projection: ground grid, obstacle, body outline,
legs as limbs, feet that touch in red.  Needs pillow only.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PILImage
from PIL import ImageDraw

from adaptive_contact_sim.scene import OBSTACLES, PARKED_M
from adaptive_contact_sim.stage import Stage

__all__ = ["StickPainter"]

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

_AZIMUTH_RAD: Final = math.radians(128.0)
_ELEVATION_RAD: Final = math.radians(24.0)
_SPAN_M: Final = 0.95  # of the world across the picture
_GRID_M: Final = 0.1
_GRID_HALF: Final = 8
_SKY: Final = (236, 241, 247)
_LINE: Final = (188, 184, 174)
_BODY: Final = ((58, 64, 74), (38, 42, 50))
_NEAR_LEG: Final = (66, 74, 88)
_FAR_LEG: Final = (132, 140, 152)
_TOUCHING: Final = (237, 41, 36)
_FREE: Final = (41, 140, 224)
_OBSTACLE: Final = (205, 108, 78)
_OVERSAMPLE: Final = 2


class StickPainter:
    """Draws the robot as limbs.

    Args:
        stage: whose robot to draw.
        width, height: of the picture.
    """

    def __init__(self, stage: Stage, width: int, height: int) -> None:
        self._size = (width, height)
        self._scale = width * _OVERSAMPLE / _SPAN_M
        self._centre = stage.position_m.copy()
        model, layout = stage.model, stage.elements.layout
        self._links = np.array(
            [[model.body(f"{leg}_{j}").id for j in layout.joints] for leg in layout.legs]
        )
        # Outline of the body: the legs' first joints, in order around it.
        deck = model.body_pos[self._links[:, 0], :2]
        self._deck = deck[np.argsort(np.arctan2(deck[:, 1], deck[:, 0]))]
        towards = np.array([math.cos(_AZIMUTH_RAD), math.sin(_AZIMUTH_RAD)])
        self._towards = -towards  # from the scene to the viewer, level

    def paint(self, stage: Stage) -> Pixels:
        """Draw what is set up."""
        width, height = self._size
        big = (width * _OVERSAMPLE, height * _OVERSAMPLE)
        picture = PILImage.new("RGB", big, _SKY)
        draw = ImageDraw.Draw(picture)
        position, rotation = stage.position_m, stage.rotation
        self._centre[:2] += (position[:2] - self._centre[:2]) / 8.0
        self._draw_ground(draw, stage, big)
        self._draw_obstacles(draw, stage, big)

        feet, touching = stage.feet_m, stage.touching
        depth = (feet[:, :2] - position[:2]) @ self._towards
        order = np.argsort(depth)
        for leg in order[: len(order) // 2]:
            self._draw_leg(draw, stage, int(leg), bool(touching[leg]), _FAR_LEG, big)
        for z, colour in ((-0.022, _BODY[1]), (0.026, _BODY[0])):
            deck = np.column_stack([self._deck, np.full(len(self._deck), z)])
            if len(deck) > 2:  # a leg on a stand has no body
                corners = deck @ rotation.T + position
                draw.polygon(self._project(corners, big), fill=colour)
        nose = np.array([[0.125, 0.03, 0.026], [0.125, -0.03, 0.026]]) @ rotation.T + position
        draw.line(self._project(nose, big), fill=(242, 140, 26), width=4 * _OVERSAMPLE)
        for leg in order[len(order) // 2 :]:
            self._draw_leg(draw, stage, int(leg), bool(touching[leg]), _NEAR_LEG, big)
        small = picture.resize(self._size, PILImage.Resampling.LANCZOS)
        return np.asarray(small, dtype=np.uint8).copy()

    def close(self) -> None:
        """Nothing to give back."""

    def _project(self, points: Array, size: tuple[int, int]) -> list[tuple[float, float]]:
        """World points (n, 3) m to pixels."""
        offset = points - self._centre
        right = offset[:, 0] * -math.sin(_AZIMUTH_RAD) + offset[:, 1] * math.cos(_AZIMUTH_RAD)
        away = offset[:, 0] * math.cos(_AZIMUTH_RAD) + offset[:, 1] * math.sin(_AZIMUTH_RAD)
        up = points[:, 2] * math.cos(_ELEVATION_RAD) + away * math.sin(_ELEVATION_RAD)
        x = size[0] / 2 + right * self._scale
        y = size[1] * 0.62 - up * self._scale
        return [(float(a), float(b)) for a, b in zip(x, y, strict=True)]

    def _draw_ground(self, draw: ImageDraw.ImageDraw, stage: Stage, size: tuple[int, int]) -> None:
        """Grid lines on the ground around the robot, following its heights."""
        base = np.round(self._centre[:2] / _GRID_M) * _GRID_M
        fine = np.linspace(-_GRID_HALF * _GRID_M, _GRID_HALF * _GRID_M, 8 * _GRID_HALF + 1)
        for k in range(-_GRID_HALF, _GRID_HALF + 1):
            for axis in (0, 1):
                line = np.zeros((fine.size, 3))
                line[:, axis] = base[axis] + k * _GRID_M
                line[:, 1 - axis] = base[1 - axis] + fine
                line[:, 2] = stage.terrain.height_at(line[:, 0], line[:, 1])
                draw.line(self._project(line, size), fill=_LINE, width=_OVERSAMPLE)

    def _draw_obstacles(
        self, draw: ImageDraw.ImageDraw, stage: Stage, size: tuple[int, int]
    ) -> None:
        """The obstacles that stand, as the outlines of their boxes."""
        for name in OBSTACLES:
            if stage.model.body_mocapid.max() < 0:
                return
            geom = stage.model.geom(f"obstacle_{name}").id
            if stage.data.geom_xpos[geom, 2] > PARKED_M[2] / 2:
                self._draw_box(draw, stage, geom, size)

    def _draw_box(
        self, draw: ImageDraw.ImageDraw, stage: Stage, geom: int, size: tuple[int, int]
    ) -> None:
        half = stage.model.geom_aabb[geom, 3:]
        signs = np.array(
            [[a, b, c] for c in (-1, 1) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        )
        rotation = stage.data.geom_xmat[geom].reshape(3, 3)
        box = (signs * half) @ rotation.T + stage.data.geom_xpos[geom]
        box[:, 2] = np.maximum(box[:, 2], 0.0)  # what is under the ground is not seen
        corners = self._project(box, size)
        for face in ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7)):
            draw.polygon([corners[i] for i in face], fill=_OBSTACLE, outline=(150, 70, 48))

    def _draw_leg(
        self,
        draw: ImageDraw.ImageDraw,
        stage: Stage,
        leg: int,
        touching: bool,
        colour: tuple[int, int, int],
        size: tuple[int, int],
    ) -> None:
        joints = stage.data.xpos[self._links[leg]]
        foot = stage.feet_m[leg]
        points = self._project(np.vstack([joints, foot]), size)
        for k, width in enumerate(np.linspace(10, 7, len(joints)).round().astype(int).tolist()):
            draw.line(points[k : k + 2], fill=colour, width=width * _OVERSAMPLE)
        for x, y in points[:-1]:
            r = 6 * _OVERSAMPLE
            draw.ellipse((x - r, y - r, x + r, y + r), fill=colour)
        x, y = points[-1]
        r = 7 * _OVERSAMPLE
        draw.ellipse((x - r, y - r, x + r, y + r), fill=_TOUCHING if touching else _FREE)
