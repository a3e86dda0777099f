"""Figures of matplotlib without a display: colours, style, files."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from adaptive_contact.errors import MissingExtraError
from adaptive_contact.files import write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which all readers can distinguish; the paper's own where it names one.
BLUE: Final = "#0072B2"
ORANGE: Final = "#E69F00"
GREEN: Final = "#009E73"
RED: Final = "#D55E00"
SKY: Final = "#56B4E9"
PURPLE: Final = "#CC79A7"
GREY: Final = "#666666"
INK: Final = "#222222"
JOINTS: Final = ("coxa", "femur", "tibia")
JOINT_COLOURS: Final = (BLUE, ORANGE, GREEN)


def needs_matplotlib(what: str, extra: str) -> None:
    """Refuse to begin work whose picture could not be drawn.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise MissingExtraError(what, extra)


@contextlib.contextmanager
def styled(style: Mapping[str, Any], what: str, extra: str = "studies") -> Iterator[None]:
    """Draw in a style, whatever that of matplotlib is; decorates a function, too.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    needs_matplotlib(what, extra)
    import matplotlib as mpl

    # Any: the type of its keys differs between versions of matplotlib.
    parameters: Any = dict(style)
    with mpl.rc_context(parameters):
        yield


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """An empty figure, inches; constrained layout and 100 dots an inch unless options differ."""
    from matplotlib.figure import Figure

    chosen: dict[str, Any] = {"dpi": 100, "layout": "constrained"} | options
    return Figure((width, height), **chosen)


def legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """Name the curves of axes below all of a figure."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def png(figure: Figure) -> bytes:
    """A figure as a PNG."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", metadata={"Software": None})
    return picture.getvalue()


def save(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, png(figure), advice="give another folder with --out")
