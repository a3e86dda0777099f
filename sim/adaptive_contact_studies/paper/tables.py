"""What a run found, as sections of text, tables and figures: one source for page and document.

Nothing here is a number of its own: every figure is read from the results' tree.

Recordings of real servos as a section with tables.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from adaptive_contact_studies.paper.rows import noise_floor
from adaptive_contact_studies.paper.tables_detection import detection_sections
from adaptive_contact_studies.paper.tables_identification import (
    identification_sections,
    workspace_section,
)
from adaptive_contact_studies.show.tables import (
    Section,
    Table,
    number,
    per_joint,
    percent,
    skipped,
)

__all__ = ["Headline", "headline", "sections"]

# Rows of 5,000 segments, on which the speed is asked for.
_ASKED_ROWS: Final = 45_000


class Headline(NamedTuple):
    """One of the run's promises, and what was measured.

    ``kept`` is None where nothing speaks against it, but less was measured than was asked for.
    """

    what: str
    wanted: str
    measured: str
    kept: bool | None


def headline(results: Mapping[str, Any]) -> list[Headline]:
    """The numbers asked for, with what was measured, of the stages that ran."""
    lines: list[Headline] = []
    found = results.get("detection")
    if found:
        default = found["figures"]["default"]
        row = default["summary"]["rows"]["headline"]
        alarms = default["false_alarms"]["all"]
        low, high = row["interval"]
        lines += [
            Headline(
                "recall, hard ground, ≥ 0.2 m/s, whole workspace (slow approaches: rows of their "
                "own)",
                "≥ 99 % of ≥ 1,000",
                f"{percent(row['recall'])} of {row['touches']} "
                f"(95 % {percent(low)} to {percent(high)})",
                _verdict(row["recall"], 0.99, row["touches"] >= 1000, at_least=True),
            ),
            Headline(
                "latency of those",
                "median ≤ 20 ms, p95 ≤ 40 ms",
                f"median {number(row['median_ms'], 1)} ms, p95 {number(row['p95_ms'], 1)} ms",
                None
                if row["median_ms"] is None
                else _verdict(
                    max(row["median_ms"] / 20.0, row["p95_ms"] / 40.0), 1.0, row["touches"] >= 1000
                ),
            ),
            Headline(
                "false alarms per robot-hour",
                "≤ 5 over ≥ 10 h",
                f"{number(alarms['per_hour'], 2)} "
                f"(95 % {number(alarms['interval'][0], 2)} to {number(alarms['interval'][1], 2)}) "
                f"over {number(alarms['hours'], 1)} h",
                _verdict(alarms["per_hour"], 5.0, alarms["hours"] >= 10.0),
            ),
            *_whole_over_floor(found),
        ]
    identified = results.get("identification")
    if identified:
        servo = next(s for s in identified["selection"] if s["library"] == "servo")
        point = next((p for p in servo["points"] if p["lambda"] == servo["picked"]), None)
        if point is not None:
            lines.append(
                _over_floor(
                    "model of the default's library, the paper's test segments", point["over_floor"]
                )
            )
    for row in results.get("compression") or ():
        lines.append(
            Headline(
                f"refit with the factor held, {row['library']} library, "
                f"{sum(row['kept']) / len(row['kept']):.0f} of {row['terms']} terms kept, "
                f"{row['rows']:,} rows",
                "≥ 20 × PySINDy's own on 5,000 segments, same support",
                f"{number(row['speed_up'], 0)} ×, "
                f"{'same' if row['same_support'] else 'another'} support, "
                f"largest difference {row['difference']:.1e}",
                _speed_verdict(row),
            )
        )
    return lines


def _verdict(
    value: float | None, limit: float, enough: bool, *, at_least: bool = False
) -> bool | None:
    """No where the limit is broken, yes where it is kept and enough was measured, else None."""
    if value is None:
        return None
    kept = value >= limit if at_least else value <= limit
    return (True if enough else None) if kept else False


def _speed_verdict(row: Mapping[str, Any]) -> bool | None:
    if not row["same_support"] or row["difference"] > 1e-8:
        return False
    # Fewer rows are slower to gain on: nothing is said of 5,000 segments by less.
    enough = row["rows"] >= _ASKED_ROWS
    return _verdict(row["speed_up"], 20.0, True, at_least=True) if enough else None


def _over_floor(where: str, over: Sequence[float]) -> Headline:
    return Headline(
        f"one-step RMS over the noise floor, {where}",
        "≤ 1.5 ×",
        f"{per_joint(over)} ×",
        max(over) <= 1.5,
    )


def _whole_over_floor(found: Mapping[str, Any]) -> list[Headline]:
    """Of the servo law's models as fitted, on the report's free swings, standing."""
    floor = math.degrees(noise_floor())
    what = "servo law's models as fitted (the default starts from such), standing, judged ticks"
    pooled = [v / floor for v in found["residual_deg"]["stand"]["servo"]]
    worst = found["worst_leg_run"]["stand"]["servo"]
    own = [v / floor for v in worst["rms_deg"]]
    return [
        _over_floor(f"{what}, all leg-runs pooled", pooled),
        _over_floor(f"{what}, the worst leg-run ({worst['leg_run']})", own),
    ]


def sections(results: Mapping[str, Any]) -> list[Section]:
    """Every section whose stage ran."""
    makers = (
        ("dataset", _dataset),
        ("identification", identification_sections),
        ("compression", _compression),
        ("collisions", _collisions),
    )
    found: list[Section] = []
    for name, make in makers:
        if results.get(name):
            found += make(results[name])
    if results.get("detection"):
        found += detection_sections(results["detection"])
    if results.get("workspace"):
        found.append(workspace_section(results["workspace"]))
    if results.get("logs"):
        found += logs_sections(results["logs"])
    return found


def _dataset(data: Any) -> list[Section]:
    train, test = data["segments"]
    return [
        Section(
            "Data (4.1)",
            f"{train:,} training and {test:,} test segments of 10 steps at 50 Hz between random "
            f"points of two subspaces 5 cm high and 5 cm apart, leg {data['leg']} free, the other "
            f"five standing; {sum(data['ticks']):,} ticks, {data['touches']} touches of the free "
            "leg.",
            [],
            ["paper-workspace"],
        )
    ]


def _compression(data: Any) -> list[Section]:
    rows = [
        [
            r["library"],
            f"{r['terms']}",
            f"{r['rows']:,}",
            number(r["threshold"], 2),
            " ".join(str(n) for n in r["kept"]),
            number(r["raw_s"], 2),
            number(1e3 * r["compressed_s"], 1),
            number(r["speed_up"], 0),
            number(r["factor_s"], 2),
            number(r["library_s"], 2),
            "yes" if r["same_support"] else "no",
            f"{r['difference']:.1e}",
        ]
        for r in data
    ]
    header = [
        "library", "terms", "rows", "λ", "kept", "PySINDy s", "factor held ms", "×", "building s",
        "Θ s", "same support", "difference",
    ]  # fmt: skip
    return [
        Section(
            "Compressed regression",
            "The same STLSQ fit from the triangle of the QR factorisation and from the raw rows, "
            "CPU time of one core; λ in units of the residual. `building` is the factor's, once, "
            "and Θ's evaluation is what both need; `difference` is the largest of any "
            "coefficient, in raw units. `adaptive-contact bench` measures the same.",
            [Table("Both fits of the training segments", header, rows)],
            [],
        )
    ]


def _decided(row: Mapping[str, Any], status: Mapping[str, str | None], name: str) -> str:
    """A detector's latency at a collision; without a model there is no miss."""
    if status[name] is not None:
        return "no model"
    return "missed" if row[f"{name}_ms"] is None else number(row[f"{name}_ms"], 0)


def _found_of(data: Any) -> str:
    """Which of both found how many, and how soon; which is better."""
    told = []
    for name, title in (("paper", "the paper's rule"), ("default", "the default")):
        if data["status"][name] is None:
            known = sorted(r[f"{name}_ms"] for r in data["table"] if r[f"{name}_ms"] is not None)
            median = f", median {statistics.median(known):.0f} ms" if known else ""
            told.append(f"{title} found {len(known)} of {len(data['table'])}{median}")
    return f"{'; '.join(told)}.".capitalize() if told else ""


def _collisions(data: Any) -> list[Section]:
    rows = [
        [
            str(i + 1) + (" (drawn)" if i == data["drawn"] else ""),
            number(r["speed_m_s"], 2),
            number(r["force_n"], 1),
            *(_decided(r, data["status"], name) for name in ("paper", "default")),
        ]
        for i, r in enumerate(data["table"])
    ]
    return [
        Section(
            "Ten collisions (4.3)",
            "Leg rf onto a plate within the paper's subspaces. The paper's rule has its "
            "threshold at the largest value on the free test segments "
            f"({per_joint(data['limit_deg'])}°); latencies are from the true touch to the deciding "
            "sample. "
            + _found_of(data)
            + "".join(
                f" **No model of the {named}: {data['status'][name]}.**"
                for name, named in (("paper", "paper's rule"), ("default", "default"))
                if data["status"][name] is not None
            ),
            [
                Table(
                    "The collisions",
                    ["collision", "speed m/s", "force N", "paper's rule ms", "default ms"],
                    rows,
                )
            ],
            ["paper-collision"],
        )
    ]


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
