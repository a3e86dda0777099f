"""Recordings of real servos as a section with tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from adaptive_contact_sim.experiments.tables_format import (
    Section,
    Table,
    number,
    per_joint,
    skipped,
)

__all__ = ["logs_sections"]

_FORMATS: Final = (
    "`adaptive-contact experiment logs PATH` does the same for recordings of your own: `.npz` "
    "files with `MOTION/t` (s), `MOTION/goal` and `MOTION/pos` (rows, joints; rad) for every "
    "motion, or `.json` files with `kp`, `trajectory` and `entries`, each with `timestamp` (s), "
    "`goal_position`, `position` (rad) and `torque_enable`. The recordings used here are public: "
    "github.com/isaac-sim2real/sage (`output/real/so101`) and github.com/Rhoban/bam (branch xl330, "
    "`bam/data.bak/raw`)."
)


def logs_sections(data: Any) -> list[Section]:
    """Errors and false alarms on recordings of real servos."""
    if "skipped_stage" in data:
        return [Section("Real servos", f"Skipped: {data['skipped_stage']}.", [], [])]
    tables: list[Table] = []
    for arm in data["arms"]:
        rows = [["all", "naive", "-", per_joint(arm["naive_deg"], 3), "-"]]
        for protocol in ("unseen motions", "unseen moments"):
            part = arm[protocol]
            if "rms_deg" not in part:
                rows.append([protocol, "-", "-", part["status"], "-"])
                continue
            for name, rms in part["rms_deg"].items():
                terms = part["terms"][name]
                kept = sum(terms["kept"]) / len(terms["kept"])
                rows.append(
                    [
                        protocol,
                        name,
                        f"{number(kept, 0)} of {terms['size']}",
                        per_joint(rms, 3),
                        number(sum(rms) / len(rms), 3),
                    ]
                )
        tables.append(
            Table(
                f"Arm with {arm['joints']} servos, {arm['rows']:,} ticks, "
                f"{len(arm['motions'])} motions: one-step RMS",
                ["held out", "library", "terms per joint", "RMS °, joint by joint", "mean"],
                rows,
            )
        )
        alarms = [
            [
                protocol,
                str(arm[protocol]["false_alarms"]["events"]),
                f"{arm[protocol]['false_alarms']['ticks']:,}",
                number(arm[protocol]["false_alarms"]["expected"], 1),
                number(arm[protocol]["false_alarms"]["per_hour"], 1),
                arm[protocol]["false_alarms"]["reason"] or "",
            ]
            for protocol in ("unseen motions", "unseen moments")
            if "false_alarms" in arm[protocol]
        ]
        tables.append(
            Table(
                "False alarms of the servo law's likelihood ratio at an aim of 1 per hour",
                ["held out", "events", "ticks", "expected", "per robot-hour", "left out"],
                alarms,
            )
        )
    pendulum = data.get("pendulum")
    if pendulum:
        tables.append(_pendulum(pendulum))
    text = (
        f"{data['recordings']} recordings from `{data['path']}`. Nothing here was simulated. "
        "'Unseen motions' holds out whole kinds of motion, 'unseen moments' blocks of ten seconds."
        + skipped(data["skipped"])
        + " "
        + _FORMATS
    )
    return [Section("Real servos", text, tables, [])]


def _pendulum(data: Any) -> Table:
    gains = [f"{g:g}" for g in data["gains"]]
    rows: list[Sequence[str]] = [["naive", "-", *(number(data["naive_deg"][g], 3) for g in gains)]]
    for name, library in data["libraries"].items():
        for gain in gains:
            cells = [
                number(library["fixed_deg"][gain].get(g), 3) if g != gain else "(fitted)"
                for g in gains
            ]
            rows.append([name, f"fixed, of kp {gain}", *cells])
        cells = [number(library["refitted_deg"].get(g), 3) for g in gains]
        rows.append([name, "refitted, run held out", *cells])
    return Table(
        "One servo with a pendulum: RMS ° at each gain, of a model fixed at another and refitted",
        ["library", "model", *(f"kp {g}" for g in gains)],
        rows,
    )
