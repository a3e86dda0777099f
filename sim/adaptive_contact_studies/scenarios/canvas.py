"""What all pages share: colours, matplotlib without a display, small files."""

from __future__ import annotations

import importlib
import io
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive_contact.errors import MissingExtraError
from adaptive_contact.files import write_file
from adaptive_contact_studies.scenarios.spec import Variant

__all__ = ["COLOURS", "INK", "OUTCOMES", "figure", "save"]

INK: Final = "#222222"
COLOURS: Final = {
    Variant.FROZEN: "#8c8c8c",
    Variant.UNGATED: "#d1495b",
    Variant.REFIT: "#b38600",
    Variant.RLS: "#4a9b6e",
    Variant.FULL: "#1f5fa8",
}
# What became of a swing, worst last; the values are those of ``adaptive_contact.score.Outcome``.
OUTCOMES: Final = {
    "clean": "#dfe5ea",
    "hit": "#8fbf9f",
    "miss": "#f0a202",
    "false alarm": "#c1121f",
}
# Plots have few colours: a palette makes a page half as large.
_PALETTE: Final = 160
_DPI: Final = 84


def figure(width_in: float, height_in: float) -> Any:
    """A matplotlib figure that needs no display.

    Raises:
        MissingExtraError: matplotlib or pillow is not installed.
    """
    try:
        matplotlib = importlib.import_module("matplotlib")
        made = importlib.import_module("matplotlib.figure")
        importlib.import_module("PIL.Image")
    except ImportError as error:
        raise MissingExtraError("a page of plots", "studies") from error
    matplotlib.rcParams.update(
        {
            "font.size": 8.5,
            "axes.titlesize": 9,
            "axes.titlelocation": "left",
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.edgecolor": "#999999",
            "axes.labelcolor": INK,
            "xtick.color": "#555555",
            "ytick.color": "#555555",
            "legend.frameon": False,
            "legend.fontsize": 8,
        }
    )
    return made.Figure(figsize=(width_in, height_in), dpi=_DPI, layout="constrained")


def save(figure: Any, path: Path) -> None:
    """Write a figure as a PNG with a small palette, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    image = importlib.import_module("PIL.Image")
    agg = importlib.import_module("matplotlib.backends.backend_agg")
    canvas = agg.FigureCanvasAgg(figure)
    canvas.draw()
    picture = image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    encoded = io.BytesIO()
    picture.quantize(_PALETTE, dither=image.Dither.NONE).save(encoded, "PNG", optimize=True)
    write_file(path, encoded.getvalue(), advice="give another folder with --out")
