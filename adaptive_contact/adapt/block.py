"""The arrays of several legs side by side, so that one product serves them all.

Legs whose models are made of the same library lie in one :class:`Block`, a row each.  The trackers
keep looking at their rows: what concerns one leg only (a gap, a restart, a substitute) is done
there, what every leg needs in every tick is done here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.detector import LegDetector, Verdict
from adaptive_contact.adapt.tracker import Tracker, push, take
from adaptive_contact.detect import WINDOWS, whitened
from adaptive_contact.identify import ChangeLibrary

if TYPE_CHECKING:
    from adaptive_contact.identify import LegModel

__all__ = ["Block"]

Array = NDArray[np.float64]


class Block:
    """Detectors with models of one library, and the arrays of their trackers.

    Args:
        detectors: whose trackers move in.

    Attributes:
        detectors: L of them; row i of every array belongs to the i-th.
        trackers: theirs.
        window: (L, lags, J) rad, measured, desired and preview.
        history: (2, L, 3, J) rad, residuals and increments.
        increment: (L, J) rad, predicted for the tick to come.
    """

    def __init__(self, detectors: Sequence[LegDetector]) -> None:
        self.detectors = tuple(detectors)
        self.trackers: tuple[Tracker, ...] = tuple(d.tracker for d in detectors)
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
        # The legs' libraries differ in what their first models foretell.
        libraries = [t.model.library for t in self.trackers]
        changing = [of for of in libraries if isinstance(of, ChangeLibrary)]
        self._foretelling = _stacked([of.foretelling for of in changing])
        self._softening = _stacked([of.softening for of in changing])
        # Whitening of each row's tick in hand, and what it was made for: context, unit, revision.
        self._whiten = np.zeros((rows, len(WINDOWS), joints, joints))
        self._made_for: list[tuple[int, float, int] | None] = [None] * rows

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
        for row in rows:
            self._whiten_for(row)
        square, product = whitened(self.history, self._whiten)
        squares, products = square.tolist(), product.tolist()
        # Copies: who keeps them must not see the next tick's.
        residual = self.history[0, :, 0].copy()
        target = residual + self.history[1, :, 0]
        said = []
        for row in rows:
            usable = self.trackers[row].usable
            detector = self.detectors[row]
            if detector.gradient is not None:
                products[row] = self._against_ground(row, detector.gradient)
            # For three windows plain floats are faster than arrays.
            scores = [
                math.nan if ticks > usable else value / limit if opposes < 0.0 else 0.0
                for ticks, value, opposes, limit in zip(
                    WINDOWS,
                    squares[row],
                    products[row],
                    detector.limits,
                    strict=True,
                )
            ]
            said.append(Verdict(scores, squares[row][0], residual[row], target[row]))
        return said

    def _against_ground(self, row: int, gradient: Array) -> list[float]:
        """(windows,) the whitened sums' product with a step down, below zero for a push up.

        A foot about to stand has arrived, and what it is predicted to do says nothing of where the
        ground is: a servo overshoots, and comes back.
        """
        whiten = self._whiten[row]
        pushed = np.matvec(whiten, self.history[0, row].cumsum(axis=0))
        said: list[float] = np.vecdot(pushed, np.matvec(whiten, -gradient)).tolist()
        return said

    def predict(self, rows: Sequence[int]) -> None:
        """Predict the next tick of some rows from their windows."""
        for row in rows:
            model = self.trackers[row].model
            if model is not self._models[row]:
                self._models[row] = model
                self._coefficients[row] = model.coefficients
        theta = self._regressors()
        increment = np.matmul(theta[:, None, :], self._coefficients)[:, 0]
        if math.isfinite(increment.sum()):  # so that each of them is
            self.increment[rows] = increment[rows]
            for row in rows:
                tracker = self.trackers[row]
                tracker.theta, tracker.predicted = theta[row], True
            return
        for row in rows:
            self.trackers[row].foresee(theta[row], increment[row])

    def _regressors(self) -> Array:
        """(L, p) of the windows, each by its own leg's library."""
        library = self._library
        if not isinstance(library, ChangeLibrary):
            return library.evaluate_flat(self._flat)
        theta, softer = library.parts(self._flat)
        foretold = np.matmul(theta[:, None, :], self._foretelling)[:, 0]
        parts = [theta, np.tanh(foretold, out=foretold)]
        if library.knows_law:
            parts.append(np.matmul(softer[:, None, :], self._softening)[:, 0])
        return np.concatenate(parts, axis=1)

    def _whiten_for(self, row: int) -> None:
        """Make a row's whitening that of its tick, which most often is that of the tick before."""
        detector = self.detectors[row]
        context, unit = detector.context, detector.unit
        if isinstance(unit, float):
            made_for = (context, unit, detector.recent.revision)
            if self._made_for[row] == made_for:
                return
            self._made_for[row] = made_for
        else:
            self._made_for[row] = None
        self._whiten[row] = detector.whitening


def _stacked(of_legs: Sequence[Array]) -> Array:
    """(L, ...) of L alike; nothing of none."""
    return np.stack(of_legs) if of_legs else np.zeros(0)
