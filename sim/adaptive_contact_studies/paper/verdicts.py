"""What was asked for and is reached, and where the default detector does not win, row by row.

A detector is better at something if its figure is better, by however little; whether the 95 %
intervals lie apart is said beside it, and so are its headline recall and its false alarms, as a
detector that is always alarmed finds everything.  One that finds less than half of the headline is
not compared in latency, precision and false alarms: silence is quick, precise and quiet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

from adaptive_contact_studies.paper.rows import noise_floor
from adaptive_contact_studies.show.numbers import (
    general,
    number,
    per_joint,
    percent,
    scientific,
    thousands,
)

DEFAULT: Final = "default"
# Rows of 5,000 segments, on which the speed is asked for.
_ASKED_ROWS: Final = 45_000
# Who finds less than this share of the headline is not asked how early, how precise or how quiet.
HALF: Final = 0.5


class Loss(NamedTuple):
    """Something at which another detector is better than the default."""

    section: str  # of the report: `headline`, `rows`, `kinds`, `speed` or `force`
    what: str  # the figure
    ours: str  # the default's
    theirs: str  # the best one's
    best: str  # its name
    others: int  # how many more are better than the default
    apart: bool | None  # whether the intervals lie apart; None where there are none

    @property
    def short(self) -> str:
        """The figure, without its name where it is a recall."""
        return self.what.removeprefix("recall, ")


def losses(data: Mapping[str, Any]) -> list[Loss]:
    """All that another detector does better, in the order of the report."""
    figures = data["figures"]
    ours = figures[DEFAULT]
    found = [
        _shares(data, "headline", "headline recall", _headline),
        _lower(data, "median latency", lambda f: _headline(f)["median_ms"], " ms"),
        _lower(data, "p95 latency", lambda f: _headline(f)["p95_ms"], " ms"),
        _lower(data, "p99 latency", lambda f: _headline(f)["p99_ms"], " ms"),
        _shares(data, "headline", "precision", _precision),
        _lower(
            data,
            "false alarms in free motion",
            lambda f: f["false_alarms"]["all"]["per_hour"],
            "",
            lambda f: f["false_alarms"]["all"]["interval"],
        ),
    ]
    for row in ours["summary"]["rows"]:
        if row != "headline":
            of = partial(_part, ("summary", "rows", row))
            found.append(_shares(data, "rows", f"recall, row `{row}`", of))
    for kind in ours["kinds"]:
        of = partial(_part, ("kinds", kind))
        found.append(_shares(data, "kinds", f"recall, streams `{kind}`", of))
    for section, field, unit in (("speed", "by_speed", "m/s"), ("force", "by_force", "N")):
        for i, own in enumerate(ours[field]):
            what = f"recall, {span(own)} {unit}"
            found.append(_shares(data, section, what, partial(_part, (field, i))))
    return [loss for loss in found if loss is not None]


def span(part: Mapping[str, Any]) -> str:
    """The range of speeds or forces that a part of the touches has."""
    end = "and more" if part["high"] is None else f"to {general(part['high'])}"
    return f"{general(part['low'])} {end}"


def _sees(figures: Mapping[str, Any]) -> bool:
    return (_headline(figures)["recall"] or 0.0) >= HALF


def _precision(figures: Mapping[str, Any]) -> Any:
    if not _sees(figures):
        return {}
    own = figures["summary"]
    return {"recall": own["precision"], "interval": own["precision_interval"]}


def _part(path: Sequence[Any], figures: Any) -> Any:
    """What stands under some names, one below the other; empty where one is not there."""
    for name in path:
        figures = figures[name] if isinstance(figures, list) else figures.get(name) or {}
    return figures


def _headline(figures: Mapping[str, Any]) -> Any:
    return figures["summary"]["rows"]["headline"]


def _shares(
    data: Mapping[str, Any], section: str, what: str, of: Callable[[Any], Any]
) -> Loss | None:
    """A share of which more is better."""
    rows = {name: of(figures) for name, figures in data["figures"].items()}
    own = rows[DEFAULT]
    if own.get("recall") is None:
        return None
    better = {
        name: row["recall"]
        for name, row in rows.items()
        if row.get("recall") is not None and row["recall"] > own["recall"]
    }
    if not better:
        return None
    best = max(better, key=lambda name: better[name])
    return Loss(
        section, what, percent(own["recall"]), percent(better[best]), best, len(better) - 1,
        rows[best]["interval"][0] > own["interval"][1],
    )  # fmt: skip


def _lower(
    data: Mapping[str, Any],
    what: str,
    of: Callable[[Any], float | None],
    unit: str,
    interval: Callable[[Any], Sequence[float | None]] | None = None,
) -> Loss | None:
    """A figure of which less is better."""
    values = {name: of(f) for name, f in data["figures"].items() if _sees(f)}
    own = values.get(DEFAULT)
    if own is None:
        return None
    better = {name: v for name, v in values.items() if v is not None and v < own}
    if not better:
        return None
    best = min(better, key=lambda name: better[name])
    apart = None
    if interval is not None:
        ours, theirs = (interval(data["figures"][name]) for name in (DEFAULT, best))
        if ours[0] is not None and theirs[1] is not None:
            apart = theirs[1] < ours[0]
    digits = 1 if unit else 2
    return Loss(
        "headline", what, number(own, digits) + unit, number(better[best], digits) + unit, best,
        len(better) - 1, apart,
    )  # fmt: skip


class Headline(NamedTuple):
    """One of the run's promises, and what was measured.

    ``kept`` is None where no figure is against it, but less was measured than was asked for.
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
                f"{number(sum(row['kept']) / len(row['kept']), 0)} of {row['terms']} terms kept, "
                f"{thousands(row['rows'])} rows",
                "≥ 20 × PySINDy's own on 5,000 segments, same support",
                f"{number(row['speed_up'], 0)} ×, "
                f"{'same' if row['same_support'] else 'another'} support, "
                f"largest difference {scientific(row['difference'])}",
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
