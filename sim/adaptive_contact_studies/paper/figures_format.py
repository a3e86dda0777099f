"""Colours, names and sizes that the figures share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "BLUE",
    "FONT_PT",
    "GREEN",
    "GREY",
    "JOINTS",
    "JOINT_COLOURS",
    "ORANGE",
    "PURPLE",
    "RED",
    "SKY",
    "YELLOW",
    "new_figure",
]

# Figures are drawn at 100 dots an inch and shown at about that size: no smaller than 9 points.
FONT_PT: Final = 10.5
JOINTS: Final = ("coxa", "femur", "tibia")
# Okabe and Ito's colours, told apart by everybody; the paper's own where it names one.
BLUE: Final = "#0072B2"
ORANGE: Final = "#E69F00"
GREEN: Final = "#009E73"
RED: Final = "#D55E00"
SKY: Final = "#56B4E9"
PURPLE: Final = "#CC79A7"
GREY: Final = "#666666"
YELLOW: Final = "#E6C800"
JOINT_COLOURS: Final = (BLUE, ORANGE, GREEN)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
