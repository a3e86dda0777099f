"""Hands on what a swing has been found to hold: lifts, descents and contacts.

Between the tick, which judges every sample and holds its rows back, and the follower, which learns:
a lift goes on at its top, a descent once the swing is over, and nothing of a foot that is held.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Sequence
from typing import Final

from adaptive_contact.adapt.buffer import MAX_SEGMENTS
from adaptive_contact.adapt.contacts import TICKS, Touch
from adaptive_contact.adapt.foretell import foretold
from adaptive_contact.adapt.ground import Push
from adaptive_contact.adapt.knowledge import Knowledge
from adaptive_contact.adapt.segments import Row, confirmed_before, confirmed_of, let_go_rows
from adaptive_contact.adapt.swing import Foretell, Landings, SwingJudge
from adaptive_contact.detect.batch import LegPlace
from adaptive_contact.detect.tick import (
    BEGAN,
    BROKE_OFF,
    ENTERED,
    RESTARTED,
    TOPPED,
    TOUCHED,
    TOUCHING,
)

__all__ = ["Quarantine"]

# Whole swings in a row without a lift that could be handed on, after which a leg is deaf.
DEAF_SWINGS: Final = 20


class Quarantine:
    """The swing in hand of one leg.

    Args:
        place: the leg's arrays.
        swing: judges it.
        knowledge: who learns, if anybody does.

    Attributes:
        landings: how late touches come.
        lift_level: of the lift of the swing in hand, as of its rows; infinite while there is none.
    """

    def __init__(self, place: LegPlace, swing: SwingJudge, knowledge: Knowledge) -> None:
        self._place = place
        self._knowledge = knowledge
        self._swing = swing
        self.landings = Landings()
        self._region = 0
        self._regions = _Regions()
        self._touching: list[Touch] = []  # the first ticks of a contact in hand
        self._lift_judged = False
        self.lift_level = math.inf
        self._foretell: Foretell | None = None  # from where the leg was before the swing
        self._unheard = 0  # whole swings since a lift was handed on

    @property
    def deaf_note(self) -> str | None:
        """One line for a person when changes of the leg cannot be heard."""
        follower = self._knowledge.follower
        if follower is None or not follower.gated:
            return None
        if self._unheard < DEAF_SWINGS:
            return self._swing.deaf_note
        return (
            f"no lift could be heard in {self._unheard} swings: they are too short, or the foot "
            "hardly rises; changes of the leg are not followed"
        )

    def assess(self, flags: int) -> None:
        """What of a tick the next one is judged by: a swing that begins, a lift past its top."""
        follower = self._knowledge.follower
        if flags & (RESTARTED | BROKE_OFF):
            self._touching.clear()
        if follower is None:
            return
        if flags & BEGAN:
            self._touching.clear()
            self._begin()
        if flags & TOUCHING and self._touching:
            self._touching.append(self._touch())
            if len(self._touching) >= TICKS:
                self._hand_touch()
        if not flags & ENTERED:
            return
        leg = self._place.leg
        if not follower.gated:
            follower.learn_now(self._rows(0, 1)[0])
            return
        joints = self._place.batch.measured.shape[1]
        follower.monitor.look(float(leg["distance"]) * float(leg["level"]) / joints)
        if not flags & TOPPED:
            return
        swing = self._swing
        if not self._lift_judged:
            # Whether or not a tick of the lift can be learned: a foot held fast leaves none.
            self._lift_judged = True
            held = swing.judge_lift(self._foretell)
            if held is not None:
                follower.monitor.foot_held(held=held, came=swing.came)
        lift = let_go_rows(self._rows(0, int(leg["lift_n"])))
        if lift is not None:
            self.lift_level = sum(row.level for row in lift) / len(lift)
        if lift is not None and swing.lifted and not (swing.held or leg["suspected"]):
            self._unheard = 0
            self._region = self._regions.of(self._place.batch.desired[self._place.row].tolist())
            follower.lift(lift, self._region, int(leg["at_ns"]))

    def resolve(self) -> None:
        """Let the follower have the swing that has ended."""
        follower, leg = self._knowledge.follower, self._place.leg
        if follower is None:
            return
        self._unheard += bool(leg["resolved_whole"])
        self._hand_touch()
        first, last = int(leg["resolved_first"]), int(leg["resolved_last"])
        self._confirm(confirmed_of(self._rows(first, last)), lifted=self._swing.had_lifted)
        follower.swing_done(self._swing.touch_belied())

    def hand_over(self, flags: int) -> None:
        """Let the follower have what a touch that began has confirmed, and its first tick."""
        follower, leg = self._knowledge.follower, self._place.leg
        if follower is None:
            return
        if flags & TOUCHED:
            onset_ns, now_ns, period_ns = (
                int(leg[name]) for name in ("onset_ns", "at_ns", "period_ns")
            )
            self._swing.touched(round((now_ns - onset_ns) / period_ns))
            self.landings.touched(int(leg["after"]) - (now_ns - onset_ns) // period_ns)
            self._confirm(self._alarm(onset_ns, period_ns), lifted=self._swing.lifted)
            self._touching = [self._touch()]
            leg["touching"] = True

    def restart(self) -> None:
        """The source started anew: there is no swing."""
        self._touching.clear()

    def _begin(self) -> None:
        self._lift_judged = False
        self.lift_level = math.inf
        self._foretell = None
        follower = self._knowledge.follower
        assert follower is not None
        follower.monitor.begin_swing()
        # By the model as it was first known: what was learned since may be of what holds the foot.
        batch, row = self._place.batch, self._place.row
        if self._place.leg["began_full"]:
            window = batch.began_window[row].copy()
            self._foretell = functools.partial(foretold, follower.baseline, window)

    def _alarm(self, onset_ns: int, period_ns: int) -> list[Row]:
        """Close the swing to its descent; the rows of it that are free all the same."""
        batch, row, leg = self._place.batch, self._place.row, self._place.leg
        lift, commanded, count = (int(leg[name]) for name in ("lift_n", "commanded_n", "row_n"))
        hole_ns = int(leg["hole_ns"])
        kept, rows = confirmed_before(
            self._rows(0, lift), commanded, self._rows(lift, count), onset_ns, period_ns,
            None if hole_ns < 0 else hole_ns,
        )  # fmt: skip
        for of in (batch.rows, batch.row_thetas, batch.row_targets, batch.row_asides):
            of[row, : len(kept)] = of[row, kept]
        leg["lift_n"] = leg["row_n"] = len(kept)
        leg["closed"] = True
        return rows

    def _rows(self, first: int, last: int) -> list[Row]:
        batch, at = self._place.batch, self._place.row
        if first == last:
            return []
        rows = batch.rows[at, first:last]
        thetas = batch.row_thetas[at, first:last].copy()
        targets = batch.row_targets[at, first:last].copy()
        asides = batch.row_asides[at, first:last].copy()
        columns = (rows[name].tolist() for name in _COLUMNS)
        return [
            Row(theta, target, level, value, context, t_ns, lift, calm, cleared,
                Push(sigma, aside) if push else None)
            for theta, target, aside, level, value, context, t_ns, lift, calm, cleared, sigma, push
            in zip(thetas, targets, asides, *columns, strict=True)
        ]  # fmt: skip

    def _touch(self) -> Touch:
        """The last ticks, for candidate models to be tried on."""
        place = self._place
        batch, row, leg = place.batch, place.row, place.leg
        recent = self._knowledge.recent
        assert recent is not None
        whiten = recent.whiten[int(leg["context"])] / batch.unit[row] ** 0.5
        thetas = batch.thetas[row, : int(leg["thetas_n"])]
        target = place.residuals + place.increments
        limits = recent.awaited if leg["after"] else recent.thresholds
        return Touch.of(thetas, target, whiten, limits, int(leg["usable"]))

    def _hand_touch(self) -> None:
        """The first ticks of a contact, for candidate models to be tried on."""
        ticks, self._touching = self._touching, []
        self._place.leg["touching"] = False
        follower = self._knowledge.follower
        if ticks and follower is not None and follower.learning:
            follower.touched(ticks)

    def _confirm(self, rows: list[Row], *, lifted: bool) -> None:
        follower = self._knowledge.follower
        if follower is not None and rows and lifted and not self._swing.held:
            follower.descent(rows, self._region)


_COLUMNS: Final = (
    "level", "value", "context", "t_ns", "lift", "calm", "cleared", "sigma", "push",
)  # fmt: skip


class _Regions:
    """Coarse places in a leg's workspace: where the first joint points, how far the last bends.

    Thirds and halves of what the last swings have seen of them, as many as the buffer holds, so
    that legs of any build have several and one wild command does not make them one for good.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque(maxlen=MAX_SEGMENTS)

    def of(self, at: Sequence[float]) -> int:
        """The region of a command, (J,) rad, 0 to 5."""
        self._seen.append((at[0], at[-1]))
        first, last = zip(*self._seen, strict=True)
        return 2 * _part(at[0], first, 3) + _part(at[-1], last, 2)


def _part(value: float, seen: Sequence[float], parts: int) -> int:
    """Which of so many equal parts of a range a value lies in."""
    least = min(seen)
    width = max(seen) - least
    return 0 if width <= 0.0 else min(int(parts * (value - least) / width), parts - 1)
