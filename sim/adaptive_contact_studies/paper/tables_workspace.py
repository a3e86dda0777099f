"""One model of the workspace or several, as a section with tables."""

from __future__ import annotations

from typing import Any

from adaptive_contact_studies.show.tables import (
    Section,
    Table,
    number,
    per_joint,
    percent,
)

__all__ = ["workspace_section"]


def workspace_section(data: Any) -> Section:
    """What the leg-runs say, and what was decided."""
    rows = []
    for name, library in data["libraries"].items():
        for what, rms in library["rms_deg"].items():
            runs, status = library["leg_runs"][what], library["status"][what]
            if rms is None:
                rows.append([name, what, str(runs), status, "-"])
                continue
            over = per_joint([v / data["floor_deg"] for v in rms])
            shown = per_joint(rms, 3) + ("" if status == "ok" else f" ({status})")
            rows.append([name, what, str(runs), shown, over])
    differences = [
        [
            name,
            what,
            str(d["leg_runs"]),
            _share(d["mean"]),
            " to ".join(_share(end) for end in d["interval"]),
            f"{d['smaller_in']} of {d['leg_runs']}",
        ]
        for name, library in data["libraries"].items()
        for what, d in library["difference"].items()
    ]
    header = ["library", "compared", "leg-runs", "several over one", "95 %", "several better in"]
    return Section(
        "The whole workspace: one model or several",
        f"Eight regions by the medians of yaw, reach and height, {data['leg_runs']} leg-runs; "
        "residuals on free streams with other seeds. The neighbour of a region that was not seen "
        "is the one whose centre is nearest: nothing of the unseen region's rows is looked at. "
        + _workspace_decision(data)
        + _before(data),
        [
            Table(
                "Held-out RMS, mean over leg-runs",
                ["library", "model", "leg-runs", "RMS °", "/ floor"],
                rows,
            ),
            Table(
                "Error of several models over that of one, less 1 (mean of joints; Student's "
                "interval over leg-runs)",
                header,
                differences,
            ),
        ],
        ["paper-residual-map"],
    )


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:+.1f} %"


def _workspace_decision(data: Any) -> str:
    """What was decided for the product, and what the other choice would have gained or lost."""
    seen = data["libraries"]["servo"]["difference"]["all regions seen"]
    unseen = data["libraries"]["servo"]["difference"]["region unseen"]
    if seen["mean"] is None or unseen["mean"] is None:
        return "**No decision: some model could not be fitted.**"

    def change(d: Any) -> str:
        low, high = d["interval"]
        spread = "one leg-run" if low is None else f"95 % {_share(low)} to {_share(high)}"
        return f"{_share(d['mean'])} ({spread}; better in {d['smaller_in']} of {d['leg_runs']})"

    gains = seen["mean"] < 0.0
    told = (
        "**The product uses one model.** With its library (servo) a model per region changes the "
        f"error by {change(seen)} where all regions were seen, "
        f"and by {change(unseen)} where a region was not. "
    )
    if gains and unseen["mean"] > 0.0:
        told += (
            "Several would gain a little where the leg has been, and lose where it has not; one is "
            "kept because a leg that changes has to be learned again from its next swings, and "
            "eight models would each wait for an eighth of the rows. "
        )
    elif gains:
        told += (
            "Several would gain in both; one is kept all the same, because a leg that changes has "
            "to be learned again from its next swings, and eight models would each wait for an "
            "eighth of the rows. "
        )
    else:
        told += "Several gain nothing, and one is simpler. "
    paper = data["libraries"]["paper"]["difference"]["all regions seen"]
    if paper["mean"] is not None:
        told += (
            f"With the paper's library a model per region changes the error by {change(paper)}: "
            + (
                "the ensemble the paper plans makes up for part of what its library lacks. "
                if paper["mean"] < 0.0
                else "no gain either. "
            )
        )
    return told


def _before(data: Any) -> str:
    """Why the model of the paper's subspaces fails on other swings."""
    floor = data["floor_deg"]
    told, known, step = [], {}, None
    for name, library in data["libraries"].items():
        before = library["before"]
        if not before or before.get("unknown_deg") is None or before["known_deg"] is None:
            continue
        known[name], step = before["known_share"], before["command_step_deg"]
        told.append(
            f"{name} {number(before['known_deg'] / floor, 1)} times the floor on windows within "
            f"what it was fitted to ({percent(before['known_share'])} of them) and "
            f"**{number(before['unknown_deg'] / floor, 1)} times beyond** (at the paper's places "
            f"{_times(before['inside_deg'], floor)}, elsewhere "
            f"{_times(before['outside_deg'], floor)}; condition "
            f"{per_joint([before['condition']], 0, scientific=True)})"
        )
    if not told or step is None:
        return ""
    return (
        f"The maps, leg-run {data['mapped']}, and why the paper's library is so bad before: the "
        f"model of the paper's two subspaces has, {'; '.join(told)}. `Within` are windows whose "
        "regressors together (their leverage) are no further out than any it was fitted to. It is "
        "the motion more than the place: the paper's segments change a command by at most "
        f"{number(step[0], 0)}° a tick (99 %), these swings by {number(step[1], 0)}°. Products and "
        "squares of the angles are nearly sums of each other on the segments, their coefficients "
        "large and of opposite sign; in faster turns they no longer cancel. The servo's saturating "
        "law holds there as well."
    )


def _times(value: float | None, floor: float) -> str:
    return "-" if value is None else f"{value / floor:.1f}"
