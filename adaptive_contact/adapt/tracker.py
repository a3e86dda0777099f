"""One leg's recent past: the window, the prediction, the residuals of this swing.

A reading that is missing, or that no leg could have made, is replaced by its prediction, and the
window is carried through; what is then predicted from it is less certain, and judged so until the
substitute has left the freshest part of the window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.detect import WINDOWS
from adaptive_contact.identify import LegModel

if TYPE_CHECKING:
    from adaptive_contact.adapt.block import Block

__all__ = ["LIFT_OFF_TICKS", "MAX_STEP_RAD_S", "Tracker", "push", "take"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DEPTH: Final = max(WINDOWS)
# Ticks after the command lifts off in which the foot may still be loaded: the servo follows its
# command three to four ticks late, and the stance's load has to let go first.
LIFT_OFF_TICKS: Final = 5
# No position servo of this class turns faster (AX-12A: 6.2 rad/s): a reading further from the one
# before is a fault of the bus, such as the -π that some return for "no answer".
MAX_STEP_RAD_S: Final = 25.0
# A joint that repeats its last reading to the step, while the model expects it to move by this
# many, is more likely stale than stopped dead: it waits a tick, while the other joints are judged;
# and one more while these move as predicted, to within so many steps: ground that stops one joint
# dead does not leave the others alone.
STALE_QUANTA: Final = 3.0
FREE_QUANTA: Final = 2.0
# What a joint can do in a tick is learned from it: a reading off its prediction by more than this
# many times the largest movement ever seen or predicted, and so many steps, is none.  Ground
# that stops a joint dead leaves the prediction by one such movement at most.
REACH: Final = 1.25
REACH_QUANTA: Final = 4.0
# Ticks predicted until the largest is known; about ten swings.
REACH_TICKS: Final = 200
# A value that was refused twice to the last bit is what a failed read leaves behind: where it is
# off the prediction by this many steps, it is doubted for one tick.
KNOWN_QUANTA: Final = 3.0
# Values remembered, a bound on memory.
MAX_VALUES: Final = 8
# So many impossible readings in a row are a new truth (a horn slipped, an offset was set).
MAX_IMPOSSIBLE: Final = 3
# A reading earlier than this, in periods, is moved by no more: its noise would grow with it.
MOST_EARLY: Final = -0.5
# Ticks after a substitute in which the prediction leans on it most (velocity terms), and the
# factor on the residual's variance there: a substitute errs by a whole residual, a reading by two
# thirds of one.
UNSURE_TICKS: Final = 2
UNSURE_VARIANCE: Final = 2.5


class Tracker:
    """Ring-free small arrays, lag 0 first: shifting a handful of rows is cheaper than indexing.

    Args:
        model: that predicts.
        quantum_rad: position step of the servos.

    Attributes:
        home: where the arrays live together with those of other legs; None for its own.
        window: (w,) what a prediction is made from, in a row: ``measured``, ``desired``,
            ``preview``.
        history: (2, 3, J) rad, ``residuals`` of the last ticks, and the ``increments`` that were
            predicted for them.
        increment: (J,) rad, predicted for the tick to come, while ``predicted``.
        theta: (p,) regressors of that prediction.
        thetas: and those of the ticks observed, lag 0 first.
        filled: samples in the window.
        inflation: of the variance of the last residual.
        lateness: of the reading to come, periods after its tick; 0 where it is on time.
        usable: sound residuals of this swing, newest first.
        refused: readings of joints that were refused since the learner last counted them.
    """

    def __init__(self, model: LegModel, quantum_rad: float) -> None:
        library = model.library
        joints = len(library.joints)
        self.model = model
        self.home: Block | None = None
        self._length = library.window.length
        self._measured = library.window.past_measured + 1
        self._commands = self._measured + library.window.past_desired + 1
        rows = self._commands + library.window.preview
        self._look_at(np.zeros((rows, joints)), np.zeros((2, DEPTH, joints)), np.zeros(joints))
        self.theta: Array | None = None
        self.thetas: tuple[Array, ...] = ()
        self.filled = 0
        self.predicted = False
        self.inflation = 1.0
        self.lateness = 0.0
        self.usable = 0
        self._sound, self._bad = True, False  # the reading taken last
        self._max_step = MAX_STEP_RAD_S * library.period_s
        self._stale_step = STALE_QUANTA * quantum_rad
        self._free_step = FREE_QUANTA * quantum_rad
        self._none_stale = np.zeros(joints, dtype=np.int64)
        self._stale = self._none_stale  # ticks in a row for which a joint has been doubted
        self._last: Sequence[float] | None = None
        self._impossible = 0
        self._refused: Mask = np.zeros(joints, dtype=bool)
        self._unsure = 0
        self.refused = 0
        self._reach = [0.0] * joints  # rad, largest movement predicted for a tick
        self._reach_ticks = 0
        self._allowance = REACH_QUANTA * quantum_rad
        self._known_step = KNOWN_QUANTA * quantum_rad
        self._believed: Sequence[float] = ()  # the newest reading of each joint not refused
        self._doubts = [False] * joints  # whether the last reading of a joint was doubted
        self._none_doubted = self._doubts
        self._values: dict[float, int] = {}  # times refused, of any joint

    def move(self, home: Block, row: int) -> None:
        """Live with others: the arrays become a row of theirs, with the values they have."""
        home.window[row] = self._window
        home.history[:, row] = self.history
        home.increment[row] = self.increment
        self.home = home
        self._look_at(home.window[row], home.history[:, row], home.increment[row])

    def _look_at(self, window: Array, history: Array, increment: Array) -> None:
        # One array, so that a prediction needs no copying together.
        self._window, self.history, self.increment = window, history, increment
        self.measured = window[: self._measured]
        self.desired = window[self._measured : self._commands]
        self.preview = window[self._commands :]
        self.window = window.reshape(-1)
        self.residuals, self.increments = history

    @property
    def substituted(self) -> bool:
        """Whether a joint's reading taken last is none, but what the model foretold."""
        return self._bad

    @property
    def full(self) -> bool:
        """Whether the window holds enough samples in a row for a prediction."""
        return self.filled >= self._length

    def restart(self) -> None:
        """Drop the past: what comes does not connect to it."""
        self.filled = 0
        self.predicted = False
        self.usable = 0
        self._impossible = 0
        self._doubts = self._none_doubted
        self._unsure = 0

    def begin_swing(self) -> None:
        """Residuals of the stance before say nothing about this swing."""
        self.usable = 0

    def observe(self, measured: Sequence[float], valid: Sequence[bool] | None) -> bool:
        """Take in a reading.

        Args:
            measured: (J,) rad.
            valid: (J,) False where the reading is known to be bad; None if all are good.

        Returns:
            Whether this tick's residual can be judged.
        """
        take(self.history, self.increment, self.measured, self.repair(measured, valid))
        return self.judge()

    def judge(self) -> bool:
        """Whether the residual of the reading just taken can be judged; to be asked once."""
        if self.predicted:
            assert self.theta is not None
            self.thetas = (self.theta, *self.thetas[: DEPTH - 1])
        self.inflation = 1.0
        if self._bad:  # the joints that did answer are judged all the same
            self._unsure = UNSURE_TICKS
            self.inflation = UNSURE_VARIANCE
        elif self._unsure:
            self._unsure -= 1
            self.inflation = UNSURE_VARIANCE
        judged = self.predicted and self._sound
        self.usable = min(self.usable + 1, DEPTH) if judged else 0
        return judged

    def command(self, desired: Sequence[float] | Array, preview: Array | None) -> bool:
        """Take in the command written after the reading.

        Returns:
            Whether a prediction can be made from the window.
        """
        push(self.desired, desired)
        return self.commanded(preview)

    def commanded(self, preview: Array | None) -> bool:
        """A command has been taken; whether a prediction can be made from the window."""
        if self.filled < self._length:
            self.filled += 1
        ahead = len(self.preview)
        if ahead:
            if preview is None or len(preview) < ahead:
                self.predicted = False
                return False
            self.preview[:] = preview[:ahead]
        return self.full

    def bridge(self, desired: Array, missed: int) -> None:
        """Fill a short gap by the model's own predictions.

        Args:
            desired: (J,) rad, the command known after the gap; between, commands are
                interpolated.
            missed: samples lost, at most what the window spans.
        """
        last = self.desired[0].copy()
        for lost in range(1, missed + 1):
            if not self._foreseen():
                self.restart()
                return
            self.observe((self.measured[0] + self.increment).tolist(), None)
            self.usable = 0
            share = lost / (missed + 1)
            self.command(last + share * (desired - last), None)
            self.predicted = False  # what it was made from is a tick old
            self._foreseen()
        self._unsure = UNSURE_TICKS

    def foresee(self, theta: Array, increment: Array) -> None:
        """Keep the movement predicted for the tick to come; one that is not finite is dropped.

        Args:
            theta: (p,) regressors of the prediction.
            increment: (J,) rad.
        """
        self.predicted = math.isfinite(sum(increment.tolist()))
        if self.predicted:
            self.theta = theta
            self.increment[:] = increment

    def repair(
        self, measured: Sequence[float], valid: Sequence[bool] | None
    ) -> Sequence[float] | Array:
        """The reading as it is to enter the window, (J,) rad, with substitutes for what is bad.

        Plain floats decide, as nearly every reading is good.
        """
        substituted, self._sound, self._bad = self._bad, True, False
        last, self._last = self._last, measured
        if self.filled == 0 or last is None:
            self._believed = measured
            return measured
        steps = [abs(new - old) for new, old in zip(measured, last, strict=True)]
        # A joint moves from where it was taken to be: a reading that was none is no such place.
        jumps = steps
        if substituted:
            accepted = self.measured[0].tolist()
            jumps = [abs(new - old) for new, old in zip(measured, accepted, strict=True)]
        missing = None
        if valid is not None and not all(valid):
            missing = ~np.array(valid, dtype=bool)
            jumps = [jump if good else 0.0 for jump, good in zip(jumps, valid, strict=True)]
        bad = impossible = None
        if max(jumps) > self._max_step:
            self._impossible += 1
            if self._impossible > MAX_IMPOSSIBLE:
                self.restart()
                self._believed = measured
                return measured
            bad = self._refused = np.array(jumps) > self._max_step
            impossible = bad.tolist()
        elif self._impossible and (missing is None or not (missing & self._refused).any()):
            self._impossible = 0  # whoever was refused has brought a reading to believe
        doubts = self._beyond_reach(measured, last, valid, impossible)
        if doubts is None and impossible is not None:
            self._remember(measured, impossible)
        if doubts is not None:
            if not any(doubts):  # two in a row that agree
                self.restart()
                self._believed = measured
                return measured
            bad = np.array(doubts) if bad is None else bad | np.array(doubts)
        if self.predicted and not all(steps) and self._doubtful(steps):
            stale = self._stale_joints(np.array(measured), np.array(steps), missing)
            if stale.any():
                bad = stale if bad is None else bad | stale
        else:
            self._stale = self._none_stale
        if missing is not None:
            bad = missing if bad is None else bad | missing
        if bad is None:
            self._believed = measured
            return self._on_time(measured) if self.lateness else measured
        self._bad, self._sound = True, not bad.all()
        self._believed = [
            old if refused else new
            for new, old, refused in zip(measured, self._believed, bad.tolist(), strict=True)
        ]
        substitute = self.measured[0] + self.increment if self._foreseen() else self.measured[0]
        return np.where(bad, substitute, self._on_time(measured) if self.lateness else measured)

    def _beyond_reach(
        self,
        measured: Sequence[float],
        last: Sequence[float],
        valid: Sequence[bool] | None,
        impossible: Sequence[bool] | None,
    ) -> list[bool] | None:
        """Which joints read what they cannot have reached in a tick.

        Returns:
            None where none do; all False where a joint has said so twice: that is where it is.
        """
        before, self._doubts = self._doubts, self._none_doubted
        reach, expected = self._reach, None
        # A model that is another leg's may predict no movement at all; the leg moves all the same.
        moved = np.abs(np.diff(self.measured, axis=0)).max(axis=0).tolist()
        if self.predicted:
            expected = self.increment.tolist()
            for j, step in enumerate(expected):
                largest = max(abs(step), moved[j])
                if largest > reach[j]:
                    reach[j] = min(largest, self._max_step)
            self._reach_ticks += 1
        limits = [min(REACH * most + self._allowance, self._max_step) for most in reach]
        learned = self._reach_ticks >= REACH_TICKS
        known = [self._values.get(new, 0) > 1 for new in measured]
        # A joint that the ground stops stays where it was last: no doubt of that.
        jumps = [abs(new - old) for new, old in zip(measured, self._believed, strict=True)]
        if expected is None:
            # Between swings a prediction is made only for what needs one.
            suspect = learned and any(
                jump > limit for jump, limit in zip(jumps, limits, strict=True)
            )
            if not suspect and not any(known):
                return None
            if not self._foreseen():
                # Nothing says which of two places is right; the newer one is where it goes on.
                return self._none_doubted if suspect else None
            expected = self.increment.tolist()
            recent = limits
        else:
            rows = [expected, moved, *self.increments.tolist()]
            recent = [
                REACH * max(map(abs, column)) + self._allowance
                for column in zip(*rows, strict=True)
            ]
        doubts: list[bool] = []
        agreed = False
        offs = [
            min(abs(new - old - step), jump)
            for new, old, step, jump in zip(
                measured, self.measured[0].tolist(), expected, jumps, strict=True
            )
        ]
        for j, off in enumerate(offs):
            beyond = learned and off > limits[j]
            once = off > recent[j] or (known[j] and off > self._known_step)
            doubt = beyond or (once and not before[j])
            if valid is not None and not valid[j]:
                doubt = beyond = False
            if beyond and before[j] and not known[j] and abs(measured[j] - last[j]) <= limits[j]:
                agreed = True
            doubts.append(doubt)
        refused = {new for new, bad in zip(measured, doubts, strict=True) if bad}
        if impossible is not None:
            refused.update(new for new, bad in zip(measured, impossible, strict=True) if bad)
        if not refused:
            return None
        if agreed:
            return self._none_doubted
        # A read that failed for one joint and left the same in others failed for them, too.
        for j, off in enumerate(offs):
            good = valid is None or valid[j]
            if measured[j] in refused and off > self._known_step and good:
                doubts[j] = True
        self._remember(measured, doubts)
        self._doubts = doubts
        return doubts

    def _remember(self, measured: Sequence[float], refused: Sequence[bool]) -> None:
        """Count refused readings, and keep their values: one that returns is no movement."""
        values = self._values
        found = [value for value, bad in zip(measured, refused, strict=True) if bad]
        self.refused += len(found)
        for value in set(found):
            values[value] = values.pop(value, 0) + 1
            if len(values) > MAX_VALUES:
                # Once refused goes before twice refused, the oldest first.
                del values[min(values, key=lambda kept: min(values[kept], 2))]

    def _on_time(self, measured: Sequence[float]) -> Array:
        """Where the leg was at its tick, (J,) rad, by the way that it has gone since the last."""
        before = self.measured[0]
        step = (np.array(measured) - before) / (1.0 + max(self.lateness, MOST_EARLY))
        return np.asarray(before + step)

    def _foreseen(self) -> bool:
        """Whether there is a prediction for the tick to come; made now if there can be one."""
        if not self.predicted and self.full and not len(self.preview):
            theta = self.model.library.evaluate_flat(self.window)
            self.foresee(theta, theta @ self.model.coefficients)
        return self.predicted

    def _doubtful(self, steps: Sequence[float]) -> bool:
        """Whether a joint repeats its last reading while the model has it move."""
        limit = self._stale_step
        return any(
            step == 0.0 and abs(expected) > limit
            for step, expected in zip(steps, self.increment.tolist(), strict=True)
        )

    def _stale_joints(self, reading: Array, steps: Array, missing: Mask | None) -> Mask:
        """Which joints repeat their last reading while the model has them move."""
        still: Mask = (steps == 0.0) & (np.abs(self.increment) > self._stale_step)
        if missing is not None:  # known to be bad: no doubt is used up
            still &= ~missing
        if not still.any():
            self._stale = self._none_stale
            return still
        free = np.abs(reading - self.measured[0] - self.increment) < self._free_step
        known = free | still if missing is None else free | still | missing
        most = 2 if known.all() and not still.all() else 1
        stale: Mask = still & (self._stale < most)
        self._stale = np.where(stale, self._stale + 1, 0)
        return np.asarray(stale)


def take(
    history: Array, increment: Array, measured: Array, reading: Sequence[float] | Array
) -> None:
    """Shift readings into windows, and what they leave of the predictions into histories.

    What is entered where nothing was predicted means nothing, and is never counted as usable.

    Args:
        history: (2, ..., 3, J) rad.
        increment: (..., J) rad that were predicted.
        measured: (..., N + 1, J) rad.
        reading: (..., J) rad.
    """
    history[..., 1:, :] = history[..., :-1, :]
    newest = history[..., 0, :]
    newest[1] = increment
    np.subtract(reading, measured[..., 0, :], out=newest[0])
    newest[0] -= increment
    push(measured, reading)


def push(rows: Array, newest: Sequence[float] | Array) -> None:
    """Shift the newest of (..., J) into (..., lags, J), lag 0 first."""
    rows[..., 1:, :] = rows[..., :-1, :]
    rows[..., 0, :] = newest
