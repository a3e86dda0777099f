"""Pictures into files: ``.png`` (the last moment), ``.gif`` or ``.mp4``.

A run keeps moments, and the film is painted when it is over: painting a frame takes longer than a
control tick, and a run in real time must not wait for it.
"""

from __future__ import annotations

import importlib
import io
import tempfile
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from adaptive_contact.errors import ConfigurationError, MissingExtraError
from adaptive_contact.files import write_file
from adaptive_contact_sim.picture import Painter, painter
from adaptive_contact_sim.simulation import Simulation
from adaptive_contact_sim.stage import Moment, Stage

__all__ = ["Film"]

# File kind -> width, height, control ticks per frame.
_KINDS: Final = {".png": (960, 720, 1), ".gif": (480, 360, 4), ".mp4": (800, 600, 2)}
_GIF_COLOURS: Final = 96
# Painting takes three times the time that was filmed, and a gif grows by 0.3 MB per second.
_LONGEST_S: Final = 300.0


class Film:
    """A picture or film of a run; a context manager.

    Args:
        path: where to; its ending says what.
        sim: what to film.

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
        _need_pillow()
        self._width, self._height, self._every = _KINDS[self._kind]
        self._frame_s = self._every * sim.settings.period_s
        self._most = round(_LONGEST_S / self._frame_s)
        if self._kind == ".mp4":
            _need_video()
        self._sim = sim
        self._stage = Stage(sim)
        self._painter: Painter
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
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "film.mp4")
            writer = _video(path, 1.0 / self._frame_s)
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


def _need_pillow() -> None:
    try:
        importlib.import_module("PIL")
    except ImportError as error:
        raise MissingExtraError("--render", "plot") from error


def _need_video() -> None:
    try:
        importlib.import_module("imageio.v2")
        importlib.import_module("imageio_ffmpeg")  # imageio finds its ffmpeg through it
    except ImportError as error:
        raise MissingExtraError("rendering to .mp4", "video") from error


def _video(path: Path, frames_per_s: float) -> Any:
    import imageio.v2 as imageio

    return imageio.get_writer(
        path, fps=frames_per_s, codec="libx264", quality=7, macro_block_size=8
    )
