"""Owns the model in force, and the recursion that moves it."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.learn.rls import (
    RecursiveLeastSquares,
    RlsSettings,
    is_plausible,
    squared_errors,
)
from adaptive_contact.learn.state import ImplausibleError, SavedState, array_of, pack
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
# The baseline is taken up again when it has been this much better for so many lifts.
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

    def note(self, uncertainty: float) -> None:
        """Note the uncertainty of the rows of a lift, or of a descent."""
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
        recursion: recursive least squares, which move the model.
        inflated: whether the recursion's covariance was, since the recursion began.
        as_made: the model as it was last asked for; rows learned since are not in it.
        most_rad: that a term of a plausible model moves a typical tick by.
        from_prior: the leg began with a prior.
    """

    def __init__(self, start: LegBaseline) -> None:
        self.baseline = start.model
        self.from_prior = start.spread is not None
        self._settings = None if start.spread is None else RlsSettings(bound=PRIOR_BOUND)
        self._noise = start.noise.rms
        self._per_noise, self._scale = 1.0 / start.noise.rms, np.array(start.scale)
        # Copies, as compiled code takes an array that may not be written to for another kind.
        self._first = np.array(start.model.coefficients, order="C")
        # What a term may move a tick by, at most.
        own = np.abs(start.model.coefficients * start.scale[:, None]).max()
        self.most_rad = max(MAX_TERM_RAD, BALANCE * float(own))
        self.as_made = start.model
        self._moved = False  # the recursion has, since it was made
        self._start = Good(start.model.version, self._begun_with(start.spread), self.from_prior)
        self._go_on_from(self._start)
        self._better_baseline = 0  # lifts in a row

    @property
    def model(self) -> LegModel:
        """Model in force; made on demand, as most rows are learned while the leg stands."""
        if self._moved:
            self.as_made = self.as_made.moved(self.recursion.coefficients, self.version)
            self._moved = False
        return self.as_made

    @property
    def version(self) -> int:
        """Of the model, without making it."""
        version = self.as_made.version
        return max(1, version) if self._moved else version

    @property
    def coefficients(self) -> Array:
        """(p, J) of the model in force; written over by the next row that is learned."""
        return self.recursion.current

    @property
    def covariance(self) -> Covariance | None:
        """Covariance of the coefficients while it is inflated, else None."""
        return self.recursion.roots if self.inflated else None

    def learn(self, values: Array, at: int) -> bool:
        """Learn a row.

        Args:
            values: as of :meth:`RecursiveLeastSquares.learn`.
            at: which row.

        Returns:
            Whether the model is plausible.
        """
        self._moved = True
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

    def good(self, spare: Good | None = None) -> Good:
        """Return the model in force with its recursion; ``spare`` may be written over."""
        rls = self.recursion.copy(None if spare is None else spare.rls)
        return Good(self.version, rls, self.inflated)

    def return_to(self, good: Good) -> None:
        """Restore an earlier model, and drop what was learned since."""
        self._put(self.as_made.moved(good.rls.coefficients, good.version))
        self._go_on_from(good)

    def baseline_is_better(self, rows: Rows) -> bool:
        """Return whether the baseline has fitted lifts much better than the model, up to this one.

        Args:
            rows: of a lift, all free.
        """
        if self.version == 0:
            return False
        now, before = squared_errors(rows.values, self._per_noise, self.coefficients, self._first)
        self._better_baseline = self._better_baseline + 1 if before < RETURN_RATIO * now else 0
        if self._better_baseline < RETURN_SWINGS:
            return False
        self._better_baseline = 0
        return True

    def go_on_from(self, good: Good | None) -> None:
        """Put an earlier model in force again, the start's where None; the version goes on."""
        self._go_on_from(good or self._start)
        self._moved = True

    def snapshot(self) -> dict[str, Any]:
        """Return the model, its covariance and its support, for :meth:`restore`."""
        return {
            "baseline": pack(self.baseline.coefficients),
            "coefficients": pack(self.model.coefficients),
            "version": self.model.version,
            "factor": pack(self.recursion.factor),
            "support": pack(self.recursion.support.astype(np.float64)),
            "loosened": self.inflated,
        }

    def restore(self, state: SavedState, factor: Any) -> None:
        """Take over a saved model and the packed square root of its covariance.

        Raises:
            ImplausibleError: the two cannot be a leg's; nothing is changed.
        """
        # A model that moves a typical tick by radians cannot be a servo's.
        if not is_plausible(state.coefficients, self._scale, self.most_rad):
            raise ImplausibleError("its model is implausible")
        # A promoted model has a support of its own.
        rls = RecursiveLeastSquares(
            state.coefficients, state.support, self._scale, self._noise, self._settings,
            self.most_rad,
        )  # fmt: skip
        shape = (len(self._noise), -1, -1)
        if not rls.restore(state.coefficients, array_of(factor, shape, "its covariance")):
            raise ImplausibleError("its covariance is of other terms")
        self._put(self.as_made.moved(state.coefficients, state.version))
        self.recursion, self.inflated = rls, state.inflated

    def _begun_with(self, spread: Array | None) -> RecursiveLeastSquares:
        """Return a recursion that begins at the baseline, and at the spread of a prior."""
        if spread is None:
            return self._recursion(self.baseline)
        rls = self._recursion(self.baseline, (spread != 0.0).any(axis=1).T)
        rls.inflate(spread)
        return rls

    def _go_on_from(self, good: Good) -> None:
        self.recursion, self.inflated = good.rls.copy(), good.inflated

    def _recursion(self, model: LegModel, more: Mask | None = None) -> RecursiveLeastSquares:
        """Return a recursion at a model, over its terms and (p, J) more of them."""
        support = core_support(model)
        if more is not None:
            support |= more
        return RecursiveLeastSquares(
            model.coefficients, support, self._scale, self._noise, self._settings, self.most_rad
        )

    def _put(self, model: LegModel) -> None:
        """Set the model in force."""
        self.as_made, self._moved = model, False
