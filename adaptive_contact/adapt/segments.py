"""One swing's ticks, held back until it is known what they were.

A swing is in quarantine until it is resolved.  Ticks in which the foot rises, well after
lift-off, cannot press on the ground: they are free at once.  Ticks after the top are free once the
next stance has begun without an alarm, but for the last ones, in which a touch too soft to see may
sit; after an alarm, only those well before its onset.  Where every swing ends in a touch these
never reach the end of a descent; of a leg that has changed, what the ground cannot have done to
the last ticks before the onset is learned, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.ground import Push

__all__ = ["Row", "confirmed_before", "confirmed_of", "let_go_rows", "residuals_of"]

Array = NDArray[np.float64]

# Without calm, the first tick of a lift taken for free: a foot pressed in the stance before has let
# go by the 7th tick of the command (measured in pose, 62 of 62 cases).
FREE_LIFT_TICKS: Final = 8
# A foot that lets go late shows in residuals that fall by orders of magnitude; a leg that has
# changed shows in all of them alike.  Rows this many times above the last ones are still pressed.
LET_GO_RATIO: Final = 10.0
# Fewer free ticks than this say nothing about a lift.
MIN_LIFT_ROWS: Final = 3
# Ticks before an estimated onset that are not taken for free: estimates are late by up to two.
GUARD_TICKS: Final = 3
# Nearer than this nothing is.
TOUCHING_TICKS: Final = 1
# In between, ticks that the model misses (a level above this)...
MISSED_LEVEL: Final = 1.0
# ...up to the first in which the foot is pushed up by more deviations than this.
PUSHED_SIGMA: Final = 1.0
# A touch that began before a hole in the readings is told after it, with an onset up to so many
# ticks behind its end: the statistic's windows begin anew.
HOLE_TICKS: Final = 8
# And at the end of a swing without an alarm.
LAST_TICKS: Final = 6
# A swing longer than this keeps its newest ticks; 400 is a slow descent of 8 s.
MAX_ROWS: Final = 400


class Row(NamedTuple):
    """One tick to learn from.

    Attributes:
        theta: (p,) regressors that predicted it.
        target: (J,) rad, the movement that was measured.
        level: squared whitened distance of its residual over J: 1 on average for a good model.
        value: the statistic of this tick alone, by which it was judged.
        context: by which its covariance was chosen.
        t_ns: of the tick.
        lift: the foot was rising.
        calm: the leg had been found free before.
        cleared: the foot had left the ground before, by its height; only then it is learned.
        push: what it shows of a push from the ground, where the leg has changed, its geometry is
            known and the foot does not rise; None elsewhere.
    """

    theta: Array
    target: Array
    level: float
    value: float
    context: int
    t_ns: int
    lift: bool
    calm: bool
    cleared: bool
    push: Push | None = None


def residuals_of(rows: Sequence[Row], coefficients: Array) -> tuple[Array, Array]:
    """Regressors (n, p) of rows; what (p, J) coefficients leave of their targets, (n, J) rad."""
    theta = np.array([row.theta for row in rows])
    return theta, np.array([row.target for row in rows]) - theta @ coefficients


def confirmed_before(
    lift: Sequence[Row], commanded: int, descent: list[Row], onset_ns: int, period_ns: int,
    hole_ns: int | None,
) -> tuple[list[int], list[Row]]:  # fmt: skip
    """Of a swing in which a contact was reported: what came well before its onset is free.

    Nearer to it, what the ground cannot have done is: the part of the movement that no push from
    below accounts for.

    Args:
        lift: rows of the lift, if its top has not been passed.
        commanded: of these, the first so many had a command that went up, too.
        descent: rows of the descent.
        onset_ns: of the contact.
        period_ns: control tick.
        hole_ns: the last tick of the descent before a hole in its readings, None for none.

    Returns:
        Which rows of the lift stay, and the rows of the descent that are confirmed.
    """
    near_ns = onset_ns - TOUCHING_TICKS * period_ns
    if hole_ns is not None:
        after_ns = next((row.t_ns for row in descent if row.t_ns > hole_ns), onset_ns)
        if onset_ns - after_ns <= HOLE_TICKS * period_ns:
            onset_ns, near_ns = hole_ns, 0
    last = onset_ns - GUARD_TICKS * period_ns
    # A foot on its way up while its command comes down lags behind, or has been kicked up.
    limit = LET_GO_RATIO * max([1.0, *(row.level for row in lift[:commanded])])
    kept = [
        k for k, row in enumerate(lift) if k < commanded or row.t_ns <= last or row.level <= limit
    ]
    rows = [row for row in descent if row.t_ns <= last]
    rows += _not_pushed(descent[len(rows) :], near_ns)
    return kept, rows


def confirmed_of(descent: list[Row]) -> list[Row]:
    """Of a descent after which the next stance has begun: the rows that are confirmed."""
    return descent[:-LAST_TICKS]


def let_go_rows(rows: list[Row]) -> list[Row] | None:
    """The part of a lift in which the foot is off the ground for sure, None if it is too short."""
    if rows and not rows[0].calm:
        limit = LET_GO_RATIO * max(1.0, min(row.level for row in rows[-2:]))
        first = len(rows)
        while first > 0 and rows[first - 1].level <= limit:
            first -= 1
        rows = rows[first:]
    return rows if len(rows) >= MIN_LIFT_ROWS else None


def _not_pushed(rows: list[Row], last_ns: int) -> list[Row]:
    """Of a leg that has changed: what no push from below accounts for, in the ticks it missed."""
    found: list[Row] = []
    for row in rows:
        if row.t_ns > last_ns or row.push is None or row.push.sigma > PUSHED_SIGMA:
            break
        if row.level > MISSED_LEVEL:
            found.append(row._replace(target=row.push.aside))
    return found
