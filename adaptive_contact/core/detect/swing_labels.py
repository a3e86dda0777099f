"""Labels a swing once it is known what of it was free, and what was a contact.

A swing's rows wait until it is resolved.  Ticks in which the foot rises, well after lift-off,
cannot press on the ground: they are free at once.  Ticks after the top are free once the next
stance has begun without an alarm, but for the last ones, in which a touch too soft to see may sit;
after an alarm, only those well before its onset.  Where every swing ends in a touch these never
reach the end of a descent; of a leg that has changed, what the ground cannot have done to the last
ticks before the onset is learned, too.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled
from adaptive_contact.core.detect.contact import GUARD_TICKS, MIN_LIFT_ROWS
from adaptive_contact.core.detect.layout import BEGAN, TOPPED, WEIGHED, copy_vector
from adaptive_contact.core.detect.leg_batch import LegPlace
from adaptive_contact.core.detect.state import PUT_DOWN
from adaptive_contact.core.detect.swing_judge import Landings, Rollout, SwingJudge
from adaptive_contact.model.labelled_swing import (
    NO_ROWS,
    SEGMENTS,
    Label,
    LabelledSwing,
    Rows,
)
from adaptive_contact.model.leg_model import LegModel, rollout
from adaptive_contact.model.noise import UNFIT_LEVEL

# Whole swings in a row without a lift that could be labelled, after which changes go unseen.
UNOBSERVED_SWINGS: Final = 20
# A foot that lets go late shows in residuals that fall by orders of magnitude; a leg that has
# changed shows in all of them alike.  Rows this many times above the last ones are still pressed.
LET_GO_RATIO: Final = 10.0
# Touches at less than so many times the threshold take several ticks to show, and their onsets say
# little: in rows of a low foot before them a leg from a prior may touch.
VAGUE: Final = 3.0
# Nearer than this nothing is learned, whatever it is.
NEAR_TICKS: Final = 1
# In between, ticks that the model misses (a NIS above this)...
MISSED_NIS: Final = 1.0
# ...up to the first in which the foot is pushed up by more deviations than this.
PUSHED_SIGMA: Final = 1.0
# A touch that began before a hole in the readings is reported after it, with an onset up to so many
# ticks behind its end: the statistic's windows begin again.
HOLE_TICKS: Final = 8
# Last ticks of a descent without an alarm that are not taken for free.
LAST_TICKS: Final = 6


class SwingLabels:
    """Labels the swings of one leg.

    Args:
        place: the leg's arrays.
        swing: judges it.

    Attributes:
        landings: how late touches come.
    """

    def __init__(self, place: LegPlace, swing: SwingJudge) -> None:
        self._place = place
        self._swing = swing
        self.landings = Landings()
        self._first: LegModel | None = None
        self._region = 0
        self._regions = Regions()
        self._travel_judged = False
        self._rollout: Rollout | None = None  # from where the leg was before the swing
        self._unobserved = 0  # whole swings since a lift was labelled
        self._touched = False  # a contact began in this swing

    @property
    def unobservable_note(self) -> str | None:
        """One line for the operator when changes of the leg cannot be seen."""
        leg = self._place.leg
        if not (leg.has_model and leg.learning):
            return None
        if self._unobserved < UNOBSERVED_SWINGS:
            return self._swing.unobservable_note
        return (
            f"no lift could be used in {self._unobserved} swings: they are too short, or the foot "
            "hardly rises; changes of the leg are not followed"
        )

    def begin(self, first: LegModel | None) -> None:
        """Take over the model by which the leg was first known; None where there is none."""
        self._first = first

    def assess(self, flags: int) -> list[LabelledSwing]:
        """Label what the next tick is judged by: a swing that begins, a lift past its top."""
        leg = self._place.leg
        found: list[LabelledSwing] = []
        if not leg.has_model:
            return found
        if flags & BEGAN:
            self._begin_swing()
            found.append(LabelledSwing(Label.BEGIN, refuted=self._touched and self._hangs))
            self._touched = False
        if not flags & WEIGHED:
            return found
        way = self._place.batch.history[self._place.row, 1, 0]
        nis = leg.squared * leg.variance_scale / len(way)
        found.append(LabelledSwing(Label.TICK, nis=nis, way_rad=float(np.abs(way).sum())))
        if flags & TOPPED:
            found += self._lift()
        return found

    def resolve(self) -> list[LabelledSwing]:
        """Label the rest of the swing that has ended."""
        leg = self._place.leg
        if not leg.has_model:
            return []
        self._unobserved += leg.resolved_whole
        first, last = leg.resolved_first, leg.resolved_last
        descent = self._rows(first, last)
        pressed = leg.stance_push > (leg.load + PUT_DOWN) * leg.stance_n
        if descent and (pressed or not self._hangs):
            records = descent.records
            descent = descent[~records["after"] | records["high"]]
            descent = descent[: len(descent) - low_rows(descent)]
        loaded = leg.stance_n > 0 and leg.stance_push > PUT_DOWN * leg.stance_n
        if descent and leg.from_prior and loaded and not self._touched:
            descent = descent[descent.records["high"]]  # the touch was missed
        return [
            *self._confirmed(descent, lifted=self._swing.had_lifted),
            LabelledSwing(
                Label.END, early=self._swing.touched_early(), refuted=bool(leg.resolved_down)
            ),
        ]

    def alarm(self) -> list[LabelledSwing]:
        """Label what a contact that has just begun confirms."""
        leg = self._place.leg
        if not leg.has_model:
            return []
        self._touched = True
        onset_ns, now_ns, period_ns = leg.onset_ns, leg.at_ns, leg.period_ns
        if leg.topped:
            self._swing.touched(round((now_ns - onset_ns) / period_ns))
            self.landings.touched(leg.after - (now_ns - onset_ns) // period_ns)
        rows = self._close(onset_ns, period_ns)
        vague = leg.from_prior and leg.has_lengths and leg.usual < VAGUE
        if rows and vague and not self._hangs:
            rows = rows[rows.records["high"]]
        return self._confirmed(rows, lifted=self._swing.lifted)

    # -- private -------------------------------------------------------------------------------

    @property
    def _hangs(self) -> bool:
        """Whether a leg that began with a prior hangs: nothing of its swing is a touch."""
        return bool(self._place.leg.from_prior and self._place.leg.hanging)

    def _begin_swing(self) -> None:
        self._travel_judged = False
        self._place.leg.fits = False
        self._rollout = None
        # By the model as it was first known: what was learned since may be of what holds the foot.
        batch, row = self._place.batch, self._place.row
        if self._place.leg.began_full and self._first is not None:
            window = batch.began_window[row].copy()
            self._rollout = functools.partial(rollout, self._first, window)

    def _lift(self) -> list[LabelledSwing]:
        """Label a lift past its top: its travel, and its rows if they are free."""
        found: list[LabelledSwing] = []
        leg, swing = self._place.leg, self._swing
        if not self._travel_judged:
            # Whether or not a tick of the lift can be learned: a foot held fast leaves none.
            self._travel_judged = True
            obstructed = swing.check_travel(self._rollout)
            if obstructed is not None:
                ratio = swing.travel_ratio
                found.append(LabelledSwing(Label.TRAVEL, obstructed=obstructed, travel_ratio=ratio))
        batch, row, count = self._place.batch, self._place.row, leg.lift_n
        first, total = let_go_row(batch.rows[row], count)
        if count - first < MIN_LIFT_ROWS:
            return found
        leg.fits |= total <= UNFIT_LEVEL * (count - first)
        if swing.lifted:
            self._unobserved = 0
            self._region = self._regions.region_of(batch.desired[row].tolist())
            rows = moving(self._rows(first, count))
            if len(rows) >= MIN_LIFT_ROWS:
                region, whole = self._region, 2 * first <= count
                found.append(LabelledSwing(Label.LIFT, rows, region, leg.at_ns, whole=whole))
            if first and self._hangs:  # nothing had to let the foot go
                early = self._rows(0, first)
                found.append(LabelledSwing(Label.DESCENT, early, self._region))
        return found

    def _confirmed(self, rows: Rows, *, lifted: bool) -> list[LabelledSwing]:
        """Label rows of a descent as free, unless the foot had not come up or was obstructed."""
        if not rows or not lifted or self._swing.obstructed:
            return []
        rows = moving(rows)
        return [LabelledSwing(Label.DESCENT, rows, self._region)] if rows else []

    def _close(self, onset_ns: int, period_ns: int) -> Rows:
        """Close the swing at a contact; return the rows of its descent that are free."""
        batch, row, leg = self._place.batch, self._place.row, self._place.leg
        lift, count = leg.lift_n, leg.row_n
        kept, free, near_ns = close_swing(
            batch.rows[row], batch.row_values[row], lift, leg.commanded_n, count, onset_ns,
            period_ns, leg.hole_ns,
        )  # fmt: skip
        rows = self._rows(lift, free)
        if free < count and batch.rows[row, free]["push"]:  # seldom: of a leg that has changed
            rows = rows.then(not_pushed(self._rows(free, count), near_ns))
        leg.lift_n = leg.row_n = kept
        leg.closed = True
        return rows

    def _rows(self, first: int, last: int) -> Rows:
        """Copy rows of the swing out of the arrays."""
        batch, at = self._place.batch, self._place.row
        if first >= last:
            return NO_ROWS
        values, records = copy_rows(batch.row_values[at], batch.rows[at], first, last)
        return Rows(values, records, batch.measured.shape[1])


def low_rows(descent: Rows) -> int:
    """Count the last ticks of a descent in which a touch may hide: those of a foot that is low."""
    low = (~descent.records["high"][-LAST_TICKS:]).tolist()
    return len(low) - low.index(True) if True in low else 0


@compiled
def copy_rows(values, rows, first, last):
    """Copy the (p + 2 J,) values and the records of some rows of a swing.

    numpy takes four times as long for records.
    """
    return values[first:last].copy(), rows[first:last].copy()


@compiled
def let_go_row(rows, count):
    """Find the part of a lift in which the foot is off the ground.

    Args:
        rows: what is known of the rows of a swing, see ``ROW``.
        count: of these, those of the lift.

    Returns:
        Its first row, ``count`` for none, and the sum of the NIS from there.
    """
    first, total = 0, 0.0
    if count and not rows[0].was_free:
        last = rows[count - 1].nis
        limit = LET_GO_RATIO * max(1.0, min(last, rows[max(count - 2, 0)].nis))
        first = count
        while first > 0 and rows[first - 1].nis <= limit:
            first -= 1
    for k in range(first, count):
        total += rows[k].nis
    return first, total


@compiled
def close_swing(rows, values, lift, commanded, count, onset_ns, period_ns, hole_ns):
    """Keep, of the rows of a swing with a contact, those that are free: well before its onset.

    Args:
        rows: of the swing, those of the lift first; those of it that stay move together.
        values: likewise.
        lift: how many are of the lift, if its top has not been passed.
        commanded: of these, the first so many had a command that went up, too.
        count: of all.
        onset_ns: of the contact.
        period_ns: control tick.
        hole_ns: the last tick of the descent before a hole in its readings, -1 for none.

    Returns:
        How many rows of the lift stay, the first row of the descent that is not confirmed, and up
        to when one may be that no push from below accounts for.
    """
    near_ns = onset_ns - NEAR_TICKS * period_ns
    if hole_ns >= 0:
        after_ns = onset_ns
        for k in range(lift, count):
            if rows[k].t_ns > hole_ns:
                after_ns = rows[k].t_ns
                break
        if onset_ns - after_ns <= HOLE_TICKS * period_ns:
            onset_ns, near_ns = hole_ns, 0
    last_ns = onset_ns - GUARD_TICKS * period_ns
    # A foot on its way up while its command comes down lags behind, or has been kicked up.
    limit = 1.0
    for k in range(commanded):
        limit = max(limit, rows[k].nis)
    limit *= LET_GO_RATIO
    if commanded == count:  # a strike in the lift
        commanded, limit = 0, 0.0
    kept = 0
    for k in range(lift):
        if k < commanded or rows[k].t_ns <= last_ns or rows[k].nis <= limit:
            if kept < k:
                rows[kept] = rows[k]
                copy_vector(values[k], values[kept])
            kept += 1
    free = lift
    while (
        free < count
        and rows[free].t_ns <= last_ns
        and (rows[free].was_free or rows[free].nis <= limit)
    ):
        free += 1
    return kept, free, near_ns


def moving(rows: Rows) -> Rows:
    """Select the ticks in which no reading repeats itself where the model expects motion.

    What it repeats may be true, and the model wrong; but a foot that is held fast repeats its
    readings, too.
    """
    repeats = rows.records["repeats"]
    return rows[~repeats] if any(repeats.tolist()) else rows


def not_pushed(rows: Rows, last_ns: int) -> Rows:
    """Select, of a leg that has changed, the ticks that no push from below accounts for."""
    pushed = (rows.t_ns > last_ns) | ~rows.records["push"] | (rows.records["sigma"] > PUSHED_SIGMA)
    if pushed.any():
        rows = rows[: int(pushed.argmax())]
    found = rows[rows.nis > MISSED_NIS]
    found.target[:] = found.aside
    return found


class Regions:
    """Divides a leg's workspace coarsely: where the first joint points, how far the last bends.

    Thirds and halves of what the last swings have seen of them, as many as the buffer holds, so
    that legs of any build have several and one wild command does not make them one for good.
    """

    def __init__(self) -> None:
        self._first, self._last = _Range(), _Range()

    def region_of(self, at: Sequence[float]) -> int:
        """Return the region, 0 to 5, of a command, (J,) rad."""
        return 2 * self._first.part(at[0], 3) + self._last.part(at[-1], 2)


class _Range:
    """Holds the range of the newest values."""

    def __init__(self) -> None:
        self._seen = deque[float](maxlen=SEGMENTS)
        self._least, self._most = math.inf, -math.inf

    def part(self, value: float, parts: int) -> int:
        """Note a value; compute which of so many equal parts of the range it lies in."""
        seen = self._seen
        goes = seen[0] if len(seen) == SEGMENTS else None
        seen.append(value)
        if goes is not None and not self._least < goes < self._most:
            self._least, self._most = min(seen), max(seen)
        self._least, self._most = min(self._least, value), max(self._most, value)
        width = self._most - self._least
        return 0 if width <= 0.0 else min(int(parts * (value - self._least) / width), parts - 1)
