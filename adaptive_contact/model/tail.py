r"""Extrapolates thresholds far beyond counting, from a fitted tail.

One false alarm per robot-hour is a probability of :math:`2\cdot10^{-6}` per tick; no affordable
number of free ticks shows such an event often enough to count.  Exceedances of a high level
:math:`t_0` follow a generalised Pareto distribution (Pickands 1975),

.. math:: P(T > t_0 + y \mid T > t_0) = (1 + \xi y / \beta)^{-1/\xi},

fitted by probability-weighted moments (Hosking and Wallis 1987), which stay sane on the small
samples on which maximum likelihood does not.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from adaptive_contact.errors import IdentificationError, TooLittleDataError

# The level above which the tail is fitted: the largest 1 % of the ticks, but enough of them, and at
# most so many.
TAIL_FRACTION: Final = 0.01
MIN_EXCEEDANCES: Final = 50
MOST_FRACTION: Final = 0.05
# A heavier shape than this means a few outliers, not a tail; a lighter one promises a hard end.
SHAPE_RANGE: Final = (-0.2, 0.6)
CONFIDENCE_DEVIATIONS: Final = 1.645  # 95 %, one-sided
# Whitened residuals of legs have tails close to exponential (0.00 to 0.08 on 2·10^5 ticks of six
# simulated legs); the prior weighs like so many exceedances.
PRIOR_SHAPE: Final = 0.02
PRIOR_EXCEEDANCES: Final = 200


@dataclasses.dataclass(frozen=True)
class Tail:
    """Models the upper tail of a statistic."""

    level: float  # t0, in the unit of the statistic
    rate: float  # share of ticks above it
    scale: float  # β
    shape: float  # ξ
    ticks: int  # how many free ticks it was fitted to

    def cautious(self) -> Tail:
        """Return the tail with its shape at the upper end of its one-sided 95 % interval.

        A target rate of rare false alarms is to be kept, not met on average.  A quantile at 1/60 of
        the lowest rate that was seen depends on the shape, and errs to both sides.  The mean
        excess, which is well known, is kept.

        Reference:
            Asymptotic variance of the shape: Hosking and Wallis 1987, with k = -shape.
        """
        count = self.rate * self.ticks
        if count < 1.0:  # a prior, not an estimate
            return self
        k = -self.shape
        spread = 0.0
        if k > -0.5:  # else there is no such variance
            variance = (1 + k) * (2 + k) ** 2 * (1 + k + 2 * k**2) / ((1 + 2 * k) * (3 + 2 * k))
            spread = (variance / (count + PRIOR_EXCEEDANCES)) ** 0.5
        shape = min(self.shape + CONFIDENCE_DEVIATIONS * spread, SHAPE_RANGE[1])
        mean = self.scale / (1.0 - self.shape)
        return dataclasses.replace(self, shape=shape, scale=mean * (1.0 - shape))

    def quantile(self, probability: float) -> float:
        """Compute the value that a free tick exceeds with the given probability.

        Raises:
            IdentificationError: the probability lies above the tail's own rate.
        """
        if not 0.0 < probability <= self.rate:
            raise IdentificationError(
                f"tail: probability {probability:g} is outside (0, {self.rate:g}]; "
                "the tail says nothing there"
            )
        ratio = self.rate / probability
        if abs(self.shape) < 1e-9:
            return self.level + self.scale * math.log(ratio)
        return self.level + self.scale / self.shape * (math.pow(ratio, self.shape) - 1.0)


def tail_ticks(n: int) -> int:
    """Return how many of n free ticks are taken for the tail.

    Raises:
        TooLittleDataError: :data:`MIN_EXCEEDANCES` are too large a part of them.
    """
    count = max(int(n * TAIL_FRACTION), MIN_EXCEEDANCES)
    needed = math.ceil(MIN_EXCEEDANCES / MOST_FRACTION)
    if n < needed:
        raise TooLittleDataError(
            f"{n} free swing ticks are too few for a threshold, expected at least {needed}; record "
            "more free swings",
            n,
            needed,
        )
    return count


def fit_tail(values: ArrayLike) -> Tail:
    """Fit the upper tail of a statistic on free ticks.

    Args:
        values: (n,) the statistic on ticks known to be free; NaN is left out.

    Returns:
        The tail.

    Raises:
        TooLittleDataError: as :func:`tail_ticks`.

    Reference:
        Hosking and Wallis, Parameter and quantile estimation for the generalized Pareto
        distribution, Technometrics 29 (1987).
    """
    sample = np.asarray(values, dtype=np.float64)
    sample = np.sort(sample[np.isfinite(sample)])
    n = len(sample)
    count = tail_ticks(n)
    level = float(sample[n - count - 1])
    excess = sample[n - count :] - level
    mean = float(excess.mean())
    if mean <= 0.0:  # a statistic that is constant at the top
        return Tail(level, count / n, max(abs(level), 1.0) * 1e-6, 0.0, n)
    order = np.arange(1, count + 1)
    # b1 estimates E[X (1 - F(X))]; ascending order, so the weight falls.
    b1 = float(np.sum((count - order) * excess) / (count * (count - 1)))
    shape = 2.0 - mean / (mean - 2.0 * b1) if mean > 2.0 * b1 else SHAPE_RANGE[1]
    # A shape from a hundred exceedances is worth little: shrink it towards the usual one.
    shape = (count * shape + PRIOR_EXCEEDANCES * PRIOR_SHAPE) / (count + PRIOR_EXCEEDANCES)
    shape = float(np.clip(shape, *SHAPE_RANGE))
    # With the shape held, the mean gives the scale: E[X] = β / (1 - ξ).
    return Tail(level, count / n, mean * (1.0 - shape), shape, n)
