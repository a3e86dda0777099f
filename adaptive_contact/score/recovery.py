"""How many swings a leg needs after a drift until it can be relied on again."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.score.outcome import LegOutcome, SwingTable
from adaptive_contact.score.summary import Summary, summarise

WINDOW_SWINGS: Final = 20
ALLOWED_ERRORS: Final = 1
# "Half of them with contact" is how the experiment is made.  Where contacts are drawn at random,
# half of 20 swings is 10 give or take 2; fewer than 5 of a kind would say nothing about it.
LEAST_OF_A_KIND: Final = 5
# When a drift counts as one to recover from.
RECALL_LOST: Final = 0.05
ALARM_RATIO: Final = 10.0


def swings_to_recovery(
    swings: SwingTable,
    drift_ns: int,
    *,
    window: int = WINDOW_SWINGS,
    allowed: int = ALLOWED_ERRORS,
    least_of_a_kind: int = LEAST_OF_A_KIND,
) -> int | None:
    """Swings of a leg that pass after a drift before it is reliable again.

    The first swing n, counted from 0 at the first one that begins at or after the drift, such that
    the swings n to n + 19 hold at most one error (a missed touch of a counted row, or a false
    alarm).  Where fewer than ``least_of_a_kind`` of them hold a touch, or none, as many more
    swings are looked at as it takes: what cannot be told from twenty is no fault of the leg's.

    Args:
        swings: of one leg.
        drift_ns: when the drift began.
        window: swings looked at together, at least.
        allowed: errors in them.
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
    good = held & (so_far[np.minimum(ends, n)] - so_far[starts] <= allowed)
    return int(np.argmax(good)) if good.any() else None


def _counted(values: NDArray[np.int64] | NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n + 1,) sums of the first 0, 1, ..., n values."""
    return np.concatenate(([0], np.cumsum(values, dtype=np.int64)))


def is_harmful(drifted: list[LegOutcome], twin: list[LegOutcome]) -> bool:
    """Tell whether a drift counts as one to recover from.

    Args:
        drifted: the frozen detector on the recording with the drift, from the drift on.
        twin: the same detector on the same recording without it, over the same time.

    Returns:
        Whether it lost 5 points of recall on the counted rows, or raised ten times the false
        alarms per judged tick; a twin without any is taken to have had one.
    """
    worse, better = summarise(drifted), summarise(twin)
    if _recall(better) - _recall(worse) >= RECALL_LOST:
        return True
    at_least = ALARM_RATIO * max(better.false_alarms, 1) / max(better.judged_ticks, 1)
    return worse.false_alarms / max(worse.judged_ticks, 1) >= at_least


def _recall(summary: Summary) -> float:
    counted = summary.counted
    return counted.found / counted.touches if counted.touches else 0.0
