r"""Computes the figures of a score: recall per row, latency, precision, false alarms, recovery.

Intervals of shares and rates are exact: Clopper and Pearson, *The use of confidence or fiducial
limits illustrated in the case of the binomial*, Biometrika 26 (1934), in terms of the incomplete
beta function; Garwood, *Fiducial limits for the Poisson distribution*, Biometrika 28 (1936), in
terms of the incomplete gamma function:

.. math::
    p_\text{low} = I^{-1}_{\alpha/2}(k, n-k+1), \quad p_\text{up} = I^{-1}_{1-\alpha/2}(k+1, n-k),
    \qquad
    \mu_\text{low} = P^{-1}_{\alpha/2}(k), \quad \mu_\text{up} = P^{-1}_{1-\alpha/2}(k+1).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import scipy
from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.score.outcome import ROWS, LegOutcome, Row, SwingTable, TouchTable

# scipy.stats would do the same and takes half a second to import.

CONFIDENCE: Final = 0.95


class Interval(NamedTuple):
    """Holds both ends of a confidence interval."""

    low: float
    high: float


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Compute the confidence interval of a share.

    Args:
        successes: 0 to ``trials``.
        trials: without any, the interval is 0 to 1: nothing is known.
        confidence: two-sided.
    """
    tail = (1.0 - confidence) / 2.0
    low = (
        scipy.special.betaincinv(successes, trials - successes + 1, tail) if successes > 0 else 0.0
    )
    high = (
        scipy.special.betaincinv(successes + 1, trials - successes, 1.0 - tail)
        if successes < trials
        else 1.0
    )
    return Interval(float(low), float(high))


def poisson_mean(count: int) -> Interval:
    """Compute the interval of the mean of a Poisson variable of which ``count`` was seen."""
    tail = (1.0 - CONFIDENCE) / 2.0
    low = scipy.special.gammaincinv(count, tail) if count > 0 else 0.0
    return Interval(float(low), float(scipy.special.gammaincinv(count + 1, 1.0 - tail)))


_NS_PER_MS: Final = 1e6


@dataclasses.dataclass(frozen=True, slots=True)
class Latency:
    """Holds the latency, ms: deciding sample minus true onset, over detected touches."""

    median_ms: float
    p95_ms: float
    p99_ms: float


@dataclasses.dataclass(frozen=True, slots=True)
class RowFigures:
    """Holds one row of the table."""

    touches: int  # how many there were
    found: int  # how many were detected
    found_late: int  # how many others were, after the window, while the foot still touched
    recall: float | None  # their share, None without touches
    interval: Interval  # 95 % Clopper-Pearson interval of the recall
    latency: Latency | None  # None where nothing was detected
    # median of estimated minus true onset, None where nothing was detected
    onset_error_ms: float | None


@dataclasses.dataclass(frozen=True, slots=True)
class AlarmFigures:
    """Holds the false alarms on some ticks."""

    false_alarms: int  # how many
    judged_ticks: int  # on so many ticks
    per_hour: float | None  # per robot-hour of 540,000 of them, None without ticks
    interval: Interval  # its 95 % Poisson interval; the upper end is infinite without ticks

    @classmethod
    def from_counts(cls, alarms: int, ticks: int) -> AlarmFigures:
        """Compute the figures from the counts."""
        if not ticks:
            return cls(alarms, ticks, None, Interval(0.0, np.inf))
        hours, mean = ticks / ROBOT_HOUR_TICKS, poisson_mean(alarms)
        return cls(alarms, ticks, alarms / hours, Interval(mean.low / hours, mean.high / hours))


@dataclasses.dataclass(frozen=True, slots=True)
class Summary:
    """Holds all figures of one or several legs."""

    legs: tuple[str, ...]
    rows: dict[Row, RowFigures]  # every row that holds a touch, and always the headline
    counted: RowFigures  # the rows together whose misses are errors
    in_time: RowFigures  # those of them that are not late
    # late_in_swing, late_after: counted touches that are, before and after the turn to stance
    late_in_swing: RowFigures
    late_after: RowFigures
    detections: int  # touches detected, whatever their row
    false_alarms: int  # in swings and after them
    precision: float | None  # detections over detections and false alarms, None without either
    precision_interval: Interval
    swings: int
    lost_swings: int  # swings with an error, a missed touch of a counted row or a false alarm
    # swing ticks on which the foot was not still loaded from before, and up to 16 ticks after the
    # turn to stance on which nothing touched
    judged_ticks: int
    robot_hours: float
    # false alarms per robot-hour of 540,000 judged ticks, None without ticks
    per_hour: float | None
    # its 95 % Poisson interval; the upper end is infinite without ticks
    per_hour_interval: Interval
    after: AlarmFigures  # the part of them after turns to stance
    neutral: int  # events while the foot was still loaded from before
    outside: int  # events in stance that are not judged
    unjudged: int  # touches in stance that are not judged

    @property
    def headline(self) -> Row:
        """Return the row to look at first: without speeds in the truth, that of unknown speed."""
        without = "unknown" in self.rows and not self.rows["headline"].touches
        return "unknown" if without else "headline"


def summarise(outcomes: Sequence[LegOutcome]) -> Summary:
    """Add up the outcomes of legs, or of the same leg in several recordings."""
    touches = [outcome.touches for outcome in outcomes]
    row = _column(touches, "row")
    rows = {
        name: _figures(touches, row == code)
        for code, name in enumerate(ROWS)
        if name == "headline" or np.any(row == code)
    }
    found = int(np.sum(_column(touches, "found")))
    counted, after_turn, late = (
        _column(touches, n).astype(bool) for n in ("counted", "after_turn", "late")
    )
    alarms = AlarmFigures.from_counts(
        sum(len(outcome.alarms_ns) for outcome in outcomes),
        sum(int(outcome.swings.judged.sum()) for outcome in outcomes),
    )
    after = AlarmFigures.from_counts(
        sum(int(outcome.alarm_after.sum()) for outcome in outcomes),
        sum(int(outcome.swings.judged_after.sum()) for outcome in outcomes),
    )
    reported = found + alarms.false_alarms
    return Summary(
        legs=tuple(dict.fromkeys(outcome.leg for outcome in outcomes)),
        rows=rows,
        counted=_figures(touches, counted),
        in_time=_figures(touches, counted & ~late),
        late_in_swing=_figures(touches, counted & late & ~after_turn),
        late_after=_figures(touches, counted & late & after_turn),
        detections=found,
        false_alarms=alarms.false_alarms,
        precision=found / reported if reported else None,
        precision_interval=clopper_pearson(found, reported),
        swings=sum(len(outcome.swings.start_ns) for outcome in outcomes),
        lost_swings=sum(int(np.sum(outcome.swings.errors > 0)) for outcome in outcomes),
        judged_ticks=alarms.judged_ticks,
        robot_hours=alarms.judged_ticks / ROBOT_HOUR_TICKS,
        per_hour=alarms.per_hour,
        per_hour_interval=alarms.interval,
        after=after,
        neutral=sum(int(outcome.swings.neutral.sum()) for outcome in outcomes),
        outside=sum(len(outcome.outside_ns) for outcome in outcomes),
        unjudged=sum(len(outcome.unjudged_ns) for outcome in outcomes),
    )


def _column(touches: Sequence[TouchTable], name: str) -> NDArray[np.int64]:
    columns = [getattr(table, name) for table in touches]
    return np.concatenate(columns) if columns else np.zeros(0, np.int64)


def _figures(touches: Sequence[TouchTable], chosen: NDArray[np.bool_]) -> RowFigures:
    found = _column(touches, "found").astype(bool) & chosen
    total, hits = int(np.sum(chosen)), int(np.sum(found))
    latency_ms = _column(touches, "latency_ns")[found] / _NS_PER_MS
    error_ms = _column(touches, "onset_error_ns")[found] / _NS_PER_MS
    return RowFigures(
        touches=total,
        found=hits,
        found_late=int(np.sum(_column(touches, "found_late_ns")[chosen] >= 0)),
        recall=hits / total if total else None,
        interval=clopper_pearson(hits, total),
        latency=Latency(*(float(q) for q in np.percentile(latency_ms, (50, 95, 99))))
        if hits
        else None,
        onset_error_ms=float(np.median(error_ms)) if hits else None,
    )


def swings_to_recovery(
    swings: SwingTable,
    drift_ns: int,
    *,
    window: int = 20,
    # "Half of them with contact" is how the experiment is made.  Where contacts are drawn at
    # random, half of 20 swings is 10 give or take 2; fewer than 5 of a kind would say nothing about
    # it.
    least_of_a_kind: int = 5,
) -> int | None:
    """Count the swings after a drift before a leg is reliable again.

    The first swing n, counted from 0 at the first one that begins at or after the drift, such that
    the swings n to n + 19 hold at most one error (a missed touch of a counted row, or a false
    alarm).  Where fewer than ``least_of_a_kind`` of them hold a touch, or none, as many more
    swings are looked at as it takes: what twenty swings cannot show is no fault of the leg's.

    Args:
        swings: of one leg.
        drift_ns: when the drift began.
        window: swings looked at together, at least.
        least_of_a_kind: swings with a touch, and without one, that there must be among them.

    Returns:
        n; 0 where nothing was lost, None where no such swing exists before the stream ends.
    """
    after = swings.start_ns >= drift_ns
    errors, touched = swings.errors[after], swings.touches[after] > 0
    n = len(errors)
    starts = np.arange(n - window + 1)
    if n < window:
        return None
    ends = starts + window
    for kind in (touched, ~touched):
        so_far = _counted(kind)
        # The first end at which there are enough of the kind since the start; n + 1 for none.
        enough = np.searchsorted(so_far, so_far[starts] + least_of_a_kind, side="left")
        ends = np.maximum(ends, enough)
    held = ends <= n
    so_far = _counted(errors)
    good = held & (so_far[np.minimum(ends, n)] - so_far[starts] <= 1)
    return int(np.argmax(good)) if good.any() else None


def _counted(values: NDArray[np.int64] | NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the sums of the first 0, 1, ..., n values, (n + 1,)."""
    return np.concatenate(([0], np.cumsum(values, dtype=np.int64)))


def is_harmful(drifted: list[LegOutcome], twin: list[LegOutcome]) -> bool:
    """Return whether a drift counts as one to recover from.

    Returns:
        Whether it lost 5 points of recall on the counted rows, or raised ten times the false
        alarms per judged tick; a twin without any is taken to have had one.
    """
    worse, better = summarise(drifted), summarise(twin)
    # When a drift counts as one to recover from.
    if _recall(better) - _recall(worse) >= 0.05:
        return True
    at_least = 10.0 * max(better.false_alarms, 1) / max(better.judged_ticks, 1)
    return worse.false_alarms / max(worse.judged_ticks, 1) >= at_least


def _recall(summary: Summary) -> float:
    counted = summary.counted
    return counted.found / counted.touches if counted.touches else 0.0
