"""What a run found, as a page with its pictures: ``docs/paper.md``.

Templates (``show/templates/paper``) hold the words, ``results.json`` the figures; nothing here is a
number of its own but the goals.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from adaptive_contact.files import write_file
from adaptive_contact_studies.paper.detection import BOTH, SLOW_FAST
from adaptive_contact_studies.paper.rows import noise_floor
from adaptive_contact_studies.show.colours import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
)
from adaptive_contact_studies.show.pages import (
    number,
    per_joint,
    percent,
    render,
    unwrapped,
    write_page,
)

JOINTS: Final = ("coxa", "femur", "tibia")
# Shown at about the size they are drawn at: no smaller than 9 points.
_STYLE: Final[Any] = {"font.size": 10.5, "axes.grid": True, "grid.alpha": 0.25}
_LOOKS: Final = {
    "default": ("black", "-", 2.2),
    "frozen": (BLUE, "-", 1.8),
    "servo rule": (SKY, "--", 1.4),
    "paper rule": (RED, "-", 1.8),
    "tracking": (PURPLE, "-", 1.4),
    "naive": (GREY, "-", 1.4),
}
# Of Figure 4: line and mark distinguish curves that lie on each other.
_CURVES: Final = {
    "all": ("black", "-", "o"),
    "position": (BLUE, "--", "s"),
    "velocity": (ORANGE, "-.", "^"),
    "acceleration": (GREEN, ":", "v"),
}
# What the run is held to.
_RECALL: Final = 0.99
_TOUCHES: Final = 1000
_MEDIAN_MS: Final = 20.0
_P95_MS: Final = 40.0
_PER_HOUR: Final = 5.0
_HOURS: Final = 10.0
_OVER_FLOOR: Final = 1.5


def write_report(results: Mapping[str, Any], out: Path) -> None:
    """Write ``results.json``, and the page with its pictures beside it.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    text = json.dumps(results, indent=1, ensure_ascii=False, allow_nan=False)
    write_page(out / "results.json", text)
    write_document(results, out / "paper.md")


def write_document(results: Mapping[str, Any], document: Path) -> None:
    """Write the page, its pictures in a folder ``pictures`` beside it.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    write_page(document, markdown("page.md", results=results, headline=headline(results)))
    with mpl.rc_context(_STYLE):
        for name, (draw, size, stage) in _DRAWINGS.items():
            figure = Figure(size, dpi=100, layout="constrained")
            draw(figure, results[stage])
            picture = io.BytesIO()
            figure.savefig(picture, format="png", metadata={"Software": None})
            file = document.parent / "pictures" / f"paper-{name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_file(file, picture.getvalue(), advice="give another folder with --out")


def markdown(template: str, **given: Any) -> str:
    """Fill a template of the paper's."""
    filters: dict[str, Callable[..., Any]] = {"degrees": math.degrees}
    return unwrapped(render(f"paper/{template}", filters, BOTH=BOTH, SLOW_FAST=SLOW_FAST, **given))


def headline(results: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """What was asked for and what was measured, and whether it is reached.

    That is left open where no figure is against it, but less was measured than was asked for.
    """
    lines: list[tuple[str, str, str, str]] = []

    def add(what: str, wanted: str, measured: str, *, kept: bool, enough: bool = True) -> None:
        lines.append((what, wanted, measured, ("yes" if enough else "–") if kept else "**no**"))

    def floor(where: str, over: Sequence[float]) -> None:
        what, wanted = f"one-step RMS over the noise floor, {where}", f"≤ {_OVER_FLOOR} ×"
        add(what, wanted, f"{per_joint(over)} ×", kept=max(over) <= _OVER_FLOOR)

    found = results["detection"]
    row = found["figures"]["default"]["rows"]["headline"]
    alarms = found["figures"]["default"]["false_alarms"]["free"]
    low, high = row["interval"]
    enough = row["touches"] >= _TOUCHES
    add(
        "recall, hard ground, ≥ 0.2 m/s, whole workspace (slow approaches: rows of their own)",
        f"≥ {percent(_RECALL, 0)} of ≥ {_TOUCHES:,}",
        f"{percent(row['recall'])} of {row['touches']} (95 % {percent(low)} to {percent(high)})",
        kept=(row["recall"] or 0.0) >= _RECALL,
        enough=enough,
    )
    median, p95 = row["median_ms"], row["p95_ms"]
    add(
        "latency of those",
        f"median ≤ {_MEDIAN_MS:.0f} ms, p95 ≤ {_P95_MS:.0f} ms",
        f"median {number(median, 1)} ms, p95 {number(p95, 1)} ms",
        kept=median is not None and median <= _MEDIAN_MS and p95 <= _P95_MS,
        enough=enough,
    )
    low, high = alarms["interval"]
    add(
        "false alarms per robot-hour",
        f"≤ {_PER_HOUR:.0f} over ≥ {_HOURS:.0f} h",
        f"{number(alarms['per_hour'])} (95 % {number(low)} to {number(high)}) "
        f"over {number(alarms['hours'], 1)} h",
        kept=alarms["per_hour"] is not None and alarms["per_hour"] <= _PER_HOUR,
        enough=alarms["hours"] >= _HOURS,
    )
    what = "servo law's models as fitted (the default starts from such), standing, judged ticks"
    run, worst = found["worst_leg_run"]
    for where, rms in (
        ("all leg-runs pooled", found["residual_deg"]["servo"]),
        (f"the worst leg-run ({run})", worst),
    ):
        floor(f"{what}, {where}", [v / math.degrees(noise_floor()) for v in rms])
    ours = results["identification"]["selection"][-1]["test"]["over_floor"]
    floor("model of the default's library, the paper's test segments", ours)
    return lines


def _sweep(figure: Figure, data: Any) -> None:
    """Figure 4, and under it what R² does not show."""
    sweeps = data["sweeps"]
    grid = figure.subplots(3, len(sweeps), sharex="col", sharey="row", squeeze=False)
    for (above, middle, below), sweep in zip(grid.T, sweeps, strict=True):
        points = [p for p in sweep["points"] if p["lambda"] > 0 and p["status"] == "ok"]
        lam = [p["lambda"] for p in points]
        for name, (colour, style, mark) in _CURVES.items():
            values = np.array([p["train"].get(name) for p in points], dtype=float)
            above.semilogx(lam, values, color=colour, ls=style, marker=mark, ms=3.5, label=name)
        window, norm = sweep["window"], ", normalised" if sweep["normalised"] else ""
        above.set(ylim=(0.7, 1.02), title=f"{sweep['unit']}{norm}\nN={window['past_measured']}")
        for joint, colour in enumerate((BLUE, ORANGE, GREEN)):
            errors = [p["test"]["over_floor"][joint] for p in points]
            middle.loglog(lam, errors, color=colour, label=JOINTS[joint])
            below.loglog(lam, [p["terms"][joint] for p in points], color=colour)
        middle.axhline(_OVER_FLOOR, color="black", lw=0.8, ls=":")
        below.set_xlabel("λ")
        for axes in (above, middle, below):
            axes.axvline(5.0, color="black", lw=0.8, ls="--")
            axes.set_xlim(1e-4, 20)
            axes.axvline(sweep["best"], color=PURPLE, lw=1.4)
            if sweep["emptied_at"] is not None:
                axes.axvspan(sweep["emptied_at"], 20.0, color="black", alpha=0.12, lw=0)
    for axes, label in zip(
        grid[:, 0], ("R², training", "RMS over floor, test", "terms"), strict=True
    ):
        axes.set_ylabel(label)
    grid[0][0].legend(fontsize=8)
    grid[1][0].legend(fontsize=8)


def _roc(figure: Figure, data: Any) -> None:
    """Headline recall against false alarms; whole, and from 90 % on."""
    whole, upper = figure.subplots(1, 2)
    hours = data["figures"]["default"]["false_alarms"]["free"]["hours"]
    for axes in (whole, upper):
        for name, title in data["detectors"].items():
            _curve(axes, name, title, data["figures"][name])
        axes.axvline(_PER_HOUR, color="black", lw=0.8, ls=":")
        axes.axhline(100 * _RECALL, color="black", lw=0.8, ls=":")
        axes.set(
            xscale="log",
            xlim=(0.25 / hours, None),
            xlabel=f"false alarms per robot-hour (in {hours:.1f} h); threshold falls →",
        )
    whole.set(ylim=(-2, 102), ylabel="recall, headline touches (%)")
    upper.set(ylim=(90, 100.2), title="the same from 90 % on")
    handles, labels = whole.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)


def _curve(axes: Axes, name: str, title: str, figures: Any) -> None:
    """A detector's curve, and the point at which it runs."""
    colour, style, width = _LOOKS[name]
    own = {"recall": figures["rows"]["headline"]["recall"], **figures["false_alarms"]["free"]}
    points = [p for p in figures["roc"] if p["per_hour"] is not None]
    # What was never seen is drawn where half an alarm would be.
    x, y = (
        [max(p["per_hour"], 0.5 / p["hours"]) for p in points],
        [100 * (p["recall"] or 0.0) for p in points],
    )
    axes.plot(x, y, style, color=colour, lw=width, label=title)
    if own["per_hour"] is not None:
        at = max(own["per_hour"], 0.5 / own["hours"]), 100 * (own["recall"] or 0.0)
        mark, size = ("o", 6) if points else ("*", 15)
        axes.plot([at[0]], [at[1]], mark, color=colour, ms=size, mec="white", zorder=5)


# By name of the picture: what draws it, inches, and the stage that it shows.
_DRAWINGS: Final = {
    "sweep": (_sweep, (11.0, 7.6), "identification"),
    "roc": (_roc, (10.4, 6.0), "detection"),
}
