r"""Detects two faults of a source that its samples alone give away.

*Echo*: a joint's reading is a copy of its command, of the same tick or of up to three before.  With
:math:`e_k = (y_k - u_{k-L}) / q` in position steps, an echo keeps :math:`e` within one step,
whatever its rounding, while the command speeds up and slows down.  A servo at a steady speed may
do so, too; one that accelerates moves off.  The evidence of a run of such ticks is

.. math:: n \, (\max \dot u - \min \dot u),

with n ticks in which the command moved and :math:`\dot u` in steps a tick (decision 24).

*Swapped phase*: ``swing`` is published for stance and the reverse.  A leg goes as far in its swing
as in its stance, in less time; where the command moves slower in swings than in stances, and comes
down less, they are swapped.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from adaptive_contact.robot import Leg, foot
from adaptive_contact.wire import Doubt, ServoSample

__all__ = ["EchoWatch", "PhaseWatch", "SourceWatch"]

# A copy may be of the command of so many ticks before.
ECHO_TICKS: Final = 3
# Rounding to a grid, down, up or to the nearest step, leaves an echo within an interval of one
# step.  Less than one, so that of commands that lie on the grid nothing but equality is left.
ECHO_WIDTH: Final = 0.998
# A command moves in a tick when it goes further than this, in steps.
MOVED: Final = 0.5
# A run of so many moved ticks, over such a range of speeds (steps a tick), of so much evidence, is
# an echo.  Of 4,537 simulated swings the longest run of a servo over a range of 8 has 6 such
# ticks; real servos have 5 over 3.5, or hundreds at one speed, over 0.4 (decision 24).
LEAST_MOVED: Final = 10
LEAST_RANGE: Final = 3.0
ECHO_EVIDENCE: Final = 90.0
# With so much evidence it is likely enough not to learn from a lift: at the top of a free one, runs
# of servos have none.
SUSPECT_MOVED: Final = 3
SUSPECT_EVIDENCE: Final = 20.0
# It has ended after so many ticks in a row that match no command.
ECHO_OVER: Final = 3
# Step of the coarsest servo known here (AX-12A), by which movements are counted where a servo's own
# is not known; copies are then told by equality, to the precision of a 32-bit float.
UNKNOWN_STEP_RAD: Final = 0.005118
EQUAL_RAD: Final = 2e-6

# Mean speed of a swing's command over that of the stance beside it: 1.28 and more of correct
# phases, at most 0.61 of swapped ones (decision 24).
SWAPPED_RATIO: Final = 0.8
# And the foot's command comes down by less than this share of what it does in stances: by 18 mm and
# more in a swing that meets the ground, by 5 mm at most in 95 of 100 stances.
FALL_SHARE: Final = 0.5
# It comes down in stances by this much, as in any swing.
LEAST_FALL_M: Final = 0.01
# Without geometry the speed alone must say so, in so many swings in a row: a leg that is put
# somewhere else in its stance may be fast, too.
SLOW_SWINGS: Final = 2
# Parts of fewer ticks have no mean speed worth comparing, nor has the beginning of one.
LEAST_TICKS: Final = 3
BEGINNING: Final = 8
# Commands kept of a swing or stance.
PART_TICKS: Final = 400


class _Run:
    """Ticks in a row whose readings lie on the command of a fixed number of ticks before."""

    __slots__ = ("fastest", "high", "low", "moved", "slowest")

    def __init__(self, error: float) -> None:
        self.low = self.high = error
        self.moved = 0
        self.slowest, self.fastest = math.inf, -math.inf  # steps within the run

    @property
    def evidence(self) -> float:
        """Moved ticks by the range of their steps."""
        return self.moved * (self.fastest - self.slowest) if self.moved else 0.0

    @property
    def echoes(self) -> bool:
        """Whether no servo does so."""
        long = self.moved >= LEAST_MOVED and self.fastest - self.slowest >= LEAST_RANGE
        return long and self.evidence >= ECHO_EVIDENCE

    def go_on(self, error: float, step: float) -> bool:
        """Take in a tick; False where it does not belong to the run."""
        low, high = min(self.low, error), max(self.high, error)
        if high - low > ECHO_WIDTH:
            return False
        self.low, self.high = low, high
        if step > MOVED or step < -MOVED:
            self.moved += 1
        self.slowest, self.fastest = min(self.slowest, step), max(self.fastest, step)
        return True


class EchoWatch:
    """Detects joints whose readings copy their commands, of one leg.

    Args:
        joints: J.
        quantum_rad: position step of the servos; None where nobody says, then only copies without
            rounding are found.

    Attributes:
        echoing: joints, by number, found to echo and not yet to have stopped.
    """

    def __init__(self, joints: int, quantum_rad: float | None) -> None:
        self.echoing: set[int] = set()
        self._joints = joints
        step_rad = UNKNOWN_STEP_RAD if quantum_rad is None else quantum_rad
        self._per_rad = 1.0 / step_rad
        self._most_rad = EQUAL_RAD if quantum_rad is None else ECHO_WIDTH * step_rad
        # Newest first, rad; one more than is compared, as steps are between two.
        self._commands: deque[Sequence[float]] = deque(maxlen=ECHO_TICKS + 2)
        self._runs: list[list[_Run | None]] = []
        self._off = [0] * joints  # ticks in a row that match no command
        self.begin()

    @property
    def suspected(self) -> bool:
        """Whether a joint may be echoing, by the swing so far."""
        return any(
            run is not None and run.moved >= SUSPECT_MOVED and run.evidence >= SUSPECT_EVIDENCE
            for runs in self._runs
            for run in runs
        )

    def begin(self) -> None:
        """Count from here on: a swing begins, or what comes does not connect."""
        self._runs = [[None] * (ECHO_TICKS + 1) for _ in range(self._joints)]

    def restart(self) -> None:
        """The commands before are not known."""
        self.begin()
        self._commands.clear()

    def command(self, desired: Sequence[float]) -> None:
        """Take in a sample's command; to be called for every sample, before :meth:`take`."""
        self._commands.appendleft(desired)

    def take(self, measured: Sequence[float], valid: Sequence[bool] | None = None) -> None:
        """Compare a sample's readings with the commands up to its own.

        Args:
            measured: (J,) rad.
            valid: (J,) False where nothing was read.
        """
        most, per_rad, commands = self._most_rad, self._per_rad, list(self._commands)
        for joint, angle in enumerate(measured):
            if valid is not None and not valid[joint]:
                continue
            runs, matched = self._runs[joint], False
            # A step is known of every command but the oldest.
            for lag, (command, before) in enumerate(pairwise(commands)):
                error = angle - command[joint]
                if error > most or error < -most:
                    runs[lag] = None
                    continue
                matched = True
                run, step = runs[lag], (command[joint] - before[joint]) * per_rad
                if run is None or not run.go_on(error * per_rad, step):
                    runs[lag] = _Run(error * per_rad)
                elif run.echoes:
                    self.echoing.add(joint)
            if self.echoing:
                self._off[joint] = 0 if matched else self._off[joint] + 1
                if self._off[joint] >= ECHO_OVER:
                    self.echoing.discard(joint)


class _Part:
    """A swing or a stance, as the samples say.

    Attributes:
        ticks: samples.
        travel: of the command, over all joints, rad.
        commands: the newest, (J,) rad each.
    """

    __slots__ = ("commands", "ticks", "travel")

    def __init__(self) -> None:
        self.ticks = 0
        self.travel = 0.0
        self.commands: deque[Sequence[float]] = deque(maxlen=PART_TICKS)

    @property
    def speed(self) -> float:
        """Mean, rad per tick."""
        return self.travel / max(self.ticks, 1)

    def fall(self, leg: Leg) -> float:
        """Furthest that the commanded foot comes down, m; 0 without geometry."""
        if leg.lengths_m is None:
            return 0.0
        heights = foot(np.array(self.commands), leg.lengths_m, leg.joint_axes)[:, 2]
        return float(np.max(np.maximum.accumulate(heights) - heights))


class PhaseWatch:
    """Detects swapped phases of one leg, whose samples say them.

    Args:
        leg: its description; its lengths are used where they are known.

    Attributes:
        swapped: stance is published as swing.
    """

    def __init__(self, leg: Leg) -> None:
        self.swapped = False
        self._leg = leg
        self._before: Sequence[float] | None = None
        self._part = _Part()
        self._slow = 0  # swings in a row that were slower than the stance before them
        self._swing: bool | None = None
        self._whole = False  # the part in hand has been seen from its beginning
        self._last: dict[bool, _Part | None] = {True: None, False: None}

    def restart(self) -> None:
        """What comes does not connect to what was."""
        self._before = self._swing = None
        self._whole = False
        self._slow = 0
        self._last = {True: None, False: None}

    def take(self, sample: ServoSample) -> None:
        """Take in a sample."""
        phase, desired = sample.phase, sample.desired
        if phase is None:
            if self._swing is not None:
                self.restart()
                self.swapped = False
            return
        swing = phase == "swing"
        if swing is not self._swing:
            self._turn(swing)
        before = self._before or desired
        moved = sum(abs(new - old) for new, old in zip(desired, before, strict=True))
        self._before = desired
        part = self._part
        part.ticks += 1
        part.travel += moved
        part.commands.append(desired)
        if self._whole and part.ticks >= BEGINNING:
            self._compare(swing)

    def _turn(self, swing: bool) -> None:
        """The part in hand is over."""
        over, part = self._swing, self._part
        if over is not None:
            if self._whole and part.ticks >= LEAST_TICKS:
                if over:
                    self._compare(over, ended=True)
                self._last[over] = part
            self._whole = True
        self._swing, self._part = swing, _Part()

    def _compare(self, swing: bool, *, ended: bool = False) -> None:
        """Compare the part in hand with the one beside it."""
        part, beside = self._part, self._last[not swing]
        if beside is None:
            return
        in_swing, in_stance = (part, beside) if swing else (beside, part)
        if self.swapped:
            # Of a swing in hand: what is published as a stance begins slowly, too.
            if swing and in_stance.speed < SWAPPED_RATIO * in_swing.speed:
                self.swapped = False
            return
        slower = in_swing.speed < SWAPPED_RATIO * in_stance.speed
        if ended:
            self._slow = self._slow + 1 if slower else 0
        if slower and self._leg.lengths_m is None:
            self.swapped = self._slow >= SLOW_SWINGS
        elif slower and (ended or not swing):
            fall = in_stance.fall(self._leg)
            self.swapped = fall > LEAST_FALL_M and in_swing.fall(self._leg) <= FALL_SHARE * fall


class SourceWatch:
    """Watches the source of one leg's samples for both faults.

    Args:
        leg: its description.
        quantum_rad: position step of its servos.

    Attributes:
        cause: ``echo`` or ``phase`` while the samples say nothing of the leg, else None.
    """

    def __init__(self, leg: Leg, quantum_rad: float) -> None:
        self.cause: Doubt | None = None
        self._leg = leg
        self._echo = EchoWatch(len(leg.joints), quantum_rad)
        self._phase = PhaseWatch(leg)

    @property
    def suspected(self) -> bool:
        """Whether readings may be copies of commands, by the swing so far."""
        return self._echo.suspected

    @property
    def note(self) -> str | None:
        """One line for a person, None when all is well."""
        if self._echo.echoing:
            names = ", ".join(self._leg.joints[joint] for joint in sorted(self._echo.echoing))
            return (
                f"measured copies desired ({names}): publish the positions that the servos report; "
                "no contacts are reported until then"
            )
        if self._phase.swapped:
            return (
                "phase is swapped: the foot swings while the samples say stance; no contacts are "
                "reported until it is right"
            )
        return None

    def connect(self, *, restart: bool) -> None:
        """Samples were lost, or the source started again."""
        self._echo.restart()
        if restart:
            self._phase.restart()

    def follow(self, sample: ServoSample) -> None:
        """Take in a sample, before its phase is acted upon."""
        self._echo.command(sample.desired)
        self._phase.take(sample)

    def look(self, sample: ServoSample, ticks: int) -> bool:
        """Judge the sample taken in last.

        Args:
            sample: it.
            ticks: samples since the swing began, 1 at its first, 0 in stance.

        Returns:
            Whether :attr:`cause` has changed.
        """
        echo = self._echo
        if ticks == 1:
            echo.begin()
        if ticks or echo.echoing:
            echo.take(sample.measured, sample.valid)
        cause: Doubt | None = "echo" if echo.echoing else None
        if cause is None and self._phase.swapped:
            cause = "phase"
        changed, self.cause = cause is not self.cause, cause
        return changed
