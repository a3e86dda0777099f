"""Where detection ends, and false alarms among contacts, as sections and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from adaptive_contact_studies.paper.verdicts import losses, sentence
from adaptive_contact_studies.show.tables import (
    Section,
    Table,
    interval,
    number,
    percent,
)

__all__ = ["alarms_section", "limits_section"]

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
