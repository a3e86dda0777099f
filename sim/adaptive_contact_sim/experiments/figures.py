"""The paper's figures redrawn from our runs, and those of what it leaves out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from adaptive_contact.errors import MissingExtraError
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.workspace import WORKSPACES, Space

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["draw_all"]

_DPI: Final = 100
_JOINTS: Final = ("coxa", "femur", "tibia")
# Okabe and Ito's colours, told apart by everybody; the paper's own where it names one.
_BLUE, _ORANGE, _GREEN, _RED, _SKY, _PURPLE, _GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#666666",
)  # fmt: skip
_JOINT_COLOURS: Final = (_BLUE, _ORANGE, _GREEN)
_STYLES: Final = {
    "default": (_BLUE, "-", 2.2),
    "servo ratio": (_BLUE, "-", 1.8),
    "servo rule": (_SKY, "--", 1.4),
    "paper ratio": (_ORANGE, "-", 1.4),
    "paper rule": (_RED, "-", 1.8),
    "analytical ratio": (_GREEN, "-", 1.4),
    "analytical rule": (_GREEN, "--", 1.4),
    "tracking": (_PURPLE, "-", 1.4),
    "naive": (_GREY, "-", 1.4),
}


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
    try:
        import matplotlib as mpl
    except ModuleNotFoundError as error:
        raise MissingExtraError("the report", "plot") from error
    mpl.use("Agg")
    drawings: dict[str, tuple[Callable[[Any], Figure], Any]] = {
        "paper-workspace": (_workspace, results.get("dataset")),
        "paper-responses": (_responses, results.get("responses")),
        "paper-sweep": (_sweep, results.get("identification")),
        "paper-collision": (_collision, results.get("collisions")),
        "paper-roc": (_roc, results.get("detection")),
        "paper-limits": (_limits, results.get("detection")),
        "paper-residual-map": (_maps, results.get("workspace")),
    }
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.25}):
        for name, (draw, data) in drawings.items():
            if data is None:
                continue
            figure = draw(data)
            files[name] = folder / f"{name}.png"
            figure.savefig(files[name], dpi=_DPI, metadata={"Software": None})
    return files


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _workspace(data: Any) -> Figure:
    """Figure 3: the grid of 1 cm that the leg reaches, both subspaces, the feet's places."""
    del data
    figure = _figure(8.0, 4.6)
    top, side = figure.subplots(1, 2, width_ratios=(1.35, 1.0))
    geometry = LegGeometry.of()
    lower, upper = WORKSPACES["paper"]
    index = LEGS.index("rf")
    step = np.arange(-0.26, 0.2601, 0.01)

    x, z = (a.ravel() for a in np.meshgrid(step[step >= 0.0], step))
    points = np.stack([x, np.zeros_like(x), z], axis=1)
    points = points[geometry.reachable(points)]
    level = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    height = sum(lower.height_m) / 2
    flat = np.concatenate([level, np.full((len(level), 1), height)], axis=1)
    flat = flat[geometry.reachable(flat)]
    turned = flat @ geometry.rotations[index].T + geometry.mounts_m[index]
    for axes, own, shown in ((side, points, points[:, [0, 2]]), (top, flat, turned[:, :2])):
        axes.plot(shown[:, 0], shown[:, 1], ".", color="black", ms=1.5, label="reached, 1 cm")
        for space, colour, label in ((lower, _BLUE, "lower subspace"), (upper, "#E6C800", "upper")):
            inside = _inside(space, own)
            axes.plot(shown[inside, 0], shown[inside, 1], "s", color=colour, ms=4, label=label)
    side.plot([0.115], [-0.165], "o", color=_GREEN, label="feet of the others")
    side.set(
        xlabel="from the coxa axis (m)",
        ylabel="over the coxa (m)",
        title="from the side",
        aspect="equal",
    )
    handles, labels = side.get_legend_handles_labels()
    handles += top.plot(geometry.mounts_m[:, 0], geometry.mounts_m[:, 1], "s", color=_GREY, ms=4)
    figure.legend(handles, [*labels, "coxa axes"], fontsize=7, loc="outside lower center", ncols=5)
    feet = geometry.to_body(np.tile(np.array([0.115, 0.0, -0.165]), (len(LEGS), 1)))
    others = [i for i in range(len(LEGS)) if i != index]
    top.plot(feet[others, 0], feet[others, 1], "o", color=_GREEN)
    top.set(
        xlabel="forward (m)",
        ylabel="left (m)",
        title=f"from above, leg rf, at {height:.2f} m",
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
    figure = _figure(8.0, 4.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    t = np.array(data["t_s"])
    t = t - t[0]
    upper.step(t, data["desired"], where="post", color="black", lw=1, label="command")
    upper.plot(t, data["measured"], "-", color="#C8A400", lw=2.5, label="measured")
    upper.plot(t, data["paper"], ".", color=_BLUE, ms=5, label="predicted, paper's library")
    upper.plot(t, data["servo"], "x", color=_RED, ms=4, label="predicted, servo law")
    upper.set(ylabel="femur (deg)")
    upper.legend(fontsize=7, ncols=2)
    measured = np.array(data["measured"], dtype=float)
    for name, colour in (("paper", _BLUE), ("servo", _RED)):
        lower.plot(t, measured - np.array(data[name], dtype=float), ".-", color=colour, lw=0.7)
    lower.set(xlabel="time (s)", ylabel="residual (deg)")
    for axes in (upper, lower):
        for k in np.flatnonzero(~np.array(data["swing"])):
            axes.axvspan(t[k], t[k] + 0.02, color="black", alpha=0.06, lw=0)
    return figure


def _sweep(data: Any) -> Figure:
    """Figure 4, and under it what R² does not show."""
    sweeps = data["sweeps"]
    figure = _figure(3.3 * len(sweeps), 6.6)
    grid = figure.subplots(3, len(sweeps), sharex="col", squeeze=False)
    curves = (
        ("all", "black"),
        ("position", _BLUE),
        ("velocity", _ORANGE),
        ("acceleration", _GREEN),
    )
    for column, sweep in enumerate(sweeps):
        points = [p for p in sweep["points"] if p["lambda"] > 0 and p["status"] == "ok"]
        lam = [p["lambda"] for p in points]
        above: Axes = grid[0][column]
        for name, colour in curves:
            above.semilogx(lam, [p["train"].get(name) for p in points], color=colour, label=name)
            naive = data["naive"].get(name)
            if naive is not None and naive > -0.2:
                above.axhline(naive, color=_RED, lw=1, ls="-" if name == "position" else ":")
        w = sweep["window"]
        norm = ", normalised" if sweep["normalised"] else ""
        above.set(
            ylim=(-0.15, 1.05),
            title=f"{sweep['unit']}{norm}\nN={w['past_measured']} N'={w['past_desired']} "
            f"M={w['preview']}, α={sweep['ridge']}",
        )
        middle: Axes = grid[1][column]
        for joint, colour in enumerate(_JOINT_COLOURS):
            values = [p["test"]["over_floor"][joint] for p in points]
            middle.loglog(lam, values, color=colour, label=_JOINTS[joint])
        middle.axhline(1.5, color="black", lw=0.8, ls=":")
        middle.set_ylim(1, 90)
        below: Axes = grid[2][column]
        for joint, colour in enumerate(_JOINT_COLOURS):
            below.loglog(lam, [p["terms"][joint] for p in points], color=colour)
        below.set(xlabel="λ")
        for axes in (above, middle, below):
            if sweep["picked"] is not None:
                axes.axvline(sweep["picked"], color=_PURPLE, lw=1)
            if sweep["emptied_at"] is not None:
                axes.axvspan(sweep["emptied_at"], 20.0, color="black", alpha=0.12, lw=0)
            axes.axvline(5.0, color="black", lw=0.8, ls="--")
            axes.set_xlim(1e-4, 20)
    grid[0][0].set_ylabel("R², training (red: naive)")
    grid[1][0].set_ylabel("RMS over floor, test")
    grid[2][0].set_ylabel("terms")
    grid[0][0].legend(fontsize=7, loc="lower left")
    grid[1][0].legend(fontsize=7, loc="upper left")
    return figure


def _collision(data: Any) -> Figure:
    """Figure 5: one collision, from the body's attitude to the detection."""
    trace = data["trace"]
    figure = _figure(8.0, 8.2)
    axes = figure.subplots(5, 1, sharex=True)
    fine, ticks = np.array(trace["fine_ms"]), np.array(trace["tick_ms"])
    tilt, torque = np.array(trace["tilt_deg"]), np.array(trace["torque_nm"])
    for j, colour in enumerate(_JOINT_COLOURS):
        axes[0].plot(fine, tilt[:, j], color=colour, label=("x", "y", "z")[j])
        axes[1].plot(fine, torque[:, j], color=colour, label=_JOINTS[j])
        axes[2].plot(ticks, np.array(trace["tracking_deg"], dtype=float)[:, j], color=colour)
        axes[3].plot(ticks, np.array(trace["residual_deg"], dtype=float)[:, j], color=colour)
        axes[4].plot(
            ticks, np.array(trace["difference_deg"], dtype=float)[:, j], ".-", color=colour, lw=1
        )
        axes[4].axhline(data["limit_deg"][j], color=colour, lw=0.8, ls=":")
    labels = (
        "body attitude\n(deg)",
        "joint torque\n(N m)",
        "position error\n(deg)",
        "predicted error\n(deg)",
        "difference\n(deg)",
    )
    for one, label in zip(axes, labels, strict=True):
        one.set_ylabel(label)
        one.axvline(trace["moves_ms"], color="black", lw=0.8, ls=":")
        one.axvline(trace["onset_ms"], color="black", lw=1.2)
        for when in trace["paper_ms"]:
            one.axvline(when, color=_RED, lw=3.0, alpha=0.6)
        for when in trace["default_ms"]:
            one.axvline(when, color=_BLUE, lw=1.2, ls="--")
    axes[0].legend(fontsize=7, loc="upper right", ncols=3)
    axes[1].legend(fontsize=7, loc="upper right", ncols=3)
    axes[4].set_xlabel(
        "time (ms); black: leg moves (dotted), touch; red: the paper's rule; "
        "blue dashed: the default detector"
    )
    return figure


def _roc(data: Any) -> Figure:
    """Headline recall against false alarms, thresholds swept."""
    figure = _figure(7.4, 5.2)
    axes = figure.subplots()
    hours = data["figures"]["default"]["false_alarms"]["all"]["hours"]
    # What was never seen is drawn where half an alarm would be.
    least = 0.5 / max(hours, 1e-9)
    for name, title in data["detectors"].items():
        colour, style, width = _STYLES[name]
        figures = data["figures"][name]
        if "roc" not in figures:
            rate = max(figures["false_alarms"]["all"]["per_hour"] or 0.0, least)
            recall = figures["summary"]["rows"]["headline"]["recall"]
            axes.plot(
                [rate], [100 * (recall or 0)], "*", color="black", ms=13, label=title, zorder=5
            )
            continue
        points = [p for p in figures["roc"] if p["per_hour"] is not None]
        axes.plot(
            [max(p["per_hour"], least) for p in points],
            [100 * (p["recall"] or 0) for p in points],
            style, color=colour, lw=width, label=title,
        )  # fmt: skip
        aim = [p for p in points if abs(p["factor"] - 1.0) < 1e-6]
        for p in aim:
            axes.plot([max(p["per_hour"], least)], [100 * (p["recall"] or 0)], "o", color=colour)
    axes.axvline(5.0, color="black", lw=0.8, ls=":")
    axes.axhline(99.0, color="black", lw=0.8, ls=":")
    axes.set(
        xscale="log",
        ylim=(-2, 102),
        xlabel=f"false alarms per robot-hour ({hours:.1f} h; left edge: none seen)",
        ylabel="recall, hard ground, ≥ 0.2 m/s (%)",
    )
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=3)
    return figure


def _limits(data: Any) -> Figure:
    """Recall against approach speed and contact force, with 95 % intervals."""
    figure = _figure(8.0, 4.3)
    left, right = figure.subplots(1, 2, sharey=True)
    shown = ("default", "servo ratio", "paper rule", "analytical ratio", "tracking")
    for axes, field, label in (
        (left, "by_speed", "speed at touch (m/s), hard ground"),
        (right, "by_force", "force, mean over 20 ms (N)"),
    ):
        for offset, name in enumerate(shown):
            bins = [b for b in data["figures"][name][field] if b["touches"]]
            centre = np.array([np.sqrt(max(b["low"], 0.01) * b["high"]) for b in bins])
            recall = 100 * np.array([b["recall"] for b in bins])
            spread = 100 * np.array([b["interval"] for b in bins])
            colour, style, _ = _STYLES[name]
            if name == "default":
                colour = "black"
            axes.errorbar(
                centre * (1 + 0.03 * (offset - 2)),
                recall,
                yerr=np.abs(spread.T - recall),
                color=colour, ls=style, marker="o", ms=3, lw=1.2, elinewidth=0.7,
                label=data["detectors"][name],
            )  # fmt: skip
        axes.set(xscale="log", xlabel=label, ylim=(-2, 102))
    left.set_ylabel("recall (%)")
    handles, labels = right.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=3)
    return figure


def _maps(data: Any) -> Figure:
    """Residual over the workspace, before and after."""
    import matplotlib as mpl

    names = list(data["libraries"])
    figure = _figure(7.0, 3.4 * len(names))
    grid = figure.subplots(len(names), 2, sharex=True, sharey=True, squeeze=False)
    extent = (*data["reach_m"], *data["height_m"])
    norm = mpl.colors.LogNorm(1.0, 10.0)
    image = None
    for line, name in enumerate(names):
        library = data["libraries"][name]
        for column, which in enumerate(("map_before", "map_after")):
            axes: Axes = grid[line][column]
            values = np.array(library[which], dtype=float)
            image = axes.imshow(
                values, origin="lower", extent=extent, norm=norm, cmap="viridis", aspect="equal"
            )
            axes.grid(visible=False)
            made = "model of the paper's subspaces" if column == 0 else "one model of the whole"
            axes.set_title(f"{name} library,\n{made}", fontsize=8)
            for space in WORKSPACES["paper"]:
                low, high = space.reach_m
                axes.plot(
                    [low, high, high, low, low],
                    [*np.repeat(space.height_m, 2), space.height_m[0]],
                    color=_RED, lw=1.2, ls="--",
                )  # fmt: skip
        grid[line][0].set_ylabel("height (m)")
    for axes in grid[-1]:
        axes.set_xlabel("reach (m)")
    assert image is not None
    figure.colorbar(
        image, ax=grid, label="RMS residual over the noise floor", shrink=0.8, extend="max",
        ticks=(1, 1.5, 2, 3, 5, 10), format="%g",
    )  # fmt: skip
    return figure
