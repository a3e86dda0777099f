"""The paper's figures redrawn from our runs, and those of what it leaves out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.pose import WORKSPACES
from adaptive_contact_studies.paper.detection_figures import (
    limits_figure,
    roc_figure,
    tails_figure,
)
from adaptive_contact_studies.show.figures import (
    BLUE,
    GREEN,
    GREY,
    JOINT_COLOURS,
    JOINTS,
    ORANGE,
    PURPLE,
    RED,
    YELLOW,
    legend_below,
    new_figure,
    save,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Shown at about the size they are drawn at: no smaller than 9 points.
_STYLE: Final = {"font.size": 10.5, "axes.grid": True, "grid.alpha": 0.25}
# Figure 4: the paper's colours; line and mark distinguish curves that lie on each other.
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
    geometry = LegGeometry()
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
        inside = space.holds(points)
        side.plot(points[inside, 0], points[inside, 2], "s", color=colour, ms=4, label=label)
        flat = np.concatenate([level, np.full((len(level), 1), height)], axis=1)
        flat = flat[geometry.reachable(flat)]
        turned = flat @ geometry.rotations[index].T + geometry.mounts_m[index]
        if space is upper:
            top.plot(turned[:, 0], turned[:, 1], ".", color="black", ms=1.8)
        inside = space.holds(flat)
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
        predicted = np.array(data[name], dtype=float)
        status = data["status"][name]
        label = title if status == "ok" else f"{title} ({status})"
        upper.plot(t, predicted, mark, color=colour, ms=5, label=label)
        lower.plot(t, measured - predicted, f"{mark}-", color=colour, lw=0.7)
    upper.set(ylabel="femur (deg)")
    lower.set(xlabel="time (s)", ylabel="residual (deg)")
    for axes in (upper, lower):
        for k in np.flatnonzero(~np.array(data["swing"])):
            axes.axvspan(t[k], t[k] + 0.02, color="black", alpha=0.06, lw=0)
    legend_below(figure, upper, 2)
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
    delays = [
        f"{name} {'missed' if row[key] is None else f'{row[key]:.0f} ms'}"
        for name, key in (("paper's rule", "paper_ms"), ("default", "default_ms"))
    ]
    axes[0].set_title(
        f"collision {data['drawn'] + 1} of {len(data['table'])}: {row['speed_m_s']:.2f} m/s, "
        f"{row['force_n']:.1f} N; after the touch: {', '.join(delays)}"
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
