"""What a run found, as sections of text, tables and figures: one source for page and document.

Nothing here is a number of its own: every figure is read from the results' tree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from adaptive_contact_sim.experiments.rows import noise_floor
from adaptive_contact_sim.experiments.tables_detection import detection_sections
from adaptive_contact_sim.experiments.tables_format import (
    Section,
    Table,
    number,
    per_joint,
    percent,
)
from adaptive_contact_sim.experiments.tables_logs import logs_sections

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
                "recall, hard ground, ≥ 0.2 m/s, whole workspace",
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
            _over_floor("whole workspace, swings of every leg-run", _whole_over_floor(found)),
        ]
    identified = results.get("identification")
    if identified:
        servo = next(s for s in identified["selection"] if s["library"] == "servo")
        point = next((p for p in servo["points"] if p["lambda"] == servo["picked"]), None)
        if point is not None:
            lines.append(_over_floor("the paper's test segments", point["over_floor"]))
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
        f"one-step RMS of the default's model over the noise floor, {where}",
        "≤ 1.5 ×",
        f"{per_joint(over)} ×",
        max(over) <= 1.5,
    )


def _whole_over_floor(found: Mapping[str, Any]) -> list[float]:
    """Of the servo law's models on the report's free swings, standing."""
    floor = math.degrees(noise_floor())
    return [v / floor for v in found["residual_deg"]["stand"]["servo"]]


def sections(results: Mapping[str, Any]) -> list[Section]:
    """Every section whose stage ran."""
    makers = (
        ("dataset", _dataset),
        ("identification", _identification),
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
        found.append(_workspace(results["workspace"]))
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


def _identification(data: Any) -> list[Section]:
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
                sweeps.append([title, label, "-", "not reached", *["-"] * 6])
                continue
            sweeps.append(
                [
                    title,
                    f"{label}"
                    if label != "picked"
                    else f"picked, λ = {number(point['lambda'], 4)}",
                    " ".join(str(n) for n in point["terms"][:3]),
                    point["status"],
                    number(point["test"]["position"], 5),
                    number(point["test"]["velocity"], 4),
                    number(point["test"].get("acceleration"), 3),
                    per_joint(point["test"]["over_floor"]),
                    per_joint(point["sensitivity"], 3),
                    per_joint(point["condition"], 0, scientific=True),
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
        f"{per_joint(data['reading_noise_deg'], 4)}°. `picked` is the sparsest λ whose error on "
        "held-out swings of the training set is within 0.5 % of the best."
    )
    header = [
        "convention", "λ", "terms", "status", "R² position", "velocity", "acceleration",
        "RMS / floor", "sensitivity to u[k]", "condition",
    ]  # fmt: skip
    selection = [
        [
            s["library"],
            number(p["lambda"], 2) + (" *" if p["lambda"] == s["picked"] else ""),
            " ".join(str(n) for n in p["terms"]) + f" of {s['size']}",
            per_joint(p["held_out_rms"], 3) if p["held_out_rms"] else p["status"],
            per_joint(p["test_rms_deg"], 3),
            per_joint(p["over_floor"]),
            per_joint(p["sensitivity"], 3),
        ]
        for s in data["selection"]
        for p in s["points"]
    ]
    windows = [
        [
            w["library"],
            " ".join(str(n) for n in w["window"]),
            str(w["terms"]),
            "-" if w["condition"] is None else f"{w['condition']:.0e}",
            per_joint(w["test_rms_deg"], 3),
            per_joint(w["over_floor"]),
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
            "residual, chosen on held-out swings (*): a term stays if it moves the prediction "
            "by more than λ times the residual. The servo's saturating control law is what the "
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


def _collisions(data: Any) -> list[Section]:
    rows = [
        [
            str(i + 1) + (" (drawn)" if i == data["drawn"] else ""),
            number(r["speed_m_s"], 2),
            number(r["force_n"], 1),
            "missed" if r["paper_ms"] is None else number(r["paper_ms"], 0),
            "missed" if r["default_ms"] is None else number(r["default_ms"], 0),
        ]
        for i, r in enumerate(data["table"])
    ]
    return [
        Section(
            "Ten collisions (4.3)",
            "Leg rf onto a plate within the paper's subspaces. The paper's rule has its "
            "threshold at the largest value on the free test segments "
            f"({per_joint(data['limit_deg'])}°); latencies are from the true touch to the deciding "
            "sample.",
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


def _workspace(data: Any) -> Section:
    rows = []
    verdicts = []
    for name, library in data["libraries"].items():
        for what, rms in library["rms_deg"].items():
            over = [v / data["floor_deg"] for v in rms]
            rows.append([name, what, per_joint(rms, 3), per_joint(over)])
        one, several = (sum(library["rms_deg"][key]) for key in ("one model", "one per region"))
        unseen, near = (
            sum(library["rms_deg"][key])
            for key in (
                "region unseen, one model of the others",
                "region unseen, nearest region's model",
            )
        )
        verdicts.append(
            f"{name} library: {'one model' if one <= several else 'one model per region'} wins "
            f"where all regions were seen ({number(min(one, several) / 3, 3)}° against "
            f"{number(max(one, several) / 3, 3)}°, mean of joints), "
            f"{'one model of the others' if unseen <= near else 'the nearest model'} where a "
            f"region was not ({number(min(unseen, near) / 3, 3)}° against "
            f"{number(max(unseen, near) / 3, 3)}°)"
        )
    return Section(
        "The whole workspace: one model or several",
        "Eight regions by the medians of yaw, reach and height; residuals on free streams with "
        f"other seeds. {'; '.join(verdicts)}.",
        [Table("Held-out RMS", ["library", "model", "RMS °", "/ floor"], rows)],
        ["paper-residual-map"],
    )
