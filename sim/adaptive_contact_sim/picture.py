"""Pictures of a simulation without a window: ``.png`` (the last moment), ``.gif``.

A run keeps moments, which is cheap, and they are painted when it is over: painting a frame takes
longer than a control tick, and a run in real time must not wait for it.  The engine's renderer on
EGL paints.
"""

from __future__ import annotations

import importlib
import io
from pathlib import Path
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.errors import ConfigurationError, needs
from adaptive_contact.files import write_file
from adaptive_contact_sim.simulation import Simulation


class Moment(NamedTuple):
    """What a picture shows."""

    configuration: Array  # of the engine's joints, `qpos`
    # mocap_m, mocap_quaternion: places of the movable obstacles
    mocap_m: Array
    mocap_quaternion: Array
    touching: Mask  # (L,) whether each leg touches
    caption: tuple[str, ...]  # lines for the corner

    @classmethod
    def from_simulation(cls, sim: Simulation) -> Moment:
        """Keep the present state of a simulation."""
        data = sim.plant.data
        lines = [f"{sim.time_s:.1f} s"]
        for kind, legs in sim.drift.holds().items():
            values = {round(v, 3) for joints in legs.values() for v in joints.values()}
            value = f"{values.pop():g}" if len(values) == 1 else "various"
            lines.append(f"{kind} {value}: {' '.join(legs)}")
        return cls(
            configuration=data.qpos.copy(),
            mocap_m=data.mocap_pos.copy(),
            mocap_quaternion=data.mocap_quat.copy(),
            touching=sim.plant.forces[-1] > 0.0,
            caption=tuple(lines),
        )


Pixels = NDArray[np.uint8]


class Painter:
    """The engine's own renderer, offscreen on EGL, for moments of a simulation that has looks.

    EGL is asked for by itself, not through ``MUJOCO_GL``, which is read once when mujoco is
    imported and would have to be set before.

    Raises:
        ConfigurationError: EGL is missing or does not work.
    """

    def __init__(self, sim: Simulation, width: int, height: int) -> None:
        model = self._model = sim.plant.model
        self._data = mujoco.MjData(model)
        self._body = sim.plant.elements.body
        # Everything that can go wrong here is the machine's OpenGL: a missing library shows as
        # ImportError, AttributeError or OSError, a missing device as RuntimeError or an EGLError.
        wrong: list[type[Exception]] = [ImportError, AttributeError, OSError, RuntimeError]
        try:
            from mujoco.egl import GLContext

            wrong += [importlib.import_module("OpenGL.error").Error, mujoco.FatalError]
            self._context: Any = GLContext(width, height)
            self._context.make_current()
            self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        except tuple(wrong) as error:
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise ConfigurationError(
                f"--render: EGL does not work here ({reason}); "
                "run: apt install libegl1 libgl1-mesa-dri"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(model, maxgeom=4000)
        self._option = mujoco.MjvOption()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._camera = mujoco.MjvCamera()
        self._camera.distance = 0.95
        self._camera.azimuth = 128.0
        self._camera.elevation = -20.0
        self._camera.lookat[:] = sim.plant.body_pose()[0]
        self._camera.lookat[2] = 0.07
        self._image = np.zeros((height, width, 3), dtype=np.uint8)
        self._toes = [model.geom(f"{leg}_toe").id for leg in sim.layout.legs]
        model.geom_matid[self._toes] = -1

    def paint(self, moment: Moment) -> Pixels:
        """Paint a moment, feet that touch in red."""
        model, data = self._model, self._data
        data.qpos[:] = moment.configuration
        data.mocap_pos[:], data.mocap_quat[:] = moment.mocap_m, moment.mocap_quaternion
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        model.geom_rgba[self._toes] = np.where(
            moment.touching[:, None], (0.93, 0.16, 0.14, 1.0), (0.16, 0.55, 0.88, 1.0)
        )
        # The camera follows the body with this lag, in frames, so that steps do not shake the
        # picture.
        self._camera.lookat[:2] += (data.xpos[self._body, :2] - self._camera.lookat[:2]) / 8.0
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


# File kind -> width, height, control ticks per frame.
_KINDS: Final = {".png": (960, 720, 1), ".gif": (480, 360, 4)}


class Film:
    """A picture or film of a run, painted when it is closed.

    Raises:
        ConfigurationError: the ending is none of those known, or the folder does not exist.
        MissingExtraError: a library for it is not installed.
    """

    def __init__(self, path: Path, sim: Simulation) -> None:
        self.path = path
        self._kind = path.suffix.lower()
        if self._kind not in _KINDS:
            raise ConfigurationError(
                f"cannot render to '{path.name}'; expected a name ending in {', '.join(_KINDS)}"
            )
        if not path.absolute().parent.is_dir():
            raise ConfigurationError(
                f"cannot render to '{path}': its folder does not exist; make it"
            )
        with needs("--render", "plot"):
            importlib.import_module("PIL")
        self._width, self._height, self._every = _KINDS[self._kind]
        self._frame_s = self._every * sim.settings.period_s
        # Painting takes three times the time that was filmed, and a gif grows by 0.3 MB per second.
        self._most = round(300.0 / self._frame_s)
        self._sim = sim
        self._painter = Painter(sim, self._width, self._height)
        self._moments: list[Moment] = []

    def capture(self) -> None:
        """Keep the present moment, if a frame is due."""
        if self._kind == ".png":
            self._moments[:] = [Moment.from_simulation(self._sim)]
        elif self._sim.ticks % self._every == 0 and len(self._moments) < self._most:
            self._moments.append(Moment.from_simulation(self._sim))

    def close(self) -> None:
        """Paint what was kept, and write the file."""
        moments = self._moments or [Moment.from_simulation(self._sim)]
        if self._kind == ".png":
            data = _encoded(self._paint(moments[-1]), "PNG")
        else:
            # One palette per frame, no dithering: flat colours stay flat, and compress.
            first, *rest = (
                self._paint(moment).quantize(96, method=2, dither=0) for moment in moments
            )
            data = _encoded(
                first,
                "GIF",
                save_all=True,
                append_images=rest,
                duration=round(self._frame_s * 1e3),
                loop=0,
                optimize=False,
            )
        self._painter.close()
        write_file(self.path, data, advice="give another --render")

    def _paint(self, moment: Moment) -> Any:
        """A pillow image of a moment, with its caption."""
        from PIL import Image as PILImage
        from PIL import ImageDraw

        picture = PILImage.fromarray(self._painter.paint(moment))
        draw = ImageDraw.Draw(picture)
        size = max(12, self._height // 32)
        for i, line in enumerate(moment.caption):
            place = (size * 0.7, size * (0.5 + 1.3 * i))
            draw.text(place, line, fill=(40, 44, 52), font_size=size)
        return picture


def _encoded(picture: Any, kind: str, **options: Any) -> bytes:
    data = io.BytesIO()
    picture.save(data, kind, **options)
    return data.getvalue()
