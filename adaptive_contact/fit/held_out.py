"""Chooses how to fit a leg by errors on rows held out.

The rows are dealt into folds, and each fold is predicted by a model of the others.  λ is chosen so,
and whether the fit holds on to what is known of any leg (:mod:`.prior`): where the folds are
motions of their own, the one thing that a model can be asked is what it says of the next motion.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.fit.prior import STRENGTHS, fit_prior, posterior_domain
from adaptive_contact.fit.sparse_regression import Fit, FitSettings, Prior, fit_sparse
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.leg_prior import in_family
from adaptive_contact.model.library import Library
from adaptive_contact.model.training_domain import Domain

# The sparsest model whose mean held-out error is within this of the best is taken.
TOLERANCE: Final = 1.005


@dataclasses.dataclass(frozen=True)
class Manner:
    """Describes how a leg is fitted."""

    library: Library  # the terms to choose from
    quantum_rad: float  # position step
    unit: tuple[float, ...]  # (J,) rad, of λ
    # how firmly it holds on to what is known of any leg; None for not at all
    strength: float | None = None
    inflation: float = 1.0  # factor on the leverage of a motion, beyond that of a position

    def fit(self, factor: Factor, threshold: float) -> Fit:
        """Fit some rows."""
        prior = None if self.strength is None else self._prior(factor, self.strength)
        return fit_sparse(factor, FitSettings(threshold=threshold, unit=self.unit, prior=prior))

    def _prior(self, factor: Factor, strength: float) -> Prior:
        return fit_prior(factor, self.library, self.quantum_rad, strength)

    def domain(self, factor: Factor) -> Domain:
        """Make the domain of a fit to some rows."""
        if self.strength is None:
            return Domain.from_factor(factor, factor.scale())
        prior = self._prior(factor, self.strength)
        return posterior_domain(factor, self.library, prior, self.inflation)

    def holding(self, held: HeldOut, strength: float) -> Manner:
        """Return the manner that holds on to what is known of any leg.

        Where that is more firmly than the family says, errors come from the motion: one of the
        typical leverage is then judged by √2 of the noise, one that goes as far beyond the others
        as a step among slow swings by as much more.
        """
        if strength == 1.0:
            return dataclasses.replace(self, strength=strength)
        moving = dataclasses.replace(self, strength=strength).domain(held.whole)
        moving = dataclasses.replace(moving, inflation=self.library.moves.astype(np.float64))
        typical = float(np.median(moving.leverage(held.theta)))
        inflation = max(1.0 / typical, 1.0) if typical > 0.0 else 1.0
        return dataclasses.replace(self, strength=strength, inflation=inflation)


class HeldOut:
    """Holds rows dealt into folds, each to be predicted by a model of the others.

    Args:
        theta: (n, p) regressors.
        target: (n, J) rad.
        fold: (n,) numbers from 0.
    """

    def __init__(self, theta: Array, target: Array, fold: Ints) -> None:
        self.theta, self.target = theta, target
        p, joints = theta.shape[1], target.shape[1]
        masks = [fold == f for f in range(int(fold.max(initial=0)) + 1)]
        factors = []
        for mask in masks:
            factors.append(Factor(p, joints))
            factors[-1].add(theta[mask], target[mask])
        self.whole = Factor.merged(factors, p, joints)  # all rows
        self._parts: list[tuple[Mask, Factor]] = [
            (mask, Factor.merged((o for k, o in enumerate(factors) if k != f), p, joints))
            for f, mask in enumerate(masks)
            if mask.any()
        ]

    def residual(self, manner: Manner, threshold: float, still: Mask) -> Array | None:
        """Compute (n, J) of every row by a model of the others; None if a moving joint has none.

        Args:
            manner: of the fits.
            threshold: λ.
            still: (J,) joints that stand.
        """
        residual = np.empty_like(self.target)
        for inside, others in self._parts:
            fit = manner.fit(others, threshold)
            if not fit.usable(still):
                # A short recording may lie in one fold; then there is nothing to hold out.
                fit = manner.fit(self.whole, threshold)
                if not fit.usable(still):
                    return None
            residual[inside] = self.target[inside] - self.theta[inside] @ fit.coefficients
        return residual

    def spread(self, manner: Manner) -> Array:
        """Compute (n,) by how much more than the noise a model of the others may err.

        In a short recording the swings held out hold motions that no other swing has: there the
        model of the others fails and the model of all does not, and neither noise nor tail may be
        read off it.
        """
        spread = np.empty(len(self.target))
        for inside, others in self._parts:
            leverage = manner.domain(others).leverage(self.theta[inside])
            spread[inside] = np.sqrt(1.0 + leverage)
        return spread

    def gain(self, before: Array, after: Array, least: float) -> float:
        """Compute by what logarithm residuals fell, in the mean over folds and joints.

        Args:
            before: (n, J) residuals.
            after: (n, J) others.
            least: rad, error that is none.
        """

        def sizes(residual: Array) -> Array:
            squares = [np.square(residual[inside]).mean(axis=0) for inside, _ in self._parts]
            return 0.5 * np.log(np.array(squares) + least**2)

        return float((sizes(before) - sizes(after)).mean())


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Holds what came of fits with several λ."""

    threshold: float  # λ that was chosen
    # (n, J) held out, at the λ that was chosen, over √(1 + h), h the leverage on the other folds
    residual: Array
    certain: Array  # (n, J) the same with h inflated; noise and tail are fitted to it


def swept(
    held: HeldOut, manner: Manner, lambdas: Sequence[float], still: Mask, rounding: float
) -> Sweep | None:
    """Choose λ by held-out error.

    ``still`` marks the joints that stand, (J,); ``rounding`` is the deviation of a reading, rad.

    Returns:
        What came of it; None where every λ empties a joint that moves.
    """
    spread = held.spread(dataclasses.replace(manner, inflation=1.0))[:, None]
    residuals: dict[float, Array] = {}
    for value in lambdas:
        residual = held.residual(manner, value, still)
        if residual is not None:
            residuals[value] = residual / spread
    if not residuals:
        return None
    # Joints may have best λ that lie apart: the mean over them decides.
    first = residuals[min(residuals)]
    gains = {v: held.gain(first, r, rounding) for v, r in residuals.items()}
    least = max(gains.values()) - math.log(TOLERANCE)
    chosen = max(value for value, gain in gains.items() if gain >= least)
    residual = residuals[chosen]
    expected = held.spread(manner)
    return Sweep(chosen, residual, residual * spread / expected[:, None])


def strength_of(
    held: HeldOut, manner: Manner, still: Mask, rounding: float
) -> tuple[float | None, bool]:
    """Choose how firmly to hold on to what is known of any leg.

    At least as firmly as the family says, whatever the held-out rows prefer: they are of the same
    motions, and tell nothing of the next one (decision 43).

    Args:
        held: the rows.
        manner: of fits that do not.
        still: (J,) joints that stand.
        rounding: rad, deviation of a reading.

    Returns:
        A strength, None for terms of which nothing is known; and whether the data determine the
        model.
    """
    if not in_family(manner.library):
        return None, True
    # λ is chosen when the strength is known.
    without = held.residual(manner, 0.0, still)
    gains: dict[float, float] = {}
    for strength in STRENGTHS:
        with_it = held.residual(dataclasses.replace(manner, strength=strength), 0.0, still)
        if without is not None and with_it is not None:
            gains[strength] = held.gain(without, with_it, rounding)
    best = max(gains.values(), default=0.0)
    beyond = float((np.square(held.spread(manner)) - 1.0).mean())
    # By what logarithm held-out errors must fall, where the data leave terms open: by 0.03 to
    # 0.6 on 30 swings of most legs, by less than this on ten minutes of a leg that ships (decision
    # 43).
    # Mean leverage of held-out rows from which on any gain is enough: what the other folds do not
    # determine is then more than the noise.  It is 20 to 800 on most of an arm's motions, 0.05 to
    # 2.7 on those 65 swings, 0.01 to 0.1 on ten minutes of walking.
    if best < (0.0 if beyond > 10.0 else 0.02):
        return 1.0, True
    # Strengths that keep so much of the best one's gain are as good, and the firmest is the safest.
    return max(strength for strength, gain in gains.items() if gain >= 0.9 * best), False
