"""Recordings of real servos as a section with tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from adaptive_contact_studies.show.tables import (
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
                rows.append([protocol, *_library_row(name, part, rms)])
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
        "'Unseen motions' holds out whole kinds of motion, 'unseen moments' blocks of ten seconds; "
        "a library that some fold has too few rows for has no model, and its status stands where "
        "the error would. "
        + " ".join([*map(_arm_verdict, data["arms"]), _pendulum_verdict(pendulum)]).strip()
        + skipped(data["skipped"])
        + " "
        + _FORMATS
    )
    return [Section("Real servos", text, tables, [])]


def _library_row(name: str, part: Mapping[str, Any], rms: Sequence[float] | None) -> list[str]:
    """Library, terms, errors joint by joint, their mean; the status where there is no model."""
    terms, status = part["terms"][name], part["status"][name]
    if rms is None:
        return [name, f"of {terms['size']}", status, "-"]
    kept = sum(terms["kept"]) / len(terms["kept"])
    shown = per_joint(rms, 3) + ("" if status == "ok" else f" ({status})")
    return [name, f"{number(kept, 0)} of {terms['size']}", shown, number(sum(rms) / len(rms), 3)]


def _arm_verdict(arm: Mapping[str, Any]) -> str:
    """Which library is best where, and whether that is the default's."""
    told = []
    for protocol in ("unseen motions", "unseen moments"):
        known = {
            name: sum(rms) / len(rms)
            for name, rms in (arm[protocol].get("rms_deg") or {}).items()
            if rms is not None
        }
        if "servo" not in known:
            continue
        best = min(known, key=lambda name: known[name])
        if best == "servo":
            told.append(f"on {protocol} it has the least error")
        else:
            told.append(
                f"**on {protocol} the {best} library is better "
                f"({number(known[best], 3)}° against {number(known['servo'], 3)}°)**"
            )
    for protocol in ("unseen motions", "unseen moments"):
        alarms = arm[protocol].get("false_alarms") or {}
        if alarms.get("per_hour") is not None and alarms["events"] > 1 + 3 * alarms["expected"]:
            told.append(
                f"**on {protocol} its likelihood ratio misses its aim of "
                f"{number(alarms['aim_per_hour'], 0)} false alarm per robot-hour "
                f"({number(alarms['per_hour'], 0)})**"
            )
    if not told:
        return ""
    return f"The default's library (servo) on the arm with {arm['joints']}: {'; '.join(told)}."


def _pendulum_verdict(data: Mapping[str, Any] | None) -> str:
    """At how many gains a fixed model loses, and where the default's library is not the best."""
    if not data:
        return ""
    gains = [f"{g:g}" for g in data["gains"]]
    own = data["libraries"]["servo"]["rms_deg"]
    ratios = [
        own[fitted][tried] / own[tried][tried]
        for fitted in gains
        for tried in gains
        if fitted != tried and own[fitted][tried] is not None and own[tried][tried]
    ]
    told = []
    if ratios:
        told.append(
            f"Pendulum, servo library: a model of another gain has {min(ratios):.2f} to "
            f"{max(ratios):.2f} times the error of one refitted at the gain it is tried at, the "
            f"same trajectory held out of both; it is the worse one in "
            f"{sum(r > 1.0 for r in ratios)} of {len(ratios)} pairs."
        )
    for gain in gains:
        known = {
            name: library["rms_deg"][gain][gain]
            for name, library in data["libraries"].items()
            if library["rms_deg"][gain][gain] is not None
        }
        best = min(known, key=lambda name: known[name], default="servo")
        if best != "servo" and "servo" in known:
            told.append(
                f"**At kp {gain}, refitted, the {best} library is better "
                f"({number(known[best], 3)}° against {number(known['servo'], 3)}°).**"
            )
    return " ".join(told)


def _pendulum(data: Mapping[str, Any]) -> Table:
    gains = [f"{g:g}" for g in data["gains"]]
    rows: list[Sequence[str]] = [["naive", "-", *(number(data["naive_deg"][g], 3) for g in gains)]]
    for name, library in data["libraries"].items():
        for fitted in gains:
            cells = []
            for tried in gains:
                value, status = library["rms_deg"][fitted][tried], library["status"][fitted][tried]
                cell = status if value is None else number(value, 3)
                cells.append(f"{cell} (refitted)" if fitted == tried else cell)
            rows.append([name, f"of kp {fitted}", *cells])
    return Table(
        "One servo with a pendulum: RMS ° of models of one gain tried at each, the trajectory that "
        "is tried held out of every model",
        ["library", "model", *(f"kp {g}" for g in gains)],
        rows,
    )
