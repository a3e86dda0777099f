"""The paper's figures redrawn from our runs, and those of what it leaves out.

Figures of the detection study: curves, tails, limits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.pose import WORKSPACES, Space
from adaptive_contact_studies.show.figures import (
    BLUE,
    GREEN,
    GREY,
    JOINT_COLOURS,
    JOINTS,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    YELLOW,
    new_figure,
    save,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_all"]

# Shown at about the size they are drawn at: no smaller than 9 points.
_STYLE: Final = {"font.size": 10.5, "axes.grid": True, "grid.alpha": 0.25}
# Figure 4: the paper's colours; line and mark tell curves that lie on each other apart.
_CURVES: Final = {
    "all": ("black", "-", "o"),
    "position": (BLUE, "--", "s"),
    "velocity": (ORANGE, "-.", "^"),
    "acceleration": (GREEN, ":", "v"),
}
_NAIVE: Final = "#B3261E"
# Where marks of the naive lines are drawn, beside those of the curves.
_NAIVE_AT: Final = (1e-4, 6e-4, 6e-3, 6e-2, 0.6, 6.0, 20.0)
# Where the other legs' feet stand, from each coxa axis, m.
_STAND_M: Final = (0.115, 0.0, -0.165)


@styled(_STYLE, "the report")
def draw_all(results: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """Draw every figure whose results are there.

    Args:
        results: the tree of a run.
        folder: where pictures go.

    Returns:
        Their files, by name.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    drawings: dict[str, tuple[Callable[[Any], Figure], Any]] = {
        "paper-workspace": (_workspace, results.get("dataset")),
        "paper-responses": (_responses, results.get("responses")),
        "paper-sweep": (_sweep, results.get("identification")),
        "paper-collision": (_collision, results.get("collisions")),
        "paper-roc": (roc_figure, results.get("detection")),
        "paper-tails": (tails_figure, results.get("detection")),
        "paper-limits": (limits_figure, results.get("detection")),
        "paper-residual-map": (_maps, results.get("workspace")),
    }
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name, (draw, data) in drawings.items():
        if data is not None:
            files[name] = folder / f"{name}.png"
            save(draw(data), files[name])
    return files


def _workspace(data: Any) -> Figure:
    """Figure 3: the grid of 1 cm that the leg reaches, both subspaces, the feet's places.

    From above the two subspaces cover the same ground: the upper one is a frame around the lower.
    """
    del data
    figure = new_figure(9.0, 5.2)
    top, side = figure.subplots(1, 2, width_ratios=(1.35, 1.0))
    geometry = LegGeometry.of()
    lower, upper = WORKSPACES["paper"]
    top.margins(0.09)
    index = LEGS.index("rf")
    step = np.arange(-0.26, 0.2601, 0.01)

    x, z = (a.ravel() for a in np.meshgrid(step[step >= 0.0], step))
    points = np.stack([x, np.zeros_like(x), z], axis=1)
    points = points[geometry.reachable(points)]
    side.plot(points[:, 0], points[:, 2], ".", color="black", ms=1.8, label="reached, 1 cm")
    level = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    heights = [sum(space.height_m) / 2 for space in (lower, upper)]
    for space, height, colour, label, size in (
        (upper, heights[1], YELLOW, "upper subspace", 7.0),
        (lower, heights[0], BLUE, "lower subspace", 3.5),
    ):
        inside = _inside(space, points)
        side.plot(points[inside, 0], points[inside, 2], "s", color=colour, ms=4, label=label)
        flat = np.concatenate([level, np.full((len(level), 1), height)], axis=1)
        flat = flat[geometry.reachable(flat)]
        turned = flat @ geometry.rotations[index].T + geometry.mounts_m[index]
        if space is upper:
            top.plot(turned[:, 0], turned[:, 1], ".", color="black", ms=1.8)
        inside = _inside(space, flat)
        top.plot(turned[inside, 0], turned[inside, 1], "s", color=colour, ms=size)
    side.plot([_STAND_M[0]], [_STAND_M[2]], "o", color=GREEN, label="feet of the others")
    side.set(
        xlabel="from the coxa axis (m)",
        ylabel="over the coxa (m)",
        title="leg rf from the side",
        aspect="equal",
    )
    handles, labels = side.get_legend_handles_labels()
    handles += top.plot(geometry.mounts_m[:, 0], geometry.mounts_m[:, 1], "D", color=GREY, ms=5)
    figure.legend(handles, [*labels, "coxa axes"], loc="outside lower center", ncols=3)
    feet = geometry.to_body(np.tile(np.array(_STAND_M), (len(LEGS), 1)))
    for i, name in enumerate(LEGS):
        if i != index:
            top.plot(*feet[i, :2], "o", color=GREEN)
            top.annotate(name, feet[i, :2], xytext=(6, 6), textcoords="offset points", color=GREEN)
    top.set(
        xlabel="forward (m)",
        ylabel="left (m)",
        title=f"from above; leg rf at {heights[0]:.2f} m (blue) and {heights[1]:.2f} m",
        aspect="equal",
    )
    return figure


def _inside(space: Space, points: Any) -> Any:
    """Mask of points of the leg's frame that lie in a subspace."""
    yaw = np.arctan2(points[:, 1], points[:, 0])
    reach = np.hypot(points[:, 0], points[:, 1])
    inside = (yaw >= space.yaw_rad[0]) & (yaw <= space.yaw_rad[1])
    inside &= (reach >= space.reach_m[0] - 1e-9) & (reach <= space.reach_m[1] + 1e-9)
    low, high = space.height_m
    return inside & (points[:, 2] >= low - 1e-9) & (points[:, 2] <= high + 1e-9)


def _responses(data: Any) -> Figure:
    """Figure 2: femur response, command and prediction."""
    figure = new_figure(8.0, 5.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    t = np.array(data["t_s"])
    t = t - t[0]
    upper.step(t, data["desired"], where="post", color="black", lw=1, label="command")
    upper.plot(t, data["measured"], "-", color="#C8A400", lw=2.5, label="measured")
    measured = np.array(data["measured"], dtype=float)
    for name, title, colour, mark in (
        ("paper", "predicted, paper's library", BLUE, "."),
        ("servo", "predicted, servo law", RED, "x"),
    ):
        told = np.array(data[name], dtype=float)
        status = data["status"][name]
        label = title if status == "ok" else f"{title} ({status})"
        upper.plot(t, told, mark, color=colour, ms=5, label=label)
        lower.plot(t, measured - told, f"{mark}-", color=colour, lw=0.7)
    upper.set(ylabel="femur (deg)")
    lower.set(xlabel="time (s)", ylabel="residual (deg)")
    for axes in (upper, lower):
        for k in np.flatnonzero(~np.array(data["swing"])):
            axes.axvspan(t[k], t[k] + 0.02, color="black", alpha=0.06, lw=0)
    handles, labels = upper.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _sweep(data: Any) -> Figure:
    """Figure 4, and under it what R² does not show."""
    sweeps = data["sweeps"]
    figure = new_figure(2.75 * len(sweeps), 9.6)
    grid = figure.subplots(
        4, len(sweeps), sharex="col", sharey="row", squeeze=False, height_ratios=(1.5, 0.9, 1, 1)
    )
    for column, sweep in enumerate(sweeps):
        points = [p for p in sweep["points"] if p["lambda"] > 0 and p["status"] == "ok"]
        lam = [p["lambda"] for p in points]
        above: Axes = grid[0][column]
        beneath: Axes = grid[1][column]
        for name, (colour, style, mark) in _CURVES.items():
            values = np.array([p["train"].get(name) for p in points], dtype=float)
            naive = data["naive"].get(name)
            # Accuracies near 1 above, what the naive prediction scores below, on its own scale:
            # no line is left out because it lies too low.
            above.semilogx(lam, values, color=colour, ls=style, marker=mark, ms=3.5, label=name)
            for axes in (above, beneath) if naive is not None else ():
                axes.semilogx(
                    _NAIVE_AT, np.full(len(_NAIVE_AT), naive), color=_NAIVE, ls=style, lw=1.3,
                    marker=mark, ms=4.5, mfc="white", label=f"naive, {name}",
                )  # fmt: skip
        w = sweep["window"]
        norm = ", normalised" if sweep["normalised"] else ""
        above.set(
            ylim=(0.7, 1.02),
            title=f"{sweep['unit']}{norm}\nN={w['past_measured']} N'={w['past_desired']} "
            f"M={w['preview']}, α={sweep['ridge']}",
        )
        middle: Axes = grid[2][column]
        below: Axes = grid[3][column]
        for joint, colour in enumerate(JOINT_COLOURS):
            values = np.array([p["test"]["over_floor"][joint] for p in points])
            middle.loglog(lam, values, color=colour, label=JOINTS[joint])
            below.loglog(lam, [p["terms"][joint] for p in points], color=colour)
        middle.axhline(1.5, color="black", lw=0.8, ls=":")
        middle.set_ylim(1, 90)
        below.set(xlabel="λ", ylim=(1, 400))
        for axes in grid[:, column]:
            if sweep["picked"] is not None:
                axes.axvline(sweep["picked"], color=PURPLE, lw=1.4)
            if sweep["emptied_at"] is not None:
                axes.axvspan(sweep["emptied_at"], 20.0, color="black", alpha=0.12, lw=0)
            axes.axvline(5.0, color="black", lw=0.8, ls="--")
            axes.set_xlim(1e-4, 20)
            axes.set_xticks([1e-4, 1e-2, 1.0])
            axes.minorticks_off()
    naive = [v for v in data["naive"].values() if isinstance(v, float)]
    grid[1][0].set_ylim(min([*naive, 0.0]) - 0.3, 1.3)
    grid[0][0].set_ylabel("R², training")
    grid[1][0].set_ylabel("R², naive")
    grid[2][0].set(ylabel="RMS over floor, test", yticks=[1, 1.5, 3, 10, 30])
    grid[2][0].set_yticklabels(["1", "1.5", "3", "10", "30"])
    grid[3][0].set(ylabel="terms", yticks=[1, 10, 100])
    grid[3][0].set_yticklabels(["1", "10", "100"])
    handles, labels = grid[0][0].get_legend_handles_labels()
    joints, names = grid[2][0].get_legend_handles_labels()
    # The models first, then the naive prediction, then the joints below.
    order = sorted(range(len(labels)), key=lambda i: labels[i].startswith("naive"))
    figure.legend(
        [*(handles[i] for i in order), *joints],
        [*(labels[i] if "naive" in labels[i] else f"model, {labels[i]}" for i in order), *names],
        loc="outside lower center", ncols=4,
    )  # fmt: skip
    return figure


def _collision(data: Any) -> Figure:
    """Figure 5: one collision, from the body's attitude to the detection."""
    trace = data["trace"]
    figure = new_figure(8.6, 9.6)
    axes = figure.subplots(5, 1, sharex=True)
    fine, ticks = np.array(trace["fine_ms"]), np.array(trace["tick_ms"])
    tracking, residual, difference = (
        np.array(trace[name], dtype=float)
        for name in ("tracking_deg", "residual_deg", "difference_deg")
    )
    tilt, torque = np.array(trace["tilt_deg"]), np.array(trace["torque_nm"])
    for j, colour in enumerate(JOINT_COLOURS):
        axes[0].plot(fine, tilt[:, j], color=colour, label=("x", "y", "z")[j])
        axes[1].plot(fine, torque[:, j], color=colour, label=JOINTS[j])
        axes[2].plot(ticks, tracking[:, j], color=colour)
        axes[3].plot(ticks, residual[:, j], color=colour)
        axes[4].plot(ticks, difference[:, j], ".-", color=colour, lw=1)
        limit = data["limit_deg"][j]  # dots set off, so that equal thresholds all show
        if limit is not None:
            label = f"threshold, {JOINTS[j]}"
            axes[4].axhline(limit, color=colour, lw=1.6, ls=(2 * j, (2, 4)), label=label)
    labels = (
        "body attitude\n(deg)",
        "joint torque\n(N m)",
        "position error:\ncommand − reading\n(deg)",
        "predicted error:\nreading − predicted\n(deg)",
        "change of\n|predicted error|\n(deg)",
    )
    events = [
        (trace["moves_ms"], "black", ":", 1.4, "leg moves"),
        (trace["onset_ms"], "black", "-", 1.4, "touch"),
        *((when, RED, "-", 4.5, "paper's rule") for when in trace["paper_ms"]),
        # Thinner and dashed over the other: both are seen where they coincide.
        *((when, BLUE, (0, (3, 3)), 2.0, "default detector") for when in trace["default_ms"]),
    ]
    for one, label in zip(axes, labels, strict=True):
        one.set_ylabel(label)
        for when, colour, style, width, what in events:
            one.axvline(
                when, color=colour, ls=style, lw=width,
                alpha=0.6 if width > 4 else 1.0, label=what,
            )  # fmt: skip
    for one in axes:
        one.set_xlim(ticks[0], ticks[-1])
    found: dict[str, Any] = {}
    for one in (axes[0], axes[1], axes[4]):
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            found.setdefault(f"body {label}" if label in ("x", "y", "z") else label, handle)
    figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=4)
    axes[4].set_xlabel("time (ms)")
    row = data["table"][data["drawn"]]
    told = [
        f"{name} {'missed' if row[key] is None else f'{row[key]:.0f} ms'}"
        for name, key in (("paper's rule", "paper_ms"), ("default", "default_ms"))
    ]
    axes[0].set_title(
        f"collision {data['drawn'] + 1} of {len(data['table'])}: {row['speed_m_s']:.2f} m/s, "
        f"{row['force_n']:.1f} N; after the touch: {', '.join(told)}"
    )
    return figure


def _maps(data: Any) -> Figure:
    """Residual over the workspace, before and after."""
    import matplotlib as mpl

    names = [n for n, library in data["libraries"].items() if library["map_before"] is not None]
    figure = new_figure(7.4, 3.9 * max(len(names), 1))
    grid = figure.subplots(max(len(names), 1), 2, sharex=True, sharey=True, squeeze=False)
    norm = mpl.colors.LogNorm(1.0, 30.0)
    image = None
    for line, name in enumerate(names):
        library = data["libraries"][name]
        for column, which in enumerate(("map_before", "map_after")):
            axes: Axes = grid[line][column]
            values = np.array(library[which], dtype=float)
            image = axes.imshow(
                values, origin="lower", extent=data["extent_m"], norm=norm, cmap="viridis",
                aspect="equal",
            )  # fmt: skip
            axes.grid(visible=False)
            made = "model of the paper's subspaces" if column == 0 else "one model of the whole"
            axes.set_title(f"{name} library,\n{made}")
            for space in WORKSPACES["paper"]:
                low, high = space.reach_m
                axes.plot(
                    [low, high, high, low, low],
                    [*np.repeat(space.height_m, 2), space.height_m[0]],
                    color=RED, lw=1.4, ls="--",
                )  # fmt: skip
        grid[line][0].set_ylabel("height (m)")
    for axes in grid[-1]:
        axes.set_xlabel("reach (m)")
    if image is not None:
        figure.colorbar(
            image, ax=grid, label="RMS residual over the noise floor", shrink=0.8, extend="max",
            ticks=(1, 1.5, 2, 3, 5, 10, 20, 30), format="%g",
        )  # fmt: skip
    return figure


_STYLES: Final = {
    "default": ("black", "-", 2.2),
    "ungated": (YELLOW, "-", 1.8),
    "servo ratio": (BLUE, "-", 1.8),
    "servo rule": (SKY, "--", 1.4),
    "paper ratio": (ORANGE, "-", 1.4),
    "paper rule": (RED, "-", 1.8),
    "analytical ratio": (GREEN, "-", 1.4),
    "analytical rule": (GREEN, "--", 1.4),
    "tracking": (PURPLE, "-", 1.4),
    "naive": (GREY, "-", 1.4),
}
_LIMITED: Final = ("default", "servo ratio", "paper rule", "analytical ratio", "tracking")
_TAILED: Final = ("servo ratio", "analytical ratio", "paper ratio", "paper rule")
# Where the curve of the share of free ticks ends, and touches are drawn above it.
_PEAKS_AT: Final = 2.0
# What the default is held to, docs/paper.md.
_GOAL_PER_HOUR: Final = 5.0
_GOAL_RECALL: Final = 99.0


def roc_figure(data: Any) -> Figure:
    """Headline recall against false alarms, thresholds swept; whole, and from 90 % on."""
    figure = new_figure(10.4, 6.6)
    whole, upper = figure.subplots(1, 2)
    hours = data["figures"]["default"]["false_alarms"]["all"]["hours"]
    for axes in (whole, upper):
        for name, title in data["detectors"].items():
            _curve(axes, name, title, data["figures"][name])
        axes.axvline(_GOAL_PER_HOUR, color="black", lw=0.8, ls=":")
        axes.axhline(_GOAL_RECALL, color="black", lw=0.8, ls=":")
        # Between no alarm and one there is no rate.
        axes.axvspan(0.25 / hours, 0.7 / hours, color=GREY, alpha=0.15, lw=0)
        axes.set(
            xscale="log",
            xlim=(0.25 / hours, None),
            xlabel=f"false alarms per robot-hour (in {hours:.1f} h); threshold falls →",
        )
    whole.set(ylim=(-2, 102), ylabel="recall, headline touches (%)")
    upper.set(ylim=(90, 100.2), title="the same from 90 % on")
    _words(upper, 0.36 / hours, 91.0, "no false alarm seen", rotation=90)
    _words(upper, _GOAL_PER_HOUR, 90.2, f" goal: {_GOAL_PER_HOUR:g} per hour", ha="left")
    _words(upper, 1.0, _GOAL_RECALL, f"goal: {_GOAL_RECALL:g} %", x_axes=True, ha="right")
    handles, labels = whole.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _words(
    axes: Axes, x: float, y: float, words: str, *, x_axes: bool = False, **style: Any
) -> None:
    """Say what a line is, beside it; ``x_axes`` gives x as a share of the axes' width."""
    transform = axes.get_yaxis_transform() if x_axes else axes.transData
    style = {"ha": "center", "va": "bottom", "fontsize": 9, "color": "#444444", **style}
    axes.text(x, y, words, transform=transform, **style)


def _curve(axes: Axes, name: str, title: str, figures: Any) -> None:
    """A detector's curve, and the point at which it runs."""
    colour, style, width = _STYLES[name]
    at = _place(figures["false_alarms"]["all"], figures["summary"]["rows"]["headline"])
    points = [
        (*_place(p, p), p.get("aim")) for p in figures.get("roc", ()) if p["per_hour"] is not None
    ]
    if any(aim is not None for *_, aim in points) and at is not None:
        # Played at some aims besides the product's own, which is the star.
        points = sorted([*points, (*at, None)], key=lambda p: p[:2])
    mark = "s" if name == "default" else ""
    axes.plot(
        [x for x, *_ in points], [y for _, y, _ in points],
        ls=style, color=colour, lw=width, marker=mark, ms=4, label=title if points else None,
    )  # fmt: skip
    if at is not None:
        shape, size = {"default": ("*", 15), "ungated": ("X", 9)}.get(name, ("o", 6))
        axes.plot(
            [at[0]], [at[1]], shape, color=colour, ms=size, mec="white", zorder=5,
            label=None if points else title,
        )  # fmt: skip


def _place(rate: Any, row: Any) -> Any:
    """False alarms per hour and recall in per cent; None where the rate is not counted.

    What was never seen is drawn where half an alarm would be.
    """
    if rate["per_hour"] is None:
        return None
    return max(rate["per_hour"], 0.5 / max(rate["hours"], 1e-9)), 100 * (row["recall"] or 0)


def tails_figure(data: Any) -> Figure:
    """How high free ticks score, and touches: why an aim's threshold may find nothing."""
    figure = new_figure(8.4, 6.0)
    axes = figure.subplots()
    shown = [name for name in _TAILED if name in data["tails"]]
    for line, name in enumerate(shown):
        tail = data["tails"][name]
        colour, style, width = _STYLES[name]
        share = np.array(tail["above"], dtype=float)
        seen = share > 0
        axes.plot(
            np.array(tail["factors"])[seen], share[seen],
            color=colour, ls=style, lw=width, label=data["detectors"][name],
        )  # fmt: skip
        if tail["peaks"] is not None:
            low, middle, high = tail["peaks"]
            height = _PEAKS_AT * 2.2**line
            axes.plot([low, high], [height, height], color=colour, lw=width, ls=style)
            axes.plot([middle], [height], "D", color=colour, ms=7)
    highest = max([1.0, *(max(data["tails"][name]["peaks"] or [1.0]) for name in shown)])
    axes.axhline(1.0, color="black", lw=0.8)
    axes.axvline(1.0, color="black", lw=1.2)
    axes.annotate(
        "the aim's threshold", (1.0, 3e-7), xytext=(-5, 0), textcoords="offset points",
        rotation=90, va="bottom", ha="right",
    )  # fmt: skip
    axes.set(
        xscale="log",
        yscale="log",
        ylim=(2e-7, _PEAKS_AT * 2.2 ** len(shown)),
        xlim=(1e-3, 1.5 * highest),
        xlabel="score (statistic over the threshold of one false alarm per robot-hour)",
        ylabel="share of free ticks above; over 1: highest at touches",
    )
    axes.set_yticks([1e-6, 1e-4, 1e-2, 1.0])
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def limits_figure(data: Any) -> Figure:
    """Recall against approach speed and contact force, with 95 % intervals."""
    figure = new_figure(10.4, 6.0)
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, field, label in (
        (left, "by_speed", "speed at touch (m/s), hard ground"),
        (right, "by_force", "force, mean over 20 ms (N)"),
    ):
        for offset, name in enumerate(_LIMITED):
            bins = [b for b in data["figures"][name][field] if b["touches"]]
            # The last bin of the forces has no upper end.
            centre = np.array(
                [np.sqrt(max(b["low"], 0.01) * (b["high"] or 2.5 * b["low"])) for b in bins]
            )
            recall = 100 * np.array([b["recall"] for b in bins])
            spread = 100 * np.array([b["interval"] for b in bins]).reshape(-1, 2)
            colour, style, _ = _STYLES[name]
            axes.errorbar(
                centre * (1 + 0.03 * (offset - 2)),
                recall,
                yerr=np.abs(spread.T - recall),
                color=colour, ls=style, marker="o", ms=3.5, lw=1.3, elinewidth=0.8,
                label=data["detectors"][name],
            )  # fmt: skip
        axes.set(xscale="log", xlabel=label, ylim=(-2, 102))
    limits = data["limits"]
    steps = list(limits["step_m"].values())
    for ticks, alpha in ((1, 0.28), (3, 0.14)):
        left.axvspan(
            min(steps) / (ticks * limits["period_s"]), max(steps) / (ticks * limits["period_s"]),
            color=GREY, alpha=alpha, lw=0,
            label=f"a servo step in {ticks} tick{'s' if ticks > 1 else ''} (tibia to coxa)",
        )  # fmt: skip
    left.axvline(0.1, color=GREY, lw=1.2, ls="--", label="500 ms allowed below, 120 ms above")
    forces = list(limits["step_n"].values())
    right.axvspan(
        min(forces), max(forces), color=GREY, alpha=0.28, lw=0,
    )  # fmt: skip
    right.set_xlim(0.8 * min(forces), None)
    left.set_ylabel("recall (%)")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure
