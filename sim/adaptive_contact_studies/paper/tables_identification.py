"""The identification study as sections and tables.

One model of the workspace or several, as a section with tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from adaptive_contact_studies.paper.rows import NO_MODEL
from adaptive_contact_studies.show.tables import (
    Section,
    Table,
    number,
    per_joint,
    percent,
)

__all__ = ["identification_sections", "workspace_section"]


def identification_sections(data: Any) -> list[Section]:
    """The paper's sweep, and our own selection."""
    naive = data["naive"]
    sweeps = []
    for sweep in data["sweeps"]:
        points = sweep["points"]
        w = sweep["window"]
        ends = f"N={w['past_measured']} N'={w['past_desired']} M={w['preview']}"
        title = f"{sweep['unit']}{', normalised columns' if sweep['normalised'] else ''}, {ends}"
        at_five = next((p for p in points if p["lambda"] == 5.0), None)
        picked = next((p for p in points if p["lambda"] == sweep["picked"]), None)
        for label, point in (("λ = 0", points[0]), ("picked", picked), ("λ = 5", at_five)):
            if point is None:
                sweeps.append([title, label, "-", "not reached", *["-"] * 7])
                continue
            sweeps.append(
                [
                    title,
                    f"{label}"
                    if label != "picked"
                    else f"picked, λ = {number(point['lambda'], 4)}",
                    " ".join(str(n) for n in point["terms"][:3]),
                    point["status"],
                    *(["-"] * 7 if point["status"] in NO_MODEL else _sweep_cells(point)),
                ]
            )
    emptied = [
        f"{s['unit']}{', normalised' if s['normalised'] else ''} "
        f"(N={s['window']['past_measured']}): "
        + (f"λ = {number(s['emptied_at'], 3)}" if s["emptied_at"] else "not within the sweep")
        for s in data["sweeps"]
    ]
    text = (
        f"The paper's library (Eq. 8), PySINDy's STLSQ with ridge term α = "
        f"{data['sweeps'][0]['ridge']} (its default), {data['rows']['train']:,} training rows. The "
        "paper prints neither the unit of its angles nor whether columns are normalised, so the "
        "sweep is made in four conventions. **λ = 5**: the first λ that empties a state is, in "
        f"{'; '.join(emptied)}. "
        f"The naive prediction (no motion) scores R² = {number(naive['position'], 4)} on positions "
        f"and {number(naive['velocity'], 3)} on velocities, at {per_joint(naive['over_floor'], 1)} "
        "times the noise floor: R² of positions cannot tell models apart. The noise floor, "
        f"{number(data['floor_deg'], 4)}°, is computed from half a step of reading noise and the "
        f"rounding to steps of 0.293°; measured against the true angles it is "
        f"{per_joint(data['reading_noise_deg'], 4)}°. `picked` is the sparsest λ at which every "
        "joint's error on held-out swings of the training set is within 0.5 % of its best, which "
        "is the product's own rule (the smallest λ where their best lie apart). R² `all` is that "
        "of the whole state, older positions included, which a model only has to copy."
        + _at_five(data["sweeps"])
    )
    header = [
        "convention", "λ", "terms", "status", "R² all", "position", "velocity", "acceleration",
        "RMS / floor", "sensitivity to u[k]", "condition",
    ]  # fmt: skip
    selection = [
        [
            s["library"],
            number(p["lambda"], 2) + (" *" if p["lambda"] == s["picked"] else ""),
            " ".join(str(n) for n in p["terms"]) + f" of {s['size']}",
            per_joint(p["held_out_rms"], 3) if p["held_out_rms"] else p["status"],
            *(
                ["-"] * 3
                if p["status"] in NO_MODEL
                else [
                    per_joint(p["test_rms_deg"], 3),
                    per_joint(p["over_floor"]),
                    per_joint(p["sensitivity"], 3),
                ]
            ),
        ]
        for s in data["selection"]
        for p in s["points"]
    ]
    windows = [
        [
            w["library"],
            " ".join(str(n) for n in w["window"]),
            str(w["terms"]),
            *(
                ["-", w["status"], "-"]
                if w["status"] in NO_MODEL
                else [
                    per_joint([w["condition"]], 0, scientific=True),
                    per_joint(w["test_rms_deg"], 3),
                    per_joint(w["over_floor"]),
                ]
            ),
        ]
        for w in data["windows"]
    ]
    return [
        Section(
            "Identification (4.2)",
            text,
            [Table("The sweep of λ on the test set (coxa, femur, tibia)", header, sweeps)],
            ["paper-sweep", "paper-responses"],
        ),
        Section(
            "Our own selection of λ, and the window",
            "Increments as targets, columns scaled to unit root mean square, λ in units of the "
            "residual, chosen on held-out swings (*: the largest at which every joint is within "
            "0.5 % of its best): a term stays if it moves the prediction by more than λ times the "
            "residual. The servo's saturating control law is what the "
            "paper's library lacks, and what no sparsity threshold can put back.",
            [
                Table(
                    "λ in units of the residual",
                    ["library", "λ", "terms", "held-out RMS °", "test RMS °", "/ floor",
                     "sensitivity"],
                    selection,
                ),
                Table(
                    "N, N', M (least squares, test set)",
                    ["library", "N N' M", "terms", "condition", "RMS °", "/ floor"],
                    windows,
                ),
            ],
            [],
        ),
    ]  # fmt: skip


def _sweep_cells(point: Mapping[str, Any]) -> list[str]:
    """What a fit with a model scores."""
    test = point["test"]
    return [
        number(test.get("all"), 5),
        number(test["position"], 5),
        number(test["velocity"], 4),
        number(test.get("acceleration"), 3),
        per_joint(test["over_floor"]),
        per_joint(point["sensitivity"], 3),
        per_joint(point["condition"], 0, scientific=True),
    ]


def _at_five(sweeps: Sequence[Mapping[str, Any]]) -> str:
    """What the paper's λ = 5 comes to in our units, in words."""
    emptied, kept = [], []
    for sweep in sweeps:
        w = sweep["window"]
        name = f"{sweep['unit']}{', normalised columns' if sweep['normalised'] else ''} "
        name += f"(N={w['past_measured']})"
        point = next((p for p in sweep["points"] if p["lambda"] == 5.0), None)
        if point is None or point["status"] != "ok":
            emptied.append(name)
            continue
        best = next((p for p in sweep["points"] if p["lambda"] == sweep["picked"]), None)
        cost = ""
        if best is not None:
            ratio = [
                a / b
                for a, b in zip(
                    point["test"]["over_floor"], best["test"]["over_floor"], strict=True
                )
            ]
            cost = f" at {per_joint(ratio)} times the error of the λ that is picked"
        kept.append(f"{name}, {' '.join(str(n) for n in point['terms'][:3])} terms{cost}")
    told = " **Conclusion on λ = 5:** "
    if emptied:
        told += f"it leaves no usable model in {'; '.join(emptied)}"
    if kept:
        told += f"{', and ' if emptied else ''}one in {'; '.join(kept)}"
    if kept:
        told += (
            ". The λ the paper selects can only have been meant for columns that are normalised, "
            "or for other units than these"
        )
    else:
        told += (
            ". On normalised columns a λ grows with the square root of the number of rows: the "
            "paper's has to come from more of them, or from other units"
        )
    return (
        told + "; it is no constant to be carried over, and the λ used here is chosen on held-out "
        "swings."
    )


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
