"""Owns the model in force, and the recursion that moves it."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.core.learn.rls import (
    RecursiveLeastSquares,
    RlsSettings,
    is_plausible,
)
from adaptive_contact.core.learn.state import ImplausibleError, SavedState, array_of, pack
from adaptive_contact.model.change_prior import change_directions, core_support
from adaptive_contact.model.free_motion import Covariance
from adaptive_contact.model.labelled_swing import Rows
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.model_file import LegBaseline

# A leg that began with a prior is known after so many swings at least, when its coefficients have
# added less than this share of the noise's variance in each of the last.
KNOWN_SWINGS: Final = 10
KNOWN_UNCERTAINTY: Final = 0.5
KNOWN_IN_A_ROW: Final = 3

# A term never moves a tick by more than this: the fastest servos make it in one, and no term of the
# shipped models moves a typical tick by more than an eighth of it.
MAX_TERM_RAD: Final = 0.5
# Terms of a library that are nearly alike hold each other in balance; no model's go beyond so many
# times what the baseline's do.
BALANCE: Final = 5.0
# The baseline is put in force again when it has been this much better for so many lifts.
RETURN_RATIO: Final = 0.6
RETURN_SWINGS: Final = 3
# A prior's terms are as uncertain as legs differ, a hundred times the noise where steps are fine.
PRIOR_BOUND: Final = 500.0


class FirstSwings:
    """Follows how well a leg is known that began with a prior.

    Args:
        swings: resolved before.

    Attributes:
        swings: resolved so far.
    """

    def __init__(self, swings: int = 0) -> None:
        self.swings = swings
        self._known = 0  # swings in a row
        self._largest: float | None = None  # uncertainty of this swing, None without a row

    def add_uncertainty(self, uncertainty: float) -> None:
        """Add the uncertainty of the rows of a lift, or of a descent."""
        self._largest = max(self._largest or 0.0, uncertainty)

    def end_swing(self, *, valid: bool) -> bool:
        """End a swing; return whether the leg is known."""
        self.swings += 1
        if self._largest is not None:
            known = valid and self._largest < KNOWN_UNCERTAINTY
            self._known = self._known + 1 if known else 0
        self._largest = None
        return self.swings >= KNOWN_SWINGS and self._known >= KNOWN_IN_A_ROW

    @property
    def progress(self) -> str:
        """Progress for people, such as ``4 of 10 swings``."""
        if self.swings < KNOWN_SWINGS:
            return f"{self.swings} of {KNOWN_SWINGS} swings"
        return f"{self.swings} swings, and its model is still uncertain"


class Good(NamedTuple):
    """Holds a model as it was, with its recursion."""

    version: int
    rls: RecursiveLeastSquares
    inflated: bool


class ActiveModel:
    """Owns one leg's model in force and its recursion.

    Args:
        start: what the leg begins with, the baseline or a prior.

    Attributes:
        baseline: the model at the start.
        version: of the model.
        recursion: recursive least squares, which move the model.
        inflated: whether the recursion's covariance was, since the recursion began.
        from_prior: the leg began with a prior.
    """

    def __init__(self, start: LegBaseline) -> None:
        self.baseline, spread = start.model, start.spread
        self.version = start.model.version
        self.from_prior = self.inflated = spread is not None
        self._settings = None if spread is None else RlsSettings(bound=PRIOR_BOUND)
        self._noise = start.noise.rms
        self._scale = np.array(start.scale)
        # What a term may move a tick by, at most.
        own = np.abs(start.model.coefficients * start.scale[:, None]).max()
        self._most_rad = max(MAX_TERM_RAD, BALANCE * float(own))
        support = core_support(start.model)
        if spread is not None:
            support |= (spread != 0.0).any(axis=1).T
        self.recursion = self._recursion(start.model.coefficients, support)
        if spread is not None:
            self.recursion.inflate(spread)
        self._start = self.good()
        self._better_baseline = 0  # lifts in a row

    @property
    def model(self) -> LegModel:
        """Return the model in force."""
        return self.baseline.moved(self.recursion.coefficients, self.version)

    @property
    def coefficients(self) -> Array:
        """Return (p, J) of the model in force; the next row that is learned overwrites them."""
        return self.recursion.current

    @property
    def covariance(self) -> Covariance | None:
        """Return the covariance of the coefficients while it is inflated, else None."""
        return self.recursion.roots if self.inflated else None

    def learn(self, values: Array, at: int) -> bool:
        """Learn a row.

        Args:
            values: as of :meth:`RecursiveLeastSquares.learn`.
            at: which row.

        Returns:
            Whether the model is plausible.
        """
        self.version = max(1, self.version)
        return self.recursion.learn(values, at)

    def uncertainty(self, rows: Rows) -> float:
        """Compute the variance of predictions that comes from the coefficients, over the noise's.

        Returns:
            Of the joint that is known the least, the mean over the rows.
        """
        return float(self.recursion.uncertainty(rows.theta).max(axis=1).mean())

    def inflate(self) -> None:
        """Inflate the covariance along the ways in which legs change."""
        self.inflated = True
        self.recursion.inflate(change_directions(self.model, self._scale, self._noise))

    def good(self) -> Good:
        """Copy the model in force with its recursion."""
        return Good(self.version, self.recursion.copy(), self.inflated)

    def return_to(self, good: Good) -> None:
        """Restore an earlier model, and drop what was learned since."""
        self.version, self.inflated = good.version, good.inflated
        self.recursion = good.rls.copy()

    def return_to_start(self) -> None:
        """Restore the model of the start; the version goes on."""
        self.return_to(self._start._replace(version=max(1, self.version)))
        self._better_baseline = 0

    def baseline_is_better(self, rows: Rows) -> bool:
        """Return whether the baseline has fitted lifts much better than the model, up to this one.

        Args:
            rows: of a lift, all free.
        """
        now, before = (
            np.square(rows.residual(of) / self._noise).sum()
            for of in (self.coefficients, self.baseline.coefficients)
        )
        better = self.version > 0 and bool(before < RETURN_RATIO * now)
        self._better_baseline = self._better_baseline + 1 if better else 0
        return self._better_baseline >= RETURN_SWINGS

    def snapshot(self) -> dict[str, Any]:
        """Return the model, its covariance and its support, for :meth:`restore`."""
        return {
            "baseline": pack(self.baseline.coefficients),
            "coefficients": pack(self.coefficients),
            "version": self.version,
            "factor": pack(self.recursion.factor),
            "support": pack(self.recursion.support.astype(np.float64)),
            "loosened": self.inflated,
        }

    def restore(self, state: SavedState, factor: Any) -> None:
        """Restore a saved model and the packed square root of its covariance.

        Raises:
            ImplausibleError: the two cannot be a leg's; nothing is changed.
        """
        # A model that moves a typical tick by radians cannot be a servo's.
        if not is_plausible(state.coefficients, self._scale, self._most_rad):
            raise ImplausibleError("its model is implausible")
        rls = self._recursion(state.coefficients, state.support)
        shape = (len(self._noise), -1, -1)
        if not rls.restore(state.coefficients, array_of(factor, shape, "its covariance")):
            raise ImplausibleError("its covariance is of other terms")
        self.version, self.recursion, self.inflated = state.version, rls, state.inflated

    def _recursion(self, coefficients: Array, support: Mask) -> RecursiveLeastSquares:
        return RecursiveLeastSquares(
            coefficients, support, self._scale, self._noise, self._settings, self._most_rad
        )
