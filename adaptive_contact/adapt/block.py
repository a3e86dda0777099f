"""The arrays of several legs side by side, so that one product serves them all.

Legs whose models are made of the same library lie in one :class:`Block`, a row each.  The trackers
keep looking at their rows: what concerns one leg only (a gap, a restart, a substitute) is done
there, what every leg needs in every tick is done here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.tracker import Tracker, push, take
from adaptive_contact.detect import history_statistic

if TYPE_CHECKING:
    from adaptive_contact.adapt.learner import ContactLearner
    from adaptive_contact.identify import LegModel

__all__ = ["Block", "Verdict"]

Array = NDArray[np.float64]


class Verdict(NamedTuple):
    """What the statistic says of a tick.

    Attributes:
        scores: statistic over threshold for each window, NaN where it reaches too far back.
        distance: of the last residual from zero, whitened and squared, in any direction.
    """

    scores: list[float]
    distance: float

    @property
    def score(self) -> float:
        """The largest."""
        # The window of one tick is always usable; longer ones may be NaN, which `max` passes over
        # when it does not come first.
        return max(self.scores)


class Block:
    """Learners with models of one library, and the arrays of their trackers.

    Args:
        learners: each with a tracker, which moves in.

    Attributes:
        learners: L of them; row i of every array belongs to the i-th.
        trackers: theirs.
        window: (L, lags, J) rad, measured, desired and preview.
        history: (2, L, 3, J) rad, residuals and increments.
        increment: (L, J) rad, predicted for the tick to come.
    """

    def __init__(self, learners: Sequence[ContactLearner]) -> None:
        trackers = [learner.tracker for learner in learners]
        self.learners = tuple(learners)
        self.trackers: tuple[Tracker, ...] = tuple(t for t in trackers if t is not None)
        first = self.trackers[0]
        library = first.model.library
        rows, joints = len(self.trackers), len(library.joints)
        self.window = np.zeros((rows, len(first.window) // joints, joints))
        self.history = np.zeros((2, rows, *first.residuals.shape))
        self.increment = np.zeros((rows, joints))
        for row, tracker in enumerate(self.trackers):
            tracker.move(self, row)
        measured = len(first.measured)
        self._measured = self.window[:, :measured]
        self._desired = self.window[:, measured : measured + len(first.desired)]
        self._flat = self.window.reshape(rows, -1)
        self._library = library
        self._models: list[LegModel | None] = [None] * rows
        self._coefficients = np.zeros((rows, library.size, joints))
        self._whiten = np.array([learner.noise.whiten for learner in learners])
        self._thresholds = np.array([learner.thresholds for learner in learners])
        self._rows = np.arange(rows)

    def take(self, rows: Sequence[int], readings: Sequence[Sequence[float] | Array]) -> None:
        """Take in readings, (J,) rad for each of some rows."""
        if len(rows) == len(self.trackers):
            take(self.history, self.increment, self._measured, np.array(readings))
            return
        for row, reading in zip(rows, readings, strict=True):
            tracker = self.trackers[row]
            take(tracker.history, tracker.increment, tracker.measured, reading)

    def push(self, rows: Sequence[int], commands: Sequence[Sequence[float]]) -> None:
        """Take in commands, (J,) rad for each of some rows."""
        if len(rows) == len(self.trackers):
            push(self._desired, np.array(commands))
            return
        for row, command in zip(rows, commands, strict=True):
            push(self.trackers[row].desired, command)

    def judge(self, rows: Sequence[int]) -> list[Verdict]:
        """What the statistic says of the last tick of some rows."""
        usable = np.array([tracker.usable for tracker in self.trackers])
        where = [learner.context for learner in self.learners]
        said = history_statistic(
            self.history * self._per_unit(), self._whiten[self._rows, where], usable
        )
        scores = (said.value / self._thresholds).tolist()
        distances = said.distance.tolist()
        return [Verdict(scores[row], distances[row]) for row in rows]

    def predict(self, rows: Sequence[int]) -> None:
        """Predict the next tick of some rows from their windows."""
        for row, tracker in enumerate(self.trackers):
            if tracker.model is not self._models[row]:
                self._models[row] = tracker.model
                self._coefficients[row] = tracker.model.coefficients
        theta = self._library.evaluate_flat(self._flat)
        increment = np.matmul(theta[:, None, :], self._coefficients)[:, 0]
        for row in rows:
            self.trackers[row].foresee(theta[row], increment[row])

    def _per_unit(self) -> Array:
        """(L, 1, 1) or (L, 1, J), one over the unit that each row's residuals are told in."""
        units = [learner.unit for learner in self.learners]
        if all(isinstance(unit, float) for unit in units):
            deviation = np.sqrt(np.array(units))[:, None, None]
        else:
            joints = self.increment.shape[1]
            deviation = np.sqrt([np.broadcast_to(unit, joints) for unit in units])[:, None, :]
        return np.asarray(1.0 / deviation)
