r"""Exact confidence intervals of shares and rates.

Clopper and Pearson, *The use of confidence or fiducial limits illustrated in the case of the
binomial*, Biometrika 26 (1934), in terms of the incomplete beta function; Garwood, *Fiducial limits
for the Poisson distribution*, Biometrika 28 (1936), in terms of the incomplete gamma function:

.. math::
    p_\text{low} = I^{-1}_{\alpha/2}(k, n-k+1), \quad p_\text{up} = I^{-1}_{1-\alpha/2}(k+1, n-k),
    \qquad
    \mu_\text{low} = P^{-1}_{\alpha/2}(k), \quad \mu_\text{up} = P^{-1}_{1-\alpha/2}(k+1).
"""

from __future__ import annotations

from typing import Final, NamedTuple

# scipy.stats would do the same and takes half a second to import.
from scipy.special import betaincinv, gammaincinv

CONFIDENCE: Final = 0.95


class Interval(NamedTuple):
    """Both ends of a confidence interval."""

    low: float
    high: float


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Interval of a share.

    Args:
        successes: 0 to ``trials``.
        trials: without any, the interval is 0 to 1: nothing is known.
        confidence: two-sided.

    Raises:
        ValueError: the counts are not 0 <= successes <= trials.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} of {trials} is no share; expected 0 <= successes <= trials")
    tail = (1.0 - confidence) / 2.0
    low = betaincinv(successes, trials - successes + 1, tail) if successes > 0 else 0.0
    high = betaincinv(successes + 1, trials - successes, 1.0 - tail) if successes < trials else 1.0
    return Interval(float(low), float(high))


def poisson_mean(count: int, confidence: float = CONFIDENCE) -> Interval:
    """Interval of the mean of a Poisson variable of which ``count`` was seen.

    Raises:
        ValueError: the count is negative.
    """
    if count < 0:
        raise ValueError(f"a count cannot be {count}; expected 0 or more")
    tail = (1.0 - confidence) / 2.0
    low = gammaincinv(count, tail) if count > 0 else 0.0
    return Interval(float(low), float(gammaincinv(count + 1, 1.0 - tail)))
