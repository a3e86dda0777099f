"""Pictures of a simulation without a window: ``.png`` (the last moment), ``.gif``, ``.mp4``.

A run keeps moments, which is cheap, and they are painted when it is over: painting a frame takes
longer than a control tick, and a run in real time must not wait for it.  The engine's renderer on
EGL paints; where EGL does not work, :func:`painter` falls back to a stick figure in the same view,
in parallel projection, which needs pillow only.
"""

from __future__ import annotations

import importlib
import io
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.errors import ConfigurationError, needs
from adaptive_contact.files import write_file
from adaptive_contact_sim.elements import Elements
from adaptive_contact_sim.scene import OBSTACLES, PARKED_M
from adaptive_contact_sim.simulation import Simulation

if TYPE_CHECKING:  # an extra, which a film asks for by name
    from PIL import ImageDraw


class Moment(NamedTuple):
    """What a picture shows."""

    configuration: Array  # of the engine's joints, `qpos`
    # mocap_m, mocap_quaternion: places of the movable obstacles
    mocap_m: Array
    mocap_quaternion: Array
    touching: Mask  # (L,) whether each leg touches
    caption: tuple[str, ...]  # lines for the corner

    @classmethod
    def of(cls, sim: Simulation) -> Moment:
        """Keep the present."""
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


class Stage:
    """The scene of a simulation, on which moments are set up."""

    def __init__(self, sim: Simulation) -> None:
        self.model = sim.scene(looks=True)  # the simulation's own may be without
        self.elements = Elements.resolve(self.model, sim.layout)
        self.terrain = sim.terrain
        self.data = mujoco.MjData(self.model)
        self.touching: Mask = np.zeros(0, dtype=np.bool_)
        self.set(Moment.of(sim))

    def set(self, moment: Moment) -> None:
        """Set up a moment."""
        self.data.qpos[:] = moment.configuration
        self.data.mocap_pos[:] = moment.mocap_m
        self.data.mocap_quat[:] = moment.mocap_quaternion
        self.touching = moment.touching
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    @property
    def position_m(self) -> Array:
        """(3,) of the body."""
        return np.asarray(self.data.xpos[self.elements.body])

    @property
    def rotation(self) -> Array:
        """(3, 3) of the body."""
        return np.asarray(self.data.xmat[self.elements.body].reshape(3, 3))

    @property
    def feet_m(self) -> Array:
        """(L, 3) of the feet."""
        return np.asarray(self.data.site_xpos[self.elements.foot_sites])


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
    """Draws the robot as limbs."""

    def __init__(self, stage: Stage, width: int, height: int) -> None:
        self._size = (width, height)
        self._big = (width * _OVERSAMPLE, height * _OVERSAMPLE)
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
        """Draw what is set up: (height, width, 3) RGB."""
        from PIL import Image as PILImage
        from PIL import ImageDraw

        picture = PILImage.new("RGB", self._big, _SKY)
        draw = ImageDraw.Draw(picture)
        position, rotation = stage.position_m, stage.rotation
        self._centre[:2] += (position[:2] - self._centre[:2]) / 8.0
        self._draw_ground(draw, stage)
        self._draw_obstacles(draw, stage)

        depth = (stage.feet_m[:, :2] - position[:2]) @ self._towards
        order = np.argsort(depth)
        for leg in order[: len(order) // 2]:
            self._draw_leg(draw, stage, int(leg), _FAR_LEG)
        for z, colour in ((-0.022, _BODY[1]), (0.026, _BODY[0])):
            deck = np.column_stack([self._deck, np.full(len(self._deck), z)])
            if len(deck) > 2:  # a leg on a stand has no body
                corners = deck @ rotation.T + position
                draw.polygon(self._project(corners), fill=colour)
        nose = np.array([[0.125, 0.03, 0.026], [0.125, -0.03, 0.026]]) @ rotation.T + position
        draw.line(self._project(nose), fill=(242, 140, 26), width=4 * _OVERSAMPLE)
        for leg in order[len(order) // 2 :]:
            self._draw_leg(draw, stage, int(leg), _NEAR_LEG)
        small = picture.resize(self._size, PILImage.Resampling.LANCZOS)
        return np.asarray(small, dtype=np.uint8).copy()

    def close(self) -> None:
        """Nothing to give back."""

    def _project(self, points: Array) -> list[tuple[float, float]]:
        """World points (n, 3) m to pixels."""
        offset = points - self._centre
        right = offset[:, 0] * -math.sin(_AZIMUTH_RAD) + offset[:, 1] * math.cos(_AZIMUTH_RAD)
        away = offset[:, 0] * math.cos(_AZIMUTH_RAD) + offset[:, 1] * math.sin(_AZIMUTH_RAD)
        up = points[:, 2] * math.cos(_ELEVATION_RAD) + away * math.sin(_ELEVATION_RAD)
        width, height = self._big
        x = width / 2 + right * self._scale
        y = height * 0.62 - up * self._scale
        return [(float(a), float(b)) for a, b in zip(x, y, strict=True)]

    def _draw_ground(self, draw: ImageDraw.ImageDraw, stage: Stage) -> None:
        """Grid lines on the ground around the robot, following its heights."""
        base = np.round(self._centre[:2] / _GRID_M) * _GRID_M
        fine = np.linspace(-_GRID_HALF * _GRID_M, _GRID_HALF * _GRID_M, 8 * _GRID_HALF + 1)
        for k in range(-_GRID_HALF, _GRID_HALF + 1):
            for axis in (0, 1):
                line = np.zeros((fine.size, 3))
                line[:, axis] = base[axis] + k * _GRID_M
                line[:, 1 - axis] = base[1 - axis] + fine
                line[:, 2] = stage.terrain.height_at(line[:, 0], line[:, 1])
                draw.line(self._project(line), fill=_LINE, width=_OVERSAMPLE)

    def _draw_obstacles(self, draw: ImageDraw.ImageDraw, stage: Stage) -> None:
        """The obstacles that stand, as the outlines of their boxes."""
        for name in OBSTACLES:
            if stage.model.body_mocapid.max() < 0:
                return
            geom = stage.model.geom(f"obstacle_{name}").id
            if stage.data.geom_xpos[geom, 2] > PARKED_M[2] / 2:
                self._draw_box(draw, stage, geom)

    def _draw_box(self, draw: ImageDraw.ImageDraw, stage: Stage, geom: int) -> None:
        half = stage.model.geom_aabb[geom, 3:]
        signs = np.array(
            [[a, b, c] for c in (-1, 1) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        )
        rotation = stage.data.geom_xmat[geom].reshape(3, 3)
        box = (signs * half) @ rotation.T + stage.data.geom_xpos[geom]
        box[:, 2] = np.maximum(box[:, 2], 0.0)  # what is under the ground is not seen
        corners = self._project(box)
        for face in ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7)):
            draw.polygon([corners[i] for i in face], fill=_OBSTACLE, outline=(150, 70, 48))

    def _draw_leg(
        self, draw: ImageDraw.ImageDraw, stage: Stage, leg: int, colour: tuple[int, int, int]
    ) -> None:
        joints = stage.data.xpos[self._links[leg]]
        foot = stage.feet_m[leg]
        points = self._project(np.vstack([joints, foot]))
        for k, width in enumerate(np.linspace(10, 7, len(joints)).round().astype(int).tolist()):
            draw.line(points[k : k + 2], fill=colour, width=width * _OVERSAMPLE)
        for x, y in points[:-1]:
            r = 6 * _OVERSAMPLE
            draw.ellipse((x - r, y - r, x + r, y + r), fill=colour)
        x, y = points[-1]
        r = 7 * _OVERSAMPLE
        draw.ellipse((x - r, y - r, x + r, y + r), fill=_TOUCHING if stage.touching[leg] else _FREE)


TOUCHING_RGBA: Final = (0.93, 0.16, 0.14, 1.0)
FREE_RGBA: Final = (0.16, 0.55, 0.88, 1.0)
_DISTANCE_M: Final = 0.95
_AZIMUTH_DEG: Final = 128.0
_ELEVATION_DEG: Final = -20.0
_LOOK_AT_HEIGHT_M: Final = 0.07
# The camera follows the body with this lag, in frames, so that steps do not shake the picture.
_FOLLOW_FRAMES: Final = 8.0


def painter(
    stage: Stage, width: int, height: int
) -> tuple[EnginePainter | StickPainter, str | None]:
    """Make the best painter this machine has.

    Returns:
        The painter, and why it is a stick figure, None where it is not.
    """
    try:
        return EnginePainter(stage, width, height), None
    except ConfigurationError as error:
        return StickPainter(stage, width, height), str(error)


class EnginePainter:
    """The engine's own renderer, offscreen on EGL.

    EGL is asked for by itself, not through ``MUJOCO_GL``, which is read once when mujoco is
    imported and would have to be set before.

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

    def paint(self, stage: Stage) -> Pixels:
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


# File kind -> width, height, control ticks per frame.
_KINDS: Final = {".png": (960, 720, 1), ".gif": (480, 360, 4), ".mp4": (800, 600, 2)}
_GIF_COLOURS: Final = 96
# Painting takes three times the time that was filmed, and a gif grows by 0.3 MB per second.
_LONGEST_S: Final = 300.0


class Film:
    """A picture or film of a run; a context manager.

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
        self._most = round(_LONGEST_S / self._frame_s)
        if self._kind == ".mp4":
            with needs("rendering to .mp4", "video"):
                importlib.import_module("imageio.v2")
                importlib.import_module("imageio_ffmpeg")  # imageio finds its ffmpeg through it
        self._sim = sim
        self._stage = Stage(sim)
        self._painter, self.fallback = painter(self._stage, self._width, self._height)
        self._moments: list[Moment] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def look(self) -> None:
        """Keep the present moment, if a frame is due."""
        if self._kind == ".png":
            self._moments[:] = [Moment.of(self._sim)]
        elif self._sim.ticks % self._every == 0 and len(self._moments) < self._most:
            self._moments.append(Moment.of(self._sim))

    def close(self) -> None:
        """Paint what was kept, and write the file."""
        moments = self._moments or [Moment.of(self._sim)]
        if self._kind == ".mp4":
            data = self._video(moments)
        elif self._kind == ".png":
            data = _encoded(self._paint(moments[-1]), "PNG")
        else:
            # One palette per frame, no dithering: flat colours stay flat, and compress.
            first, *rest = (
                self._paint(moment).quantize(_GIF_COLOURS, method=2, dither=0) for moment in moments
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

    def _video(self, moments: list[Moment]) -> bytes:
        """The film as MP4, which ffmpeg writes into a file of its own."""
        import imageio.v2 as imageio

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "film.mp4")
            writer: Any = imageio.get_writer(
                path, fps=1.0 / self._frame_s, codec="libx264", quality=7, macro_block_size=8
            )
            for moment in moments:
                writer.append_data(np.asarray(self._paint(moment)))
            writer.close()
            return path.read_bytes()

    def _paint(self, moment: Moment) -> Any:
        """A pillow image of a moment, with its caption."""
        from PIL import Image as PILImage
        from PIL import ImageDraw

        self._stage.set(moment)
        picture = PILImage.fromarray(self._painter.paint(self._stage))
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
