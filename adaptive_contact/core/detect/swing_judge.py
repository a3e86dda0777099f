"""Judges one swing of a leg: is its foot obstructed, how early was it stopped.

The tick follows phase, heights and commands (:mod:`~adaptive_contact.core.detect.swing`); the
judgements here are made once a swing, from what it has kept.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.core.detect.layout import ASKED, HEIGHTS, SWINGS
from adaptive_contact.core.detect.leg_batch import LegPlace
from adaptive_contact.core.detect.swing import LEAST_WAY_M, LIFT_TICKS, LIFTED_M
from adaptive_contact.robot import Leg

_Point = tuple[float, float, float]  # of a foot, in its leg's frame, m
Rollout = Callable[[Sequence[Sequence[float]]], Sequence[NDArray[np.float64]]]

# A foot that has come less than this share of its command's way by the top of the lift is held:
# caught ones 95 times in 100; free ones, those of tired legs among them, 1 to 4 times.  It is taken
# for free again above the second share, which free ones reach 9 times in 10.
HELD_SHARE: Final = 0.75
FREE_SHARE: Final = 0.9
# Readings that fall by more than this share of their command's rise are turned around: what hangs
# on a foot pulls it down by less.
TURNED_SHARE: Final = 0.5
# An obstruction is forgotten after so many lifts in a row without evidence: their residuals
# decide then, as it would have without.
FORGET_SWINGS: Final = 5
# Soft ground is detected late: its height is that of the foot so many ticks before an onset.
SURFACE_TICKS: Final = 3
# A contact reported where the foot has descended less than this share of its rise is early.
EARLY_SHARE: Final = 1 / 3
# Touches come late where most of the last so many begin after the turn.
LANDINGS: Final = 20


class Landings:
    """Counts how late the contacts of one leg come."""

    def __init__(self) -> None:
        self._late: deque[int] = deque(maxlen=LANDINGS)  # ticks after the turn, 0 for before it

    def touched(self, after: int) -> None:
        """Count a contact by its ticks after the turn to stance, 0 or less for before it."""
        self._late.append(max(after, 0))

    @property
    def note(self) -> str | None:
        """One line for the operator when most contacts come after the turn; names no cause."""
        late = sorted(ticks for ticks in self._late if ticks)
        if 2 * len(late) <= LANDINGS:
            return None
        return (
            f"{len(late)} of the last {len(self._late)} contacts came after phase had turned to "
            f"stance, by {late[len(late) // 2]} ticks: phase turns before the foot arrives, soft "
            "ground is felt late, or nothing was touched"
        )


class SwingJudge:
    """Judges the travel of one leg's foot, swing by swing.

    Attributes:
        travel_ratio: share of its command's way that the foot went in the last lift judged; of
            a leg that does not go all of it, of the way that its model predicts.
    """

    def __init__(self, leg: Leg, place: LegPlace) -> None:
        self.travel_ratio = 1.0
        self._leg = leg
        self._place = place
        self._unasked = 0  # lifts in a row that could not show an obstructed foot
        size = 1.0 if leg.chain is None else leg.chain.size
        self._lifted_m, self._least_way_m = LIFTED_M * size, LEAST_WAY_M * size

    @property
    def ticks(self) -> int:
        """Samples since the swing began, 1 at its first, 0 in stance."""
        return int(self._place.leg.ticks)

    @property
    def obstructed(self) -> bool:
        """Whether the foot does not follow its command: obstructed, or without strength."""
        return bool(self._place.leg.obstructed)

    @property
    def measures(self) -> bool:
        """Whether the foot's height is known; without geometry, time stands for it."""
        return self._leg.chain is not None

    @property
    def lifted(self) -> bool:
        """Whether the foot has come up at all; assumed without geometry."""
        return self._leg.chain is None or self._place.leg.rise > self._lifted_m

    @property
    def had_lifted(self) -> bool:
        """The same of the swing that has ended last."""
        return self._leg.chain is None or self._place.leg.resolved_rise > self._lifted_m

    @property
    def phase_unknown_note(self) -> str | None:
        """One line for the operator when swings cannot be found at all."""
        if not self._place.leg.phase_lacking or self.measures:
            return None
        return (
            "samples carry no phase and robot.toml no lengths_m: swings cannot be found, contacts "
            "are not reported"
        )

    @property
    def unobservable_note(self) -> str | None:
        """One line for the operator when changes of the leg cannot be seen."""
        count = min(self._place.leg.lengths_n, SWINGS)
        if self.measures or not count:
            return None
        if int(self._place.batch.lengths_ticks[self._place.row, :count].min()) // 2 >= LIFT_TICKS:
            return None
        return (
            "robot.toml has no lengths_m, and swings are shorter than 0.4 s: changes of the leg "
            "are not followed; give the lengths of its links"
        )

    def check_travel(self, rollout: Rollout | None = None) -> bool | None:
        """Check at the top of a lift whether the foot is obstructed; None if little was asked.

        Counted from where the foot was: after a touch it starts higher than its command.

        Args:
            rollout: where the commands of a swing take a leg that nothing holds, (J,) rad each;
                asked only of a foot that is behind.
        """
        batch, row, leg = self._place.batch, self._place.row, self._place.leg
        count = leg.asked_n
        asked = float(batch.asked[row, (count - min(count, ASKED)) % ASKED])
        if asked <= self._least_way_m:
            # In a gait of small steps nothing would ever show that the foot is free again.
            self._unasked += 1
            if self._unasked >= FORGET_SWINGS:
                leg.obstructed = False
            return None
        self._unasked = 0
        moved = leg.moved
        self.travel_ratio = moved / asked
        enough = FREE_SHARE if leg.obstructed else HELD_SHARE
        kept = leg.path_n
        unbroken = leg.path_last - leg.path_first + 1 == kept
        if self.travel_ratio < enough and rollout is not None and unbroken:
            # Servos that are slow for this gait never bring the foot where the command was.
            path = batch.path[row, :kept].tolist()
            predicted = rollout(path)
            places = [self._foot(angles.tolist()) for angles in predicted]
            start = batch.start[row].tolist()
            way = max((math.dist(place, start) for place in places), default=0.0)
            whole = len(places) == len(path)  # else the model ran away
            if whole and self._least_way_m < way < FREE_SHARE * asked:
                self.travel_ratio = moved / way
        if self._turned_around():
            self.travel_ratio = 0.0
        obstructed = leg.obstructed = self.travel_ratio < enough
        return obstructed

    def _turned_around(self) -> bool:
        """Return whether readings went down by most of what the command rose, and away from it.

        A foot that an obstacle held above its command goes down to it as the obstacle goes.
        """
        batch, row, leg = self._place.batch, self._place.row, self._place.leg
        start = float(batch.start[row, 2])
        fell = start - leg.lowest_m
        if self.lifted or fell < self._least_way_m * TURNED_SHARE:
            return False
        path = batch.path[row, : leg.path_n].tolist()
        heights = [self._foot(angles)[2] for angles in path]
        asked = max(heights) - min(heights[0], start)
        below = heights[-1] - float(batch.foot[row, 2])
        return asked > self._least_way_m and min(fell, below) > TURNED_SHARE * asked

    def touched(self, ticks: int) -> None:
        """Note the foot's height at a contact, whose onset was so many ticks ago."""
        leg = self._place.leg
        count = leg.heights_n
        if not count or not self.measures:
            return
        heights, kept = self._place.batch.heights[self._place.row], min(count, HEIGHTS)
        at, before = (
            float(heights[(count - 1 - min(back, kept - 1)) % HEIGHTS])
            for back in (ticks, ticks + SURFACE_TICKS)
        )
        leg.touch_at, leg.touch_before = at, before
        if math.isnan(leg.fallen):
            leg.fallen = leg.top - at

    def touched_early(self) -> bool | None:
        """Return whether the last swing reported an early contact.

        Returns:
            None where that is not known; False also where no contact was reported.
        """
        leg = self._place.leg
        if not (self.measures and leg.resolved_whole and self.had_lifted) or leg.obstructed:
            return None
        fallen = leg.resolved_fallen
        return not math.isnan(fallen) and fallen < EARLY_SHARE * leg.resolved_rise

    def restart(self) -> None:
        """Forget past lifts: the source has started again."""
        self._unasked = 0

    def _foot(self, angles: Sequence[float]) -> _Point:
        assert self._leg.chain is not None
        return self._leg.chain.point(angles)
