"""Holds back the ticks of the swing in hand, and hands on what is found to be free.

Between the detector, which judges every tick, and the follower, which learns: a lift goes on at
its top, a descent once the swing is over, and nothing of a foot that is held.

What a touch and the end of a swing leave to be learned waits for :meth:`Quarantine.hand_over`, as
the word on other legs must not wait for it.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.buffer import MAX_SEGMENTS
from adaptive_contact.adapt.contacts import TICKS, Touch
from adaptive_contact.adapt.detector import LegDetector, Verdict
from adaptive_contact.adapt.follower import Follower
from adaptive_contact.adapt.foretell import foretold
from adaptive_contact.adapt.ground import Push, push_of
from adaptive_contact.adapt.knowledge import Knowledge
from adaptive_contact.adapt.segments import Row, SwingBook
from adaptive_contact.adapt.swing import Foretell, SwingWatch

__all__ = ["Quarantine"]

Array = NDArray[np.float64]

# Whole swings in a row without a lift that could be handed on, after which a leg is deaf.
DEAF_SWINGS: Final = 20


class Quarantine:
    """The swing in hand of one leg.

    Args:
        swing: where the leg is in it; followed by its owner.
        knowledge: who learns, if anybody does.

    Attributes:
        lift_level: of the lift of the swing in hand, as of its rows; infinite while there is none.
    """

    def __init__(self, swing: SwingWatch, knowledge: Knowledge) -> None:
        self._knowledge = knowledge
        self._swing = swing
        self._book = SwingBook()
        self._open = False
        self._region = 0
        self._regions = _Regions()
        self._touching: list[Touch] = []  # the first ticks of a contact in hand
        self._lift_judged = False
        self.lift_level = math.inf
        self._foretell: Foretell | None = None  # from where the leg was before the swing
        self._unheard = 0  # whole swings since a lift was handed on
        # What this tick has found for the follower, in order.
        self._found: list[Callable[[], None]] = []

    @property
    def follower(self) -> Follower | None:
        """Who learns; None while there is no model."""
        return self._knowledge.follower

    @property
    def deaf_note(self) -> str | None:
        """One line for a person when changes of the leg cannot be heard."""
        if self.follower is None or not self.follower.gated:
            return None
        if self._unheard < DEAF_SWINGS:
            return self._swing.deaf_note
        return (
            f"no lift could be heard in {self._unheard} swings: they are too short, or the foot "
            "hardly rises; changes of the leg are not followed"
        )

    @property
    def lift_first(self) -> bool:
        """Whether an alarm waits: a foot on its way up speaks of the leg, to be heard at its top.

        So does one whose command goes up and which has yet to follow: it may still come down from
        the swing before.  What stops a foot in its lift is told once the command has turned.
        """
        up = self._swing.rising or not self._swing.descending
        return self._gated and up and not self._book.topped

    @property
    def lift_over(self) -> bool:
        """Whether a leg that never was calm is judged from here on: its lift has been.

        The foot comes up for some ticks after its command came down; only then the lift has told
        whether it is the leg that has changed.  Where the swing was broken off none will tell.
        """
        told = self._book.past_top if self._gated else not self._book.broken
        return self._swing.descending and told

    @property
    def _gated(self) -> bool:
        return self.follower is not None and self.follower.gated

    def begin(self) -> None:
        """A swing begins."""
        self._open = True
        self._lift_judged = False
        self.lift_level = math.inf
        self._touching.clear()
        self._book.begin()
        # By its ticks alone nobody can tell its lift from its descent.
        if not (self._swing.whole or self._swing.measures):
            self._book.discard()
        self._foretell = None
        follower, detector = self.follower, self._knowledge.detector
        if follower is None or detector is None:
            return
        # What the swing before has left, where it ends only now, is handed over before.
        self._found.append(follower.monitor.begin_swing)
        # By the model as it was first known: what was learned since may be of what holds the foot.
        tracker, model = detector.tracker, follower.baseline
        if tracker.full and not model.library.window.preview:
            self._foretell = functools.partial(foretold, model, tracker.window.copy())

    def hole(self) -> None:
        """Readings were lost, or were none."""
        self._book.hole()

    def break_off(self) -> None:
        """What comes does not connect: the swing cannot be resolved, and is not learned."""
        self.hand_over()  # of the swing before
        self._swing.interrupt()
        self._touching.clear()
        self._book.discard()

    def restart(self) -> None:
        """The source started anew: there is no swing."""
        self._found.clear()
        self._open = False
        self.break_off()

    def enter(
        self, theta: Array, verdict: Verdict, detector: LegDetector, *, t_ns: int,
        at: Sequence[float], free: bool, copied: bool,
    ) -> None:  # fmt: skip
        """Enter a judged tick, and hand on the lift where this tick is past its top.

        Args:
            theta: (p,) regressors that predicted it.
            verdict: on it.
            detector: whose verdict that is.
            t_ns: of the tick.
            at: (J,) rad, the command in force.
            free: the leg had been found free before, and is not held to touch.
            copied: readings may be copies of commands; a lift that ends so is not learned from.
        """
        follower, swing = self.follower, self._swing
        if follower is None or not follower.learning:
            return
        if self._touching:
            self._touching.append(detector.touch())
            if len(self._touching) >= TICKS:
                self._hand_touch()
        if swing.after:
            return  # the leg is judged, and nothing is learned: too soft a touch may be in it
        if detector.tracker.substituted:
            return  # what the model put in where a reading did not come is no measurement
        # The model's own doubt is part of the unit; the followed level is not.
        monitor, book = follower.monitor, self._book
        level = verdict.distance * follower.level_in_force / len(verdict.target)
        row = Row(
            theta,
            verdict.target,
            level,
            verdict.scores[0] * detector.recent.limits[0],
            detector.context,
            t_ns,
            lift=swing.rising,
            calm=free,
            cleared=swing.cleared,
            push=self._push(verdict, detector) if follower.changed else None,
        )
        if not follower.gated:
            follower.learn_now(row)
            return
        book.add(row, swing.ticks, descending=swing.descending)
        monitor.look(level)
        if book.past_top and not self._lift_judged:
            # Whether or not a tick of the lift can be learned: a foot held fast leaves none.
            self._lift_judged = True
            held = swing.judge_lift(self._foretell)
            if held is not None:
                monitor.foot_held(held=held, came=swing.came)
        lift = book.take_lift()
        if lift is not None:
            self.lift_level = sum(row.level for row in lift) / len(lift)
        if lift is not None and swing.lifted and not (swing.held or copied):
            self._unheard = 0
            self._region = self._regions.of(at)
            follower.lift(lift, self._region, t_ns)

    def alarm(self, onset_ns: int, t_ns: int, period_ns: int, detector: LegDetector) -> None:
        """A contact was reported: what came well before its onset is free."""
        self._swing.touched(round((t_ns - onset_ns) / period_ns))
        self._confirm(self._book.alarm(onset_ns, period_ns))
        self._found.append(functools.partial(self._begin_touch, detector))

    def resolve(self) -> None:
        """The leg stands: the swing is over, without an alarm or with one that was dealt with."""
        follower = self.follower
        if not self._open or follower is None:
            return
        self._open = False
        self._unheard += self._swing.whole
        touching, self._touching = self._touching, []
        self._found.append(functools.partial(self._give, touching))
        self._confirm(self._book.resolve())
        self._found.append(functools.partial(follower.swing_done, self._swing.touch_belied()))

    def hand_over(self) -> None:
        """Let the follower have what this tick has found, before the next one is taken in."""
        found, self._found = self._found, []
        for hand in found:
            hand()

    def _push(self, verdict: Verdict, detector: LegDetector) -> Push | None:
        """What a tick of a descent shows of a push from the ground; None without geometry."""
        swing = self._swing
        if swing.rising:
            return None
        gradient = swing.height_gradient
        if gradient is None:
            return None
        return push_of(verdict.residual, verdict.target, detector.whitening[0], gradient)

    def _begin_touch(self, detector: LegDetector) -> None:
        self._touching = [detector.touch()]

    def _hand_touch(self) -> None:
        """The first ticks of a contact, for candidate models to be tried on."""
        ticks, self._touching = self._touching, []
        self._give(ticks)

    def _give(self, ticks: list[Touch]) -> None:
        if ticks and self.follower is not None and self.follower.learning:
            self.follower.touched(ticks)

    def _confirm(self, rows: list[Row]) -> None:
        swing, follower = self._swing, self.follower
        if follower is not None and rows and swing.lifted and not swing.held:
            self._found.append(functools.partial(follower.descent, rows, self._region))


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
