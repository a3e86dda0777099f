"""Colours and style of the scenarios' pages."""

from __future__ import annotations

from typing import Any, Final

from adaptive_contact_studies.scenarios.spec import Variant
from adaptive_contact_studies.show.figures import INK

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
PALETTE: Final = 160
DPI: Final = 84
STYLE: Final[dict[str, Any]] = {
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
