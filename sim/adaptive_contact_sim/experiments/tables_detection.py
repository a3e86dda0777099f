"""The detection study as sections and tables."""

from __future__ import annotations

from typing import Any, Final

from adaptive_contact_sim.experiments.tables_format import (
    Section,
    Table,
    interval,
    number,
    per_joint,
    percent,
)

__all__ = ["detection_sections"]

_ROWS: Final = ("headline", "mid", "slow", "creep", "soft", "grazing", "lift", "late")


def detection_sections(data: Any) -> list[Section]:
    """All that the study found."""
    return [_main(data), _kinds(data), _limits(data), _learned(data)]


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
                "not counted"
                if alarms["count"] < 0
                else f"{alarms['count']} in {number(alarms['hours'], 2)} h",
                number(alarms["per_hour"], 2),
                "-"
                if alarms["interval"][0] is None
                else f"{number(alarms['interval'][0], 2)}–{number(alarms['interval'][1], 2)}",
            ]
        )
    default = data["figures"]["default"]["false_alarms"]
    hung, stood = default["free"], default["stand"]
    text = (
        f"{data['leg_runs']} leg-runs: legs of robots whose servos differ by 12 %, each with "
        "models of its own. Trained, tuned and reported on different seeds. Every threshold aims "
        f"at {number(data['aim_per_hour'], 0)} false alarm per robot-hour (540,000 swing "
        "leg-ticks), by a tail fitted to tuning streams; only the ROC curves sweep it. Free "
        f"streams: {number(hung['hours'], 2)} h hung up by the body, all six legs swinging "
        "(same code and constants, the body fixed), and "
        f"{number(stood['hours'], 2)} h standing on five legs; the "
        f"default raised {hung['count']} and {stood['count']} false alarms there. "
        "`not counted`: a threshold so low that more than 3 % of the ticks of some stream pass it."
    )
    header = [
        "detector", "found", "recall", "95 %", "median ms", "p95", "p99", "precision",
        "false alarms", "per hour", "95 %",
    ]  # fmt: skip
    better = [
        data["detectors"][name]
        for name, figures in data["figures"].items()
        if name != "default" and _beats(figures, data["figures"]["default"])
    ]
    text += (
        f" **Not worse than the default in recall and in false alarms: {', '.join(better)}.**"
        if better
        else " No other detector reaches the default's recall without more false alarms."
    )
    return Section(
        "Detection over the whole workspace",
        text,
        [Table("Hard ground, foot speed at touch ≥ 0.2 m/s (headline row)", header, rows)],
        ["paper-roc"],
    )


def _beats(figures: Any, default: Any) -> bool:
    """Whether a detector is at least as good in both, and better in one."""
    ours, theirs = (f["summary"]["rows"]["headline"]["recall"] or 0 for f in (default, figures))
    quiet, other = (f["false_alarms"]["all"]["count"] for f in (default, figures))
    if other < 0:
        return False
    return bool(theirs >= ours and other <= quiet and (theirs > ours or other < quiet))


def _kinds(data: Any) -> Section:
    names = list(data["detectors"])
    kinds = list(data["figures"]["default"]["kinds"])
    by_kind = [
        [
            kind,
            str(data["figures"]["default"]["kinds"][kind]["touches"]),
            *(_recall(data["figures"][n]["kinds"][kind]) for n in names),
        ]
        for kind in kinds
    ]
    present = [r for r in _ROWS if r in data["figures"]["default"]["summary"]["rows"]]
    by_row = [
        [
            row,
            str(data["figures"]["default"]["summary"]["rows"][row]["touches"]),
            *(_recall(data["figures"][n]["summary"]["rows"].get(row)) for n in names),
        ]
        for row in present
    ]
    titles = [data["detectors"][n] for n in names]
    misses = [
        [
            m["leg_run"],
            m["kind"],
            number(m["t_s"], 2),
            number(m["speed_m_s"], 2),
            number(m["force_n"], 1),
            number(m["after_release_ms"], 0),
            ", ".join(m["found_by"]) or "none",
        ]
        for m in data["figures"]["default"]["misses"]
    ]
    headline = [
        [
            kind,
            str(own["touches"]),
            *(_recall(data["figures"][n]["headline_kinds"].get(kind)) for n in names),
        ]
        for kind, own in data["figures"]["default"]["headline_kinds"].items()
    ]
    tables = [
        Table(
            "Recall (median latency, ms) by kind of stream; counted rows, `graze`: grazing touches",
            ["kind", "touches", *titles],
            by_kind,
        ),
        Table("Recall by row of the score", ["row", "touches", *titles], by_row),
        Table("The headline row by kind of stream", ["kind", "touches", *titles], headline),
    ]
    if misses:
        tables.append(
            Table(
                "Headline touches that the default missed",
                [
                    "leg-run",
                    "kind",
                    "at s",
                    "speed m/s",
                    "force N",
                    "ms after the last contact",
                    "found by",
                ],
                misses,
            )
        )
    return Section(
        "Approaches and grounds",
        "Descents, level swings against a post (`hard forward`), approaches of 2 to 10 cm/s "
        "(`hard slow`), ground of three stiffnesses (N/m), and grazing. Slow and soft touches are "
        "given 500 ms, the others 120 ms." + _unseen(data["figures"]["default"]),
        tables,
        [],
    )


def _unseen(default: Any) -> str:
    """What the missed headline touches have in common."""
    misses, slow = default["misses"], default["headline_kinds"].get("hard slow")
    if not misses or not slow:
        return ""
    by_none = sum(not m["found_by"] for m in misses)
    others = sum(own["touches"] for own in default["headline_kinds"].values()) - slow["touches"]
    found = sum(own["found"] for own in default["headline_kinds"].values()) - slow["found"]
    return (
        f" Of the {len(misses)} headline touches missed that are listed, {by_none} are found by no "
        "detector at all, the one with the simulator's own equations included, and "
        f"{slow['touches'] - slow['found']} lie in slow approaches: there a foot that slips off "
        "an edge falls after a command that creeps at 2 to 10 cm/s, and meets the ground about "
        "where the command would have stopped it. It touches at speed, and nothing departs from "
        f"the prediction. Without slow approaches the row has {found} of {others} "
        f"({percent(found / others)})."
    )


def _recall(figures: Any) -> str:
    if not figures or figures["recall"] is None:
        return "-"
    return f"{percent(figures['recall'])} ({number(figures['median_ms'], 0)})"


def _limits(data: Any) -> Section:
    shown = ("default", "servo ratio", "paper rule", "analytical ratio", "tracking")
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
            for name in shown:
                b = data["figures"][name][field][i]
                cells.append(f"{percent(b['recall'])} ({interval(b['interval'])})")
            rows.append([f"{first['low']:g} to {first['high']:g}", str(first["touches"]), *cells])
        tables.append(
            Table(
                f"Recall (95 %) by {label}",
                ["range", "touches", *(data["detectors"][n] for n in shown)],
                rows,
            )
        )
    return Section(
        "Where the limits are",
        "A servo step is 0.293°, about 0.7 mm at a stretched leg's foot: what moves the leg by "
        "less than that within the window cannot be seen in positions.",
        tables,
        ["paper-limits"],
    )


def _learned(data: Any) -> Section:
    known = data["learned"]
    residuals = [
        [role, model, per_joint(values, 3)]
        for role, models in data["residual_deg"].items()
        for model, values in models.items()
    ]
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
        "way matters.",
        [
            Table(
                "One-step residuals on free judged ticks", ["stream", "model", "RMS °"], residuals
            ),
            Table(
                "Channels used (joints 0 to 2, or windows), and recall on tuning collisions",
                ["detector", "channels", "recall"],
                channels,
            ),
        ],
        [],
    )
