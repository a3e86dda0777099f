"""Where a leg is in its swing: phase, direction, and whether the foot follows its command."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.tally import RECENT_TICKS
from adaptive_contact.adapt.tracker import LIFT_OFF_TICKS
from adaptive_contact.robot import Leg, foot_point, height_gradient
from adaptive_contact.robot.phase import Direction, PhaseTracker
from adaptive_contact.wire import ServoSample

__all__ = ["Foretell", "SwingWatch"]

_Place = tuple[float, float, float]  # of a foot, in its leg's frame, m
Foretell = Callable[[Sequence[Sequence[float]]], Sequence[NDArray[np.float64]]]

# A command that takes the foot no further says nothing of whether it follows.
LEAST_WAY_M: Final = 0.015
# A foot that has come less than this share of its command's way by the top of the lift is held:
# caught ones 95 times in 100; free ones, those of tired legs among them, 1 to 4 times.  It is taken
# for free again above the second share, which free ones reach 9 times in 10.
HELD_SHARE: Final = 0.75
FREE_SHARE: Final = 0.9
# Readings that fall by more than this share of their command's rise are turned around: what hangs
# on a foot pulls it down by less.
TURNED_SHARE: Final = 0.5
# A hold is forgotten after so many lifts in a row that tell nothing of it: what they leave of the
# model decides then, as it would have without.
FORGET_SWINGS: Final = 5
# Ticks by which a servo's foot is behind its command.
LAG_TICKS: Final = 3
# A foot this far above where it stood has left the ground.  Ground that gives, and legs that were
# pressed, let it rise before that: by less in all but one tick in a thousand on hard ground and
# on soft.
CLEARANCE_M: Final = 0.015
# Ground that gives is felt late, and a foot rises out of it for long: where it begins its swing so
# far below the onset that was told, it is off the ground only above where it was so many ticks
# before that onset.
SUNK_M: Final = 0.006
SURFACE_TICKS: Final = 3
SOFT_TICKS: Final = 12  # by then it is, all the same
HEIGHTS: Final = 12  # ticks remembered
# A lift in which the foot has risen by less says nothing of the leg: it may never have left the
# ground.
LIFTED_M: Final = 0.006
# A foot is clear in this tick at the latest: the last pressed one let go in the 9th of its swing.
CLEAR_TICKS: Final = 11
# A touch told where the foot has come down by less than this share of its rise is told early.
EARLY_SHARE: Final = 1 / 3
# Commands kept of one swing, to foretell where they take a foot; 8 s, as long as the slowest.
PATH_TICKS: Final = 400
# Without geometry the first half of a swing stands for its lift, if it holds enough ticks after the
# foot has let go; the shortest of the last few swings says how long they are.
LIFT_TICKS: Final = 10
SWINGS: Final = 5
# Ticks after the turn to stance in which a foot that has not touched may still do so: a servo is
# three or four behind its command, and on rough ground the last feet touch when others lift off.
AFTER_TICKS: Final = 16
# Samples in a row after which a leg whose command and readings all stay as they are is not on its
# way any more: a foot that comes down moves at least one joint's reading by a step.
STILL_TICKS: Final = 2
# A swing counts as one without a touch where no tick after its turn reaches this share of the
# threshold: of 240 such swings five had a touch that lasted 40 ms (decision 27).
QUIET_SCORE: Final = 0.3
# Touches come late where most of the last so many begin after the turn.
LANDINGS: Final = 20


class Landings:
    """Counts how the swings of one leg end: late touches, and none at all.

    Attributes:
        untouched: swings that ended without a sign of a touch.
        untouched_ns: when the late judging of the last of them was over; None before the first.
    """

    def __init__(self) -> None:
        self.untouched = 0
        self.untouched_ns: int | None = None
        self._quiet = 0  # ticks in a row after the turn
        self._late: deque[int] = deque(maxlen=LANDINGS)  # ticks after the turn, 0 for before it

    def look(self, score: float, *, sure: bool) -> None:
        """Take in a tick after the turn.

        Args:
            score: statistic over threshold.
            sure: the leg is judged by a model that fits it.
        """
        self._quiet = self._quiet + 1 if sure and score < QUIET_SCORE else 0

    def touched(self, after: int) -> None:
        """A touch was reported that began so many ticks after the turn, 0 or less for before it."""
        self._late.append(max(after, 0))

    def end(self, t_ns: int, *, expired: bool) -> None:
        """The swing is over.

        Args:
            t_ns: now.
            expired: its late judging took all of its 16 ticks.
        """
        if expired and self._quiet >= AFTER_TICKS:
            self.untouched += 1
            self.untouched_ns = t_ns
        self._quiet = 0

    @property
    def note(self) -> str | None:
        """One line for a person when most touches come after the turn."""
        late = sorted(ticks for ticks in self._late if ticks)
        if 2 * len(late) <= LANDINGS:
            return None
        return (
            f"{len(late)} of the last {len(self._late)} touches came after phase had turned to "
            f"stance, by {late[len(late) // 2]} ticks: send swing until the foot can have arrived"
        )


class SwingWatch:
    """Follows the phase and the foot's heights of one leg.

    Attributes:
        ticks: samples since the swing began, 1 at its first, 0 when it is over.
        after: those of them after the turn to stance, while a touch is awaited; 0 before.
        expired: the swing ends with this sample, 16 ticks after its turn, without a touch.
        direction: of the command in force.
        rising: the measured foot went up in this tick; without geometry, the time says so.
        cleared: the foot was off the ground before this tick began, whatever residuals say.
        held: the foot does not follow its command: something holds it, or it has no strength.
        came: share of its command's way that the foot went in the last lift that told; of a leg
            that does not go all of it, of the way that its model foretells.
        whole: the swing in hand began after a stance that was seen, and went on without a break.
    """

    def __init__(self, leg: Leg) -> None:
        self.ticks = self.after = 0
        self.expired = False
        self.direction = Direction.DESCENT
        self.rising = False
        self.cleared = False
        self.held = False
        self.came = 1.0
        self.whole = False
        self._stood = False  # since the source began, or broke off
        self._leg = leg
        self._axes = leg.joint_axes
        self._phase = None if leg.lengths_m is None else PhaseTracker()
        self._told = False
        self._untold = 0  # of the newest samples, those whose phase could not be told
        self._last_desired: Sequence[float] | None = None
        self._last_measured: Sequence[float] | None = None  # with substitutes for bad readings
        self._last_read: Sequence[float] | None = None  # as it came
        self._still = 0  # samples in a row that repeat the one before
        self._commanded: _Place = (0.0, 0.0, 0.0)
        self._measured: _Place = self._commanded
        self._commanded_up = False
        self._start: _Place = self._measured
        self._rise = self._moved = 0.0
        self._unasked = 0  # lifts in a row that told nothing of a hold
        self._path: list[Sequence[float]] = []  # commands of the swing
        self._path_seq = (0, 0)  # of the first and the last of them
        self._asked: deque[float] = deque([0.0], maxlen=LAG_TICKS + 1)
        self._lengths: deque[int] = deque(maxlen=SWINGS)  # of swings, ticks
        self._heights: deque[float] = deque(maxlen=HEIGHTS)  # m, newest last
        self._surface = -math.inf  # height of soft ground that the swing began in, m
        self._touch: tuple[float, float] | None = None  # heights at a touch, and before it
        self._low = math.inf  # height of the foot, the lowest of the swing so far, m
        self._top = -math.inf  # height of the foot, the highest of the swing so far, m
        self._fallen: float | None = None  # from there to where its first touch began, m

    @property
    def blind(self) -> bool:
        """Whether swings cannot be told without the samples' own word."""
        return self._phase is None

    @property
    def measures(self) -> bool:
        """Whether the foot's height is known; without geometry, time stands for it."""
        return self._leg.lengths_m is not None

    @property
    def descending(self) -> bool:
        """Whether the command in force is past the lift; without geometry, the time says so."""
        if self._leg.lengths_m is None:
            return self.ticks > max(2 * LIFT_OFF_TICKS, self._half)
        return self.direction is Direction.DESCENT and self.ticks > LIFT_OFF_TICKS

    @property
    def deaf(self) -> bool:
        """Whether swings are too short to hear of changes without the leg's geometry."""
        return self._leg.lengths_m is None and bool(self._lengths) and self._half < LIFT_TICKS

    @property
    def blind_note(self) -> str | None:
        """One line for a person when swings cannot be told at all."""
        if not (self._untold and self.blind):
            return None
        return (
            "samples carry no phase and robot.toml no lengths_m: swings cannot be told, contacts "
            "are not reported"
        )

    @property
    def deaf_note(self) -> str | None:
        """One line for a person when changes of the leg cannot be heard."""
        if not self.deaf:
            return None
        return (
            "robot.toml has no lengths_m, and swings are shorter than 0.4 s: changes of the leg "
            "are not followed; give the lengths of its links"
        )

    @property
    def _half(self) -> int:
        return min(self._lengths, default=0) // 2

    @property
    def lifted(self) -> bool:
        """Whether the foot has come up at all; without geometry, its command's word is taken."""
        return self._leg.lengths_m is None or self._rise > LIFTED_M

    @property
    def height_gradient(self) -> NDArray[np.float64] | None:
        """(J,) m per rad, how the foot rises with each joint where it is; None without geometry."""
        if self._leg.lengths_m is None or self._last_measured is None:
            return None
        return height_gradient(self._last_measured, self._leg.lengths_m, self._axes)

    def judge_lift(self, foretell: Foretell | None = None) -> bool | None:
        """Whether the foot is held, told at the top of a lift; None where little was asked of it.

        Counted from where the foot was: after a touch it starts higher than its command.

        Args:
            foretell: where the commands of a swing take a leg that nothing holds, (J,) rad each;
                asked only of a foot that is behind.
        """
        asked = self._asked[0]
        if asked <= LEAST_WAY_M:
            # Of a gait of small steps nobody could ever tell that the foot is free again.
            self._unasked += 1
            if self._unasked >= FORGET_SWINGS:
                self.held = False
            return None
        self._unasked = 0
        self.came = self._moved / asked
        enough = FREE_SHARE if self.held else HELD_SHARE
        first, last = self._path_seq
        if self.came < enough and foretell is not None and last - first + 1 == len(self._path):
            # Servos that are slow for this gait never bring the foot where the command was.
            foretold = foretell(self._path)
            places = [self._place(angles.tolist()) for angles in foretold]
            way = max((math.dist(place, self._start) for place in places), default=0.0)
            whole = len(places) == len(self._path)  # else the model ran away
            if whole and LEAST_WAY_M < way < FREE_SHARE * asked:
                self.came = self._moved / way
        if self._turned_around():
            self.came = 0.0
        self.held = self.came < enough
        return self.held

    def _turned_around(self) -> bool:
        """Whether readings went down instead of up, by most of what the command rose."""
        fell = self._start[2] - self._low
        if self.lifted or fell < LEAST_WAY_M * TURNED_SHARE:
            return False
        heights = [self._place(angles)[2] for angles in self._path]
        asked = max(heights) - min(heights[0], self._start[2])
        return asked > LEAST_WAY_M and fell > TURNED_SHARE * asked

    def touch_belied(self) -> bool | None:
        """Whether the swing that ends told a touch where its foot had hardly begun to come down.

        Returns:
            None where it cannot be told; False also where no touch was told.
        """
        if not (self.measures and self.whole and self.lifted) or self.held:
            return None
        return self._fallen is not None and self._fallen < EARLY_SHARE * self._rise

    def interrupt(self) -> None:
        """What comes does not connect to what was: it may be another swing already."""
        self.whole = self._stood = False

    def restart(self) -> None:
        """The source started anew."""
        self.interrupt()
        self.ticks = self.after = self._unasked = 0
        self.held = False
        self._surface, self._touch = -math.inf, None
        self._heights.clear()
        self._last_desired = self._last_measured = self._last_read = None
        if self._phase is not None:
            self._phase = PhaseTracker()

    def follow(
        self,
        sample: ServoSample,
        awaited: bool = False,
        end: Callable[[], None] = lambda: None,
    ) -> None:
        """Take in the sample's phase, and in a swing the place its command sends the foot to.

        Args:
            sample: the next.
            awaited: the foot is in the air, as far as is known: in stance the swing goes on for up
                to 16 ticks.
            end: called where the next swing begins before these are over, while all that is known
                of the one in hand still stands.
        """
        phase = sample.phase
        place: _Place | None = None
        if phase is None and self._phase is not None:
            place = self._place(sample.desired)
            if self._told:  # what was inferred before lies too far back
                self._phase = PhaseTracker()
            phase = self._phase.update(place[2])
        self._told = sample.phase is not None
        self._untold = RECENT_TICKS if phase is None else max(self._untold - 1, 0)
        if phase == "swing":
            if self.after:
                end()
                self.ticks = self.after = 0
            self.ticks += 1
            self._still = 0
        else:
            self._stand(sample, awaited=awaited)
        if self.ticks == 1:
            self.whole = self._stood
        # Between swings nobody asks for places, and four in five ticks lie there.
        if phase == "swing" and self._leg.lengths_m is not None:
            if self.ticks == 1:
                self._path, self._path_seq = [], (sample.seq, sample.seq)
                self._commanded = self._place(self._last_desired or sample.desired)
                self._start = self._measured = self._place(self._last_measured or sample.measured)
                self._rise = self._moved = 0.0
                self._asked.clear()
                self._asked.append(0.0)
                at, before = self._touch or (-math.inf, -math.inf)
                self._surface = before if self._start[2] < at - SUNK_M else -math.inf
                self._touch = None
                self._top, self._fallen = self._start[2], None
                self._low = self._start[2]
            if len(self._path) < PATH_TICKS:  # what is longer is not foretold
                self._path.append(sample.desired)
            self._path_seq = (self._path_seq[0], sample.seq)
            now = place or self._place(sample.desired)
            self._commanded_up = now[2] > self._commanded[2]
            self._commanded = now
        self._last_desired, self._last_read = sample.desired, sample.measured

    def _stand(self, sample: ServoSample, *, awaited: bool) -> None:
        """The gait says stance: the swing is over, or waits for the touch."""
        same = sample.desired == self._last_desired and sample.measured == self._last_read
        self._still = self._still + 1 if same else 0
        self._stood = True
        if self.ticks and self.whole and not self.after:
            self._lengths.append(self.ticks)
        self.expired = self.after == AFTER_TICKS and awaited
        if self.ticks and awaited and self.after < AFTER_TICKS and self._still < STILL_TICKS:
            self.ticks += 1
            self.after += 1
            self._commanded_up = False  # wherever the body goes, the foot comes down
        else:
            self.ticks = self.after = 0

    def observe(self, measured: Sequence[float]) -> None:
        """Take in where the leg is, (J,) rad, with substitutes for bad readings."""
        self._last_measured = measured
        if not self.ticks:
            return
        if self._leg.lengths_m is None:
            self.cleared = self.ticks >= CLEAR_TICKS
            self.rising = self._half >= LIFT_TICKS and LIFT_OFF_TICKS < self.ticks <= self._half
            return
        out = self._measured[2] > self._surface or self.ticks >= SOFT_TICKS
        self.cleared = out and (self._rise > CLEARANCE_M or self.ticks >= CLEAR_TICKS)
        now = self._place(measured)
        self.rising = now[2] > self._measured[2]
        self._measured = now
        self._heights.append(now[2])
        if self.after:
            return  # where the stance takes the foot says nothing of whether it lifted or is held
        self._top = max(self._top, now[2])
        self._low = min(self._low, now[2])
        self._rise = max(self._rise, now[2] - self._start[2])
        self._moved = max(self._moved, math.dist(now, self._start))
        self._asked.append(math.dist(self._commanded, self._start))

    def touched(self, ticks: int) -> None:
        """A touch was told, with its onset so many ticks ago."""
        if self._heights:
            back = [min(past, len(self._heights) - 1) for past in (ticks, ticks + SURFACE_TICKS)]
            self._touch = (self._heights[-1 - back[0]], self._heights[-1 - back[1]])
            if self._fallen is None:
                self._fallen = self._top - self._heights[-1 - back[0]]

    def command(self) -> None:
        """The sample's command is now in force."""
        if self._leg.lengths_m is not None:
            self.direction = Direction.LIFT if self._commanded_up else Direction.DESCENT

    def _place(self, angles: Sequence[float]) -> _Place:
        assert self._leg.lengths_m is not None
        return foot_point(angles, self._leg.lengths_m, self._axes)
