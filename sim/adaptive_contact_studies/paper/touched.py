"""Streams with contacts, what every detector says of them, and which touches make the headline.

A slow approach (2 to 10 cm/s) has a row of its own.  What is touched at speed in such a stream is
mostly touched by a foot that slipped off an edge (:func:`slips` counts them): it falls after a
command that creeps, and meets the ground about where the command would have stopped it.  Those
touches are no headline; they are shown in a row of their own, and together with the headline in
another.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.robot import shipped_robot
from adaptive_contact.score import (
    ROWS,
    Events,
    LegOutcome,
    LegStream,
    Row,
    RowFigures,
    Summary,
    clopper_pearson,
    find_swings,
    match,
    summarise,
)
from adaptive_contact.score.matching import LONG_WINDOW_NS, WINDOW_NS
from adaptive_contact_studies.cache import Store
from adaptive_contact_studies.evaluate import leg_stream
from adaptive_contact_studies.paper.comparison_rules import alarms
from adaptive_contact_studies.paper.data import load
from adaptive_contact_studies.paper.detectors import DETECTORS
from adaptive_contact_studies.paper.evaluation import (
    AIMS,
    DEFAULT,
    ONLINE,
    aim_name,
    jobs_of,
    online_events,
    read_job,
)
from adaptive_contact_studies.paper.plan import Piece, Plan

# Kinds of streams in which the leg approaches slowly.
SLOW_KINDS: Final = ("hard slow",)
# Names of the rows that divide the score's own headline row.
SLOW_FAST: Final = "fast touches in slow approaches"
BOTH: Final = "headline and fast touches in slow approaches"
# A touch so soon after the end of another contact is that of a foot that slipped, ms: a leg that is
# lifted on purpose is in the air for longer.
SLIP_MS: Final = 300.0
_SHOWN_MISSES: Final = 60


class Touched(NamedTuple):
    """A stream with contacts, and what every detector says of it."""

    piece: Piece  # what was simulated
    truth: LegStream  # as the score takes it
    swing: Ints  # (n,) number of the swing
    descending: Mask  # (n,) the command in force is past the lift
    # by compared detector, (n,) statistic over the threshold of the target rate
    scores: dict[str, Array]
    events: dict[str, Events]  # by learner, at the product's target rate and at others


def touched_streams(store: Store, root: Path, plan: Plan) -> list[Touched]:
    """All streams with contacts, evaluated."""
    robot = shipped_robot()
    names = (*ONLINE, *(aim_name(aim) for aim in AIMS))
    found = []
    for job in jobs_of(root, plan, plan.pieces("touch")):
        result = read_job(job)
        for index, piece in enumerate(job.pieces):
            stream = load(store, piece)
            online = {name: online_events(result, index, name) for name in names}
            found.append(
                Touched(
                    piece,
                    leg_stream(stream.run, stream.leg, robot),
                    find_swings(stream.run.t_ns, stream.swing).of_tick,
                    result[f"{index}/descending"],
                    {n: result[f"{index}/score/{n}"].astype(np.float64) for n in DETECTORS},
                    {name: events for name, events in online.items() if events is not None},
                )
            )
    return found


def outcome_of(touched: Touched, name: str, factor: float = 1.0) -> LegOutcome:
    """A detector's events against the truth."""
    events = touched.events.get(name)
    if events is None:
        truth, score = touched.truth, touched.scores[name]
        events = alarms(truth.t_ns, score, touched.swing, factor, touched.descending)
    return match(touched.truth, events)


def headline_streams(touched: Sequence[Touched]) -> list[Touched]:
    """The streams whose fast touches on hard ground are the headline."""
    return [t for t in touched if t.piece.kind not in SLOW_KINDS]


def rows_of(touched: Sequence[Touched], outcomes: Sequence[LegOutcome]) -> dict[str, Any]:
    """Figures of every row, the headline first; the score's own headline row is divided."""
    slow = [t.piece.kind in SLOW_KINDS for t in touched]
    whole = summarise(outcomes).rows
    headline, fast = (
        summarise([o for o, s in zip(outcomes, slow, strict=True) if s is which]).rows[Row.HEADLINE]
        for which in (False, True)
    )
    rows = {Row.HEADLINE.value: row_figures(headline)}
    if fast.touches:
        rows[SLOW_FAST] = row_figures(fast)
        rows[BOTH] = row_figures(whole[Row.HEADLINE])
    return rows | {
        row.value: row_figures(figures) for row, figures in whole.items() if row is not Row.HEADLINE
    }


def row_figures(figures: RowFigures) -> dict[str, Any]:
    """What tables show of a row."""
    latency = figures.latency
    return {
        "touches": figures.touches,
        "found": figures.found,
        "recall": figures.recall,
        "interval": list(figures.interval),
        "median_ms": latency.median_ms if latency else None,
        "p95_ms": latency.p95_ms if latency else None,
        "p99_ms": latency.p99_ms if latency else None,
        "onset_error_ms": figures.onset_error_ms,
    }


def by_kind(
    touched: Sequence[Touched], outcomes: Sequence[LegOutcome]
) -> dict[str, dict[str, Any]]:
    """By kind of stream: recall of its counted touches (grazing ones of ``graze``), false alarms.

    ``headline`` is that of the kind's headline touches, None where it has none.
    """
    found: dict[str, dict[str, Any]] = {}
    for kind in dict.fromkeys(t.piece.kind for t in touched):
        own = summarise([o for o, t in zip(outcomes, touched, strict=True) if t.piece.kind == kind])
        fast = own.rows[Row.HEADLINE]
        headline = fast.touches > 0 and kind not in SLOW_KINDS
        found[kind] = {
            **row_figures(_counted(own, kind)),
            "headline": row_figures(fast) if headline else None,
            "false_alarms": own.false_alarms,
            "judged_ticks": own.judged_ticks,
        }
    return found


def _counted(summary: Summary, kind: str) -> RowFigures:
    figures = summary.rows.get(Row.GRAZING) if kind == "graze" else None
    return figures or summary.counted


def binned(
    touched: Sequence[Touched],
    outcomes: Sequence[LegOutcome],
    field: str,
    edges: Sequence[float],
    without: tuple[Row, ...],
) -> list[dict[str, Any]]:
    """Recall by a property of the touch.

    Lift and late touches are never counted, nor fast ones in slow approaches, as in the headline.

    Args:
        touched: streams.
        outcomes: of one detector on each.
        field: of the table of touches.
        edges: of the bins; the last may be infinite.
        without: further rows that are left out.
    """
    left_out = [ROWS.index(row) for row in (*without, Row.LIFT, Row.LATE, Row.UNKNOWN)]
    headline = ROWS.index(Row.HEADLINE)
    tables = [o.touches for o in outcomes]
    value, found, row, latency = (
        np.concatenate([getattr(table, name) for table in tables])
        for name in (field, "found", "row", "latency_ns")
    )
    slow = np.concatenate(
        [
            np.full(len(table.row), t.piece.kind in SLOW_KINDS)
            for t, table in zip(touched, tables, strict=True)
        ]
    )
    use = ~np.isin(row, left_out) & ~(slow & (row == headline))
    bins = []
    for low, high in itertools.pairwise(edges):
        inside = use & (value >= low) & (value < high)
        hits, total = int(np.count_nonzero(found & inside)), int(np.count_nonzero(inside))
        median = float(np.median(latency[found & inside])) / 1e6 if hits else None
        bins.append(
            {
                "low": low,
                "high": high,
                "touches": total,
                "found": hits,
                "recall": hits / total if total else None,
                "interval": list(clopper_pearson(hits, total)),
                "median_ms": median,
            }
        )
    return bins


def misses(
    touched: Sequence[Touched], outcomes: dict[str, list[LegOutcome]], *, slow: bool
) -> list[dict[str, Any]]:
    """Fast touches on hard ground that the default missed, the first ones, and who found them."""
    headline = ROWS.index(Row.HEADLINE)
    found = []
    for number, (t, outcome) in enumerate(zip(touched, outcomes[DEFAULT], strict=True)):
        if (t.piece.kind in SLOW_KINDS) is not slow:
            continue
        table = outcome.touches
        for i in np.flatnonzero((table.row == headline) & ~table.found):
            # Touches are of the truth: the same in every detector's table.
            by = [n for n in outcomes if outcomes[n][number].touches.found[i]]
            found.append(
                {
                    "found_by": by,
                    "leg_run": t.piece.leg_run.name,
                    "kind": t.piece.kind,
                    "t_s": float(table.onset_ns[i] / 1e9),
                    "speed_m_s": float(table.speed_m_s[i]),
                    "force_n": float(table.force_n[i]),
                    "after_release_ms": _after_release(t.truth, int(table.onset_ns[i])),
                }
            )
    return found[:_SHOWN_MISSES]


def slips(touched: Sequence[Touched]) -> dict[str, int]:
    """Fast touches in slow approaches, and those soon after another contact ended: of a slip."""
    total = soon = 0
    for t in touched:
        table = match(t.truth, Events.of(())).touches
        for onset, row in zip(table.onset_ns, table.row, strict=True):
            if t.piece.kind in SLOW_KINDS and row == ROWS.index(Row.HEADLINE):
                after = _after_release(t.truth, int(onset))
                total += 1
                soon += after is not None and after <= SLIP_MS
    return {"touches": total, "soon": soon}


def _after_release(truth: LegStream, onset_ns: int) -> float | None:
    """How long before a touch the leg's last contact ended, ms; None for the first."""
    changes = truth.truth
    ended = changes.t_ns[~changes.contact & (changes.t_ns < onset_ns)]
    return float((onset_ns - ended[-1]) / 1e6) if len(ended) else None


def what_alarms_are(outcomes: Sequence[LegOutcome]) -> dict[str, int]:
    """False alarms on streams with contacts, by what else happened in their swing."""
    counts = dict.fromkeys(("again", "late", "early", "untouched"), 0)
    for outcome in outcomes:
        table = outcome.touches
        for when, swing in zip(outcome.alarms_ns, outcome.alarm_swing, strict=True):
            own = np.flatnonzero(table.swing == swing)
            before = own[table.onset_ns[own] < when]
            if not len(own):
                counts["untouched"] += 1
            elif not len(before):
                counts["early"] += 1
            else:
                counts["again" if table.found[before[-1]] else "late"] += 1
    return counts


def late_events(outcomes: Sequence[LegOutcome], row: Row) -> dict[str, int]:
    """Missed touches of a row, and those reported all the same until 500 ms."""
    missed = late = 0
    for outcome in outcomes:
        table = outcome.touches
        of_row = (table.row == ROWS.index(row)) & ~table.found
        missed += int(np.sum(of_row))
        in_time = (table.found_late_ns >= 0) & (table.found_late_ns <= LONG_WINDOW_NS)
        late += int(np.sum(of_row & in_time))
    return {"missed": missed, "late": late}


def peaks(touched: Sequence[Touched], name: str) -> list[float] | None:
    """Quantiles (5, 50, 95 %) of a compared detector's highest score within 120 ms of a touch.

    Of headline touches; None without any.
    """
    headline = ROWS.index(Row.HEADLINE)
    highest = []
    for t in headline_streams(touched):
        table = match(t.truth, Events.of(())).touches
        for onset, row in zip(table.onset_ns, table.row, strict=True):
            after = t.truth.t_ns - onset
            own = t.scores[name][(after > 0) & (after <= WINDOW_NS)]
            if row == headline and np.isfinite(own).any():
                highest.append(float(np.nanmax(own)))
    return [float(q) for q in np.quantile(highest, (0.05, 0.5, 0.95))] if highest else None
