"""Where the default detector does not win, said row by row.

A detector is better at something if its figure is better, by however little; whether the 95 %
intervals lie apart is said beside it, and so are its headline recall and its false alarms, as a
detector that is always alarmed finds everything.  One that finds less than half of the headline is
not compared in latency, precision and false alarms: silence is quick, precise and quiet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

from adaptive_contact_studies.show.tables import Table, number, percent

__all__ = ["HALF", "Loss", "losses", "losses_table", "sentence"]

DEFAULT: Final = "default"
# Who finds less than this share of the headline is not asked how early, how precise or how quiet.
HALF: Final = 0.5


class Loss(NamedTuple):
    """Something at which another detector is better than the default.

    Attributes:
        section: of the report: ``headline``, ``rows``, ``kinds``, ``speed`` or ``force``.
        what: the figure.
        ours: the default's.
        theirs: the best one's.
        best: its name.
        others: how many more are better than the default.
        apart: whether the intervals lie apart; None where there are none.
    """

    section: str
    what: str
    ours: str
    theirs: str
    best: str
    others: int
    apart: bool | None


def losses(data: Mapping[str, Any]) -> list[Loss]:
    """All that another detector does better, in the order of the report.

    Args:
        data: the detection study's tree.
    """
    figures = data["figures"]
    ours = figures[DEFAULT]
    found = [
        _shares(data, "headline", "headline recall", lambda f: f["summary"]["rows"]["headline"]),
        _lower(data, "median latency", lambda f: _headline(f)["median_ms"], " ms"),
        _lower(data, "p95 latency", lambda f: _headline(f)["p95_ms"], " ms"),
        _lower(data, "p99 latency", lambda f: _headline(f)["p99_ms"], " ms"),
        _shares(
            data,
            "headline",
            "precision",
            _precision,
        ),
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
            found.append(_shares(data, "rows", f"recall, row `{row}`", partial(_row, row)))
    for kind in ours["kinds"]:
        found.append(_shares(data, "kinds", f"recall, streams `{kind}`", partial(_kind, kind)))
    for section, field, unit in (("speed", "by_speed", "m/s"), ("force", "by_force", "N")):
        for i, own in enumerate(ours[field]):
            end = "and more" if own["high"] is None else f"to {own['high']:g}"
            what = f"recall, {own['low']:g} {end} {unit}"
            found.append(_shares(data, section, what, partial(_bin, field, i)))
    return [loss for loss in found if loss is not None]


def losses_table(data: Mapping[str, Any], found: Sequence[Loss]) -> Table:
    """Every loss with the better detector's false alarms."""
    rows = []
    for loss in found:
        rate = data["figures"][loss.best]["false_alarms"]["all"]["per_hour"]
        rows.append(
            [
                loss.what,
                loss.ours,
                loss.theirs,
                data["detectors"][loss.best] + (f" (and {loss.others} more)" * bool(loss.others)),
                percent(data["figures"][loss.best]["summary"]["rows"]["headline"]["recall"]),
                "not counted" if rate is None else number(rate, 2),
                {True: "yes", False: "no", None: "-"}[loss.apart],
            ]
        )
    return Table(
        "Where the default does not win",
        [
            "figure",
            "default",
            "best",
            "of",
            "its headline recall",
            "its false alarms per hour",
            "intervals apart",
        ],
        rows,
    )


def sentence(found: Sequence[Loss], sections: Sequence[str], told: str) -> str:
    """What the default loses in some sections, in a sentence.

    Args:
        found: all losses.
        sections: which are told.
        told: what they are, such as ``rows``.
    """
    own = [loss for loss in found if loss.section in sections]
    if not own:
        return f" The default is the best in all {told}."
    clear = [loss for loss in own if loss.apart]
    names = "; ".join(loss.what.removeprefix("recall, ") for loss in own)
    said = f" **The default is not the best in {told}: {names}** (table below"
    if not clear:
        return said + "; nowhere are the 95 % intervals apart)."
    apart = "; ".join(loss.what.removeprefix("recall, ") for loss in clear)
    return said + f"; the 95 % intervals are apart in {apart})."


def _sees(figures: Mapping[str, Any]) -> bool:
    return (_headline(figures)["recall"] or 0.0) >= HALF


def _precision(figures: Mapping[str, Any]) -> Any:
    if not _sees(figures):
        return {}
    own = figures["summary"]
    return {"recall": own["precision"], "interval": own["precision_interval"]}


def _row(row: str, figures: Mapping[str, Any]) -> Any:
    return figures["summary"]["rows"].get(row) or {}


def _kind(kind: str, figures: Mapping[str, Any]) -> Any:
    return figures["kinds"].get(kind) or {}


def _bin(field: str, i: int, figures: Mapping[str, Any]) -> Any:
    return figures[field][i]


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
