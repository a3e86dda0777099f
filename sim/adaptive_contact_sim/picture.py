"""Pictures of the simulation without a window: the engine's renderer on EGL.

Where EGL does not work, :func:`painter` falls back to a drawn stick figure
(:mod:`adaptive_contact_sim.stick`), so that a picture can always be made.
"""

from __future__ import annotations

import importlib
from typing import Any, Final, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.stage import Stage

__all__ = ["EnginePainter", "Painter", "painter"]

Image = NDArray[np.uint8]

TOUCHING_RGBA: Final = (0.93, 0.16, 0.14, 1.0)
FREE_RGBA: Final = (0.16, 0.55, 0.88, 1.0)
_DISTANCE_M: Final = 0.95
_AZIMUTH_DEG: Final = 128.0
_ELEVATION_DEG: Final = -20.0
_LOOK_AT_HEIGHT_M: Final = 0.07
# The camera follows the body with this lag, in frames, so that steps do not shake the picture.
_FOLLOW_FRAMES: Final = 8.0


class Painter(Protocol):
    """Something that can paint a stage."""

    def paint(self, stage: Stage) -> Image:
        """Paint what is set up: (height, width, 3) RGB."""

    def close(self) -> None:
        """Give resources back."""


def painter(stage: Stage, width: int, height: int) -> tuple[Painter, str | None]:
    """Make the best painter this machine has.

    Returns:
        The painter, and why it is a stick figure, None where it is not.
    """
    try:
        return EnginePainter(stage, width, height), None
    except ConfigurationError as error:
        from adaptive_contact_sim.stick import StickPainter

        return StickPainter(stage, width, height), str(error)


class EnginePainter:
    """The engine's own renderer, offscreen on EGL.

    EGL is asked for by itself, not through ``MUJOCO_GL``, which is read once when mujoco is
    imported and would have to be set before.

    Args:
        stage: the scene to paint.
        width, height: of the picture.

    Raises:
        ConfigurationError: EGL is missing or does not work.
    """

    def __init__(self, stage: Stage, width: int, height: int) -> None:
        model = stage.model
        # Everything that can go wrong here is the machine's OpenGL: a missing library shows as
        # ImportError or AttributeError, a missing device as RuntimeError or an EGLError.
        try:
            from mujoco.egl import GLContext

            gl_error: type[Exception] = importlib.import_module("OpenGL.error").Error
        except (ImportError, AttributeError, OSError) as error:
            raise ConfigurationError(f"EGL cannot be loaded ({_line(error)})") from error
        try:
            self._context: Any = GLContext(width, height)
            self._context.make_current()
            self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        except (ImportError, AttributeError, RuntimeError, gl_error, mujoco.FatalError) as error:
            raise ConfigurationError(f"EGL does not work here ({_line(error)})") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(model, maxgeom=4000)
        self._option = mujoco.MjvOption()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._camera = mujoco.MjvCamera()
        self._camera.distance = _DISTANCE_M
        self._camera.azimuth = _AZIMUTH_DEG
        self._camera.elevation = _ELEVATION_DEG
        self._camera.lookat[:] = stage.position_m
        self._camera.lookat[2] = _LOOK_AT_HEIGHT_M
        self._image = np.zeros((height, width, 3), dtype=np.uint8)
        self._toes = [model.geom(f"{leg}_toe").id for leg in stage.elements.layout.legs]
        model.geom_matid[self._toes] = -1

    def paint(self, stage: Stage) -> Image:
        """Paint what is set up, feet that touch in red."""
        model, data = stage.model, stage.data
        model.geom_rgba[self._toes] = np.where(stage.touching[:, None], TOUCHING_RGBA, FREE_RGBA)
        centre = stage.position_m
        self._camera.lookat[:2] += (centre[:2] - self._camera.lookat[:2]) / _FOLLOW_FRAMES
        self._context.make_current()
        mujoco.mjv_updateScene(
            model,
            data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL.value,
            self._scene,
        )
        mujoco.mjr_render(self._rect, self._scene, self._mjr)
        mujoco.mjr_readPixels(self._image, None, self._rect, self._mjr)
        return np.flipud(self._image).copy()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._mjr.free()
        self._context.free()


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
