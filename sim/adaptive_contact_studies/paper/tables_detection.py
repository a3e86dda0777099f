"""The detection study as sections and tables.

Where detection ends, and false alarms among contacts, as sections and tables.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from adaptive_contact_studies.paper.touched import BOTH, SLOW_FAST
from adaptive_contact_studies.paper.verdicts import HALF, losses, losses_table, sentence
from adaptive_contact_studies.show.tables import (
    Section,
    Table,
    interval,
    number,
    per_joint,
    percent,
)

__all__ = ["detection_sections", "limits_section"]

_ROWS: Final = (
    "headline", SLOW_FAST, BOTH, "mid", "slow", "creep", "soft", "grazing", "lift", "late",
)  # fmt: skip
_ROWS_ARE: Final = (
    "`headline`: hard ground, 0.2 m/s and more at touch, but for the streams of slow approaches; "
    "`mid`: 0.1 to 0.2 m/s; `slow`: 0.02 to 0.1 m/s; `creep`: below 0.02 m/s; `soft`: soft ground; "
    "`grazing`: motion nearly along the surface; `lift`: the touch falls into the lift of the "
    "swing; `late`: fewer than 3 swing samples are left after it (docs/scoring.md)."
)


def detection_sections(data: Any) -> list[Section]:
    """All that the study found."""
    return [
        _main(data),
        _kinds(data),
        limits_section(data),
        alarms_section(data),
        _learned(data),
    ]


def _main(data: Any) -> Section:
    rows = []
    for name, title in data["detectors"].items():
        figures = data["figures"][name]
        row = figures["summary"]["rows"]["headline"]
        alarms = figures["false_alarms"]["all"]
        rows.append(
            [
                title,
                f"{row['found']} of {row['touches']}",
                percent(row["recall"]),
                interval(row["interval"]),
                number(row["median_ms"], 0),
                number(row["p95_ms"], 0),
                number(row["p99_ms"], 0),
                percent(figures["summary"]["precision"]),
                interval(figures["summary"]["precision_interval"]),
                _counted(alarms),
                number(alarms["per_hour"], 2),
                _rates(alarms["interval"]),
            ]
        )
    both = data["figures"]["default"]["summary"]["rows"].get(BOTH)
    text = (
        f"{data['leg_runs']} leg-runs: legs of robots whose servos differ by 12 %, each with "
        "models of its own. Trained, tuned and reported on different seeds. Every threshold aims "
        f"at {number(data['aim_per_hour'], 0)} false alarm per robot-hour (540,000 swing "
        "leg-ticks), by a tail fitted to tuning streams; only the ROC curves sweep it. "
        + _free(data)
        + " `not counted`: a threshold so low that more than 3 % of the ticks of some stream pass "
        "it. The headline leaves out the streams of slow approaches, whose touches all have rows "
        "of their own: what is touched at speed there is mostly touched by a foot that slipped off "
        "an edge and falls after a command that creeps"
    )
    text += (
        f"; with those touches it is {both['found']} of {both['touches']} "
        f"({percent(both['recall'])}). "
        if both
        else ". "
    )
    known = data["learned"]["analytical"]
    text += (
        "Of the analytical model the stronger form is compared: with the observer tuned on tuning "
        f"streams its one-step RMS is {per_joint(known['observer'], 3)}°, from the last two "
        f"positions alone it would be {per_joint(known['positions only'], 3)}°."
    )
    header = [
        "detector", "found", "recall", "95 %", "median ms", "p95", "p99", "precision (all rows)",
        "95 %", "false alarms", "per hour", "95 %",
    ]  # fmt: skip
    found = losses(data)
    text += sentence(
        found, ("headline",), "recall, latency, precision and false alarms of the headline"
    )
    text += _curves(data) + _tails(data)
    tables = [Table("Headline: hard ground, foot speed at touch ≥ 0.2 m/s", header, rows)]
    if found:
        tables.append(losses_table(data, found))
    return Section("Detection over the whole workspace", text, tables, ["paper-roc", "paper-tails"])


def _counted(alarms: Mapping[str, Any]) -> str:
    if alarms["count"] < 0:
        return "not counted"
    return f"{alarms['count']} in {number(alarms['hours'], 2)} h"


def _rates(ends: Sequence[float | None]) -> str:
    return "-" if ends[0] is None else f"{number(ends[0], 2)}–{number(ends[1], 2)}"


def _free(data: Any) -> str:
    """The default's false alarms on free streams, and what none of them in so many hours says."""
    alarms = data["figures"]["default"]["false_alarms"]
    hung, stood = alarms["free"], alarms["stand"]
    told = (
        f"Free streams: {number(hung['hours'], 2)} h hung up by the body, all six legs swinging "
        f"(same code and constants, the body fixed), and {number(stood['hours'], 2)} h standing on "
        f"five legs; the default raised {hung['count']} and {stood['count']} false alarms there."
    )
    for where, own in (("hung up", hung), ("standing", stood)):
        if own["count"] == 0 and own["interval"][1] is not None:
            told += (
                f" None in {number(own['hours'], 2)} h {where} only bounds the rate: up to "
                f"{number(own['interval'][1], 1)} per robot-hour (95 %)."
            )
    return told


def _curves(data: Any) -> str:
    """What stands behind the default's curve."""
    points = data["figures"]["default"].get("roc")
    if not points:
        return ""
    told = "; ".join(
        f"aim {p['aim']:g}: {percent(p['recall'])} at {number(p['per_hour'], 2)} per hour"
        for p in points
    )
    return (
        " The curves are of the headline's touches, the same for every detector. The default's is "
        "no sweep of a threshold: what it tells as a contact it does not learn, so that every aim "
        f"is a play of its own ({told}). Its recall is of all leg-runs, its false alarms at these "
        f"aims of the first robot's free streams, {number(points[0]['hours'], 2)} h."
    )


def _tails(data: Any) -> str:
    """Why a detector finds nothing at its aim, from how high free ticks and touches score."""
    told = []
    for name, tail in data["tails"].items():
        row = data["figures"][name]["summary"]["rows"]["headline"]
        if not name.startswith("paper") or tail["peaks"] is None or row["recall"] > HALF:
            continue
        middle = tail["peaks"][1]
        said = (
            f" **{data['detectors'][name]}** finds {percent(row['recall'])} at its aim: the median "
            f"touch scores {number(middle, 2)} of the threshold, because free motion scores high "
            f"now and then, a heavy tail (shape {number(tail['shape'], 2)}; 0 is exponential). "
        )
        if tail["top"]:
            said += (
                "Of its free ticks above a tenth of the threshold "
                f"{percent(tail['top_near_turn'])} are among the "
                f"{data['tail_ticks']['near_turn']} after the turn from lift to descent, where "
                f"{percent(tail['near_turn'])} of all are: there the command runs away from the "
                "leg and the servos saturate, which this library cannot say, so that the residual "
                "is an error of the model and no noise. "
            )
        best = max(
            (p for p in data["figures"][name]["roc"] if p["per_hour"] is not None),
            key=lambda p: p["recall"] or 0.0,
            default=None,
        )
        if best is not None:
            said += (
                f"With its threshold lowered to {best['factor']:.2g} of the aim's it finds "
                f"{percent(best['recall'])}, at {number(best['per_hour'], 0)} false alarms per "
                "robot-hour."
            )
        told.append(said.rstrip())
    return "".join(told)


def _kinds(data: Any) -> Section:
    names = list(data["detectors"])
    ours = data["figures"]["default"]
    by_kind = [
        [
            kind,
            str(own["touches"]),
            *(_recall(data["figures"][n]["kinds"][kind]) for n in names),
        ]
        for kind, own in ours["kinds"].items()
    ]
    by_row = [
        [
            row,
            str(ours["summary"]["rows"][row]["touches"]),
            *(_recall(data["figures"][n]["summary"]["rows"].get(row)) for n in names),
        ]
        for row in _ROWS
        if row in ours["summary"]["rows"]
    ]
    headline = [
        [
            kind,
            str(own["headline"]["touches"]),
            *(_recall(data["figures"][n]["kinds"][kind]["headline"]) for n in names),
        ]
        for kind, own in ours["kinds"].items()
        if own["headline"]
    ]
    titles = [data["detectors"][n] for n in names]
    cells = "recall, 95 % (median latency, ms)"
    tables = [
        Table(
            f"By kind of stream, counted rows; `graze`: grazing touches; {cells}",
            ["kind", "touches", *titles],
            by_kind,
        ),
        Table(f"By row of the score; {cells}", ["row", "touches", *titles], by_row),
        Table(f"The headline by kind of stream; {cells}", ["kind", "touches", *titles], headline),
    ]
    for key, what in (("misses", "Headline touches"), ("slow_misses", SLOW_FAST.capitalize())):
        if ours[key]:
            tables.append(_missed(f"{what} that the default missed", ours[key]))
    found = losses(data)
    return Section(
        "Approaches and grounds",
        "Descents, level swings against a post (`hard forward`), approaches of 2 to 10 cm/s "
        "(`hard slow`), ground of three stiffnesses (N/m), and grazing. Slow and soft touches are "
        f"given 500 ms, the others 120 ms. Rows: {_ROWS_ARE}"
        + _unseen(ours)
        + sentence(found, ("rows", "kinds"), "rows and kinds"),
        tables,
        [],
    )


def _missed(title: str, misses: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        [
            m["leg_run"],
            m["kind"],
            number(m["t_s"], 2),
            number(m["speed_m_s"], 2),
            number(m["force_n"], 1),
            number(m["after_release_ms"], 0),
            ", ".join(m["found_by"]) or "none",
        ]
        for m in misses
    ]
    header = [
        "leg-run", "kind", "at s", "speed m/s", "force N", "ms after the last contact", "found by",
    ]  # fmt: skip
    return Table(title, header, rows)


def _unseen(default: Any) -> str:
    """What the missed touches have in common."""
    told = ""
    misses, slow = default["misses"], default["slow_misses"]
    if misses:
        by_none = sum(not m["found_by"] for m in misses)
        told += (
            f" Of the {len(misses)} headline touches missed that are listed, {by_none} are found "
            "by no detector at all, the one with the simulator's own equations included."
        )
    row, slips = default["summary"]["rows"].get(SLOW_FAST), default["slips"]
    if row:
        by_none = sum(not m["found_by"] for m in slow)
        told += (
            f" Of the {row['touches']} fast touches in slow approaches {row['found']} are found; "
            f"of the {len(slow)} missed that are listed {by_none} by no detector. {slips['soon']} "
            f"of the {slips['touches']} come within {number(slips['within_ms'], 0)} ms of the end "
            "of another contact: a foot that slips off an edge falls after a command that creeps, "
            "and meets the ground about where the command would have stopped it. It touches at "
            "speed, and nothing departs from the prediction."
        )
    return told


def _recall(figures: Any) -> str:
    if not figures or figures["recall"] is None:
        return "-"
    ends, median = interval(figures["interval"]), number(figures["median_ms"], 0)
    return f"{percent(figures['recall'])}, {ends} ({median})"


def _learned(data: Any) -> Section:
    known = data["learned"]
    residuals = []
    for role, models in data["residual_deg"].items():
        for model, values in models.items():
            worst = data["worst_leg_run"].get(role, {}).get(model)
            residuals.append(
                [
                    role,
                    model,
                    per_joint(values, 3),
                    "-" if worst is None else per_joint(worst["rms_deg"], 3),
                    "-" if worst is None else worst["leg_run"],
                ]
            )
    analytical = known["analytical"]
    channels = [
        [data["detectors"][name], " ".join(str(c) for c in used), percent(known["tuned"][name])]
        for name, used in known["channels"].items()
    ]
    gains = known["gains"]
    return Section(
        "What the detectors learned",
        "Lag of the tracking error: "
        f"{known['lag']} ticks. The analytical model's observer has gains "
        f"{per_joint(gains['angle'], 1)} (angle) and {per_joint(gains['speed'], 1)} (speed), "
        f"chosen on tuning streams: one-step RMS {per_joint(analytical['observer'], 3)}°, against "
        f"{per_joint(analytical['positions only'], 3)}° from the last two positions alone. "
        "`free` is hung up by the body, `stand` stands on five legs: how much the body's giving "
        "way matters. Residuals are of the models as they were fitted, which the default starts "
        "from and goes on learning.",
        [
            Table(
                "One-step residuals on free judged ticks, all leg-runs pooled, and the worst one",
                ["stream", "model", "RMS °", "worst leg-run °", "which"],
                residuals,
            ),
            Table(
                "Forms of the analytical model, one-step RMS on tuning streams",
                ["form", "RMS °", "compared as a detector"],
                [
                    ["tuned observer", per_joint(analytical["observer"], 3), "yes, the stronger"],
                    ["last two positions alone", per_joint(analytical["positions only"], 3), "no"],
                ],
            ),
            Table(
                "Channels used (joints 0 to 2, or windows), and recall on tuning collisions",
                ["detector", "channels", "recall"],
                channels,
            ),
        ],
        [],
    )


_LIMITED: Final = ("default", "servo ratio", "paper rule", "analytical ratio", "tracking")


def limits_section(data: Any) -> Section:
    """Recall against speed and force, and what a step of the servo is."""
    tables = []
    for field, label in (
        ("by_speed", "speed at touch, m/s (hard ground)"),
        ("by_force", "force, N"),
    ):
        rows = []
        for i, first in enumerate(data["figures"]["default"][field]):
            if not first["touches"]:
                continue
            cells = []
            for name in _LIMITED:
                b = data["figures"][name][field][i]
                cells.append(f"{percent(b['recall'])} ({interval(b['interval'])})")
            end = "and more" if first["high"] is None else f"to {first['high']:g}"
            rows.append([f"{first['low']:g} {end}", str(first["touches"]), *cells])
        tables.append(
            Table(
                f"Recall (95 %) by {label}",
                ["range", "touches", *(data["detectors"][n] for n in _LIMITED)],
                rows,
            )
        )
    limits = data["limits"]
    steps, period = limits["step_m"], limits["period_s"]
    moved = ", ".join(f"{1e3 * v:.2f} mm of the {joint}" for joint, v in steps.items())
    slowest, fastest = (f(steps.values()) / period for f in (min, max))
    mid = data["figures"]["default"]["mid"]
    text = (
        f"A servo step is {math.degrees(limits['step_rad']):.3f}°: at a stretched leg's foot "
        f"{moved}. "
        "What moves the leg by less than that within the window cannot be seen in positions: a "
        f"foot that is stopped falls a step behind within one tick from {slowest:.3f} (tibia) to "
        f"{fastest:.3f} m/s (coxa) on, within the longest window, three ticks, from "
        f"{slowest / 3:.3f} to {fastest / 3:.3f} m/s (shaded). Against the servo's drive a step "
        f"takes {min(limits['step_n'].values()):.2f} to {max(limits['step_n'].values()):.2f} N "
        "there, below the weakest touches counted. Fast touches in slow approaches are left out, "
        "as in the headline. **The dip from 0.1 to 0.2 m/s** is that of the time allowed: 120 ms, "
        "where touches at 0.1 m/s and less are given 500."
    )
    if mid["missed"]:
        text += (
            f" Of the {mid['missed']} the default missed there, {mid['late']} are told after all "
            "within 500 ms."
        )
    text += sentence(losses(data), ("speed", "force"), "bins of speed and force")
    return Section("Where the limits are", text, tables, ["paper-limits"])


def alarms_section(data: Any) -> Section:
    """False alarms on streams with contacts, which are no free motion."""
    names = list(data["detectors"])
    kinds = data["figures"]["default"]["kinds"]
    rows = [
        [
            kind,
            number(own["alarms"]["hours"], 3),
            *(_alarm_cell(data["figures"][n]["kinds"][kind]["alarms"]) for n in names),
        ]
        for kind, own in kinds.items()
    ]
    whole = [data["figures"][n]["false_alarms"]["touch"] for n in names]
    rows.append(["all", number(whole[0]["hours"], 3), *(_alarm_cell(w) for w in whole)])
    ours = data["figures"]["default"]
    are = ours["alarms_are"]
    total = ours["false_alarms"]["touch"]["count"]
    text = (
        "In streams with contacts every alarm that is no touch's detection counts as false. The "
        f"default raised {total}: {are['again']} again after a touch it had told (the foot slips, "
        f"bounces or is pulled free), {are['late']} later after a touch than it is given, "
        f"{are['early']} before the first touch of the swing, {are['untouched']} in swings without "
        "any touch. Precision counts them; the rate per robot-hour of the numbers asked for is of "
        "free motion, and not these."
    )
    return Section(
        "False alarms among contacts",
        text,
        [
            Table(
                "False alarms on streams with contacts, count (per robot-hour), by kind",
                ["kind", "robot-hours", *(data["detectors"][n] for n in names)],
                rows,
            )
        ],
        [],
    )


def _alarm_cell(rate: Mapping[str, Any]) -> str:
    return f"{rate['count']} ({number(rate['per_hour'], 0)})"
