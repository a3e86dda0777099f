"""Pictures into files: ``.png`` (the last picture), ``.gif`` or ``.mp4``."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.errors import ConfigurationError, MissingExtraError
from adaptive_contact_sim.picture import Painter, painter
from adaptive_contact_sim.simulation import Simulation

__all__ = ["Film"]

Image = NDArray[np.uint8]

# File kind -> width, height, control ticks per frame.
_KINDS: Final = {".png": (960, 720, 1), ".gif": (480, 360, 4), ".mp4": (800, 600, 2)}
_GIF_COLOURS: Final = 96
# A gif holds all its frames in memory and grows by half a megabyte per second.
_GIF_LONGEST_S: Final = 120.0


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
        self._writer = _video(path, 1.0 / self._frame_s) if self._kind == ".mp4" else None
        self._painter: Painter
        self._painter, self.fallback = painter(sim, self._width, self._height)
        self._sim = sim
        self._frames: list[Any] = []
        self._last: Image | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def look(self) -> None:
        """Take a picture of the present state, if one is due."""
        if self._kind == ".png" or self._sim.ticks % self._every:
            return
        self._take()

    def close(self) -> None:
        """Write the file."""
        if self._kind == ".png":
            self._take()
        self._painter.close()
        if self._writer is not None:
            self._writer.close()
        elif self._kind == ".png" and self._last is not None:
            from PIL import Image as PILImage

            PILImage.fromarray(self._last).save(self.path)
        elif self._frames:
            first, *rest = self._frames
            first.save(
                self.path,
                save_all=True,
                append_images=rest,
                duration=round(self._frame_s * 1e3),
                loop=0,
                optimize=False,
            )

    def _take(self) -> None:
        image = _caption(self._painter.paint(self._sim), self._sim)
        self._last = image
        if self._writer is not None:
            self._writer.append_data(image)
        elif self._kind == ".gif" and len(self._frames) * self._frame_s < _GIF_LONGEST_S:
            from PIL import Image as PILImage

            # One palette per frame, no dithering: flat colours stay flat, and compress.
            self._frames.append(
                PILImage.fromarray(image).quantize(
                    _GIF_COLOURS,
                    method=PILImage.Quantize.FASTOCTREE,
                    dither=PILImage.Dither.NONE,
                )
            )


def _caption(image: Image, sim: Simulation) -> Image:
    """Write time and drifts in force into the corner."""
    from PIL import Image as PILImage
    from PIL import ImageDraw

    picture = PILImage.fromarray(image)
    draw = ImageDraw.Draw(picture)
    lines = [f"{sim.time_s:6.1f} s"]
    for kind, legs in sim.drift.holds().items():
        values = {round(v, 3) for joints in legs.values() for v in joints.values()}
        value = f"{values.pop():g}" if len(values) == 1 else "various"
        lines.append(f"{kind} {value}: {' '.join(legs)}")
    size = max(12, image.shape[0] // 32)
    for i, line in enumerate(lines):
        draw.text((size * 0.7, size * (0.5 + 1.3 * i)), line, fill=(40, 44, 52), font_size=size)
    return np.asarray(picture, dtype=np.uint8)


def _need_pillow() -> None:
    try:
        import PIL  # noqa: F401 - only to know whether it is there
    except ImportError as error:
        raise MissingExtraError("--render", "plot") from error


def _video(path: Path, frames_per_s: float) -> Any:
    try:
        import imageio.v2 as imageio

        importlib.import_module("imageio_ffmpeg")  # imageio finds its ffmpeg through it
    except ImportError as error:
        raise MissingExtraError("rendering to .mp4", "video") from error
    return imageio.get_writer(
        path, fps=frames_per_s, codec="libx264", quality=7, macro_block_size=8
    )
