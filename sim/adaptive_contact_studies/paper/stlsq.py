r"""The paper's fit as PySINDy makes it, from the compressed factor.

``DiscreteSINDy`` with ``STLSQ`` sees the rows :math:`(\Theta, X_{next})`; here it sees the triangle
of their QR factorisation.  Column norms, ridge solutions, thresholds and the unbiased refit depend
on the rows through :math:`\Theta^\top\Theta` and :math:`\Theta^\top X_{next}` only, so that
supports are the same and coefficients differ by rounding.  (PySINDy's unbiased refit drops
directions whose singular value is below :math:`10^{-6}` of the largest; the triangle has the same
singular values.)

``raw`` thresholds coefficients in the units of the data, ``normalised`` those of columns with unit
Euclidean norm, which PySINDy offers as ``normalize_columns``: λ then grows with the square root of
the number of rows.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.fit import FitStatus
from adaptive_contact.model import Factor

__all__ = ["RIDGE", "PaperFit", "paper_fit"]

Array = NDArray[np.float64]

# PySINDy's default ridge term, which the paper does not mention changing.
RIDGE: Final = 0.05


@dataclasses.dataclass(frozen=True)
class PaperFit:
    """A fit as the paper makes it.

    Attributes:
        status: ``ok``, ``emptied`` where some state has no terms left, or why there is none.
        coefficients: (p, states), zero where there is no fit.
    """

    status: FitStatus
    coefficients: Array

    @property
    def terms(self) -> list[int]:
        """(states,) how many each has."""
        return [int(n) for n in np.count_nonzero(self.coefficients, axis=0)]


def paper_fit(
    factor: Factor, threshold: float, *, normalised: bool = False, ridge: float = RIDGE
) -> PaperFit:
    """Fit with PySINDy's STLSQ, unscaled targets.

    Args:
        factor: of Θ and the next states.
        threshold: λ.
        normalised: threshold coefficients of columns with unit norm.
        ridge: α.

    Returns:
        The fit with its status; never raises for bad data.
    """
    from pysindy.optimizers import STLSQ

    empty = np.zeros((factor.terms, factor.outputs))
    if factor.rows < factor.terms:
        return PaperFit(FitStatus.TOO_FEW_ROWS, empty)
    r, qty = factor.system
    if not (np.isfinite(r).all() and np.isfinite(qty).all()):
        return PaperFit(FitStatus.NOT_FINITE, empty)
    # A column that is zero throughout has no norm to be divided by, and no coefficient.
    used = np.square(r).sum(axis=0) > 0.0
    if not used.any():
        return PaperFit(FitStatus.EMPTIED, empty)
    optimizer = STLSQ(threshold=threshold, alpha=ridge, normalize_columns=normalised)
    with warnings.catch_warnings():
        # Read off the result instead: an emptied state from the support.
        warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
        warnings.filterwarnings("ignore", message=".*did not converge")
        optimizer.fit(r[:, used], qty)
    coefficients = empty.copy()
    coefficients[used] = np.asarray(optimizer.coef_, dtype=np.float64).T
    if not np.isfinite(coefficients).all():
        return PaperFit(FitStatus.NOT_FINITE, empty)
    emptied = not (coefficients != 0.0).any(axis=0).all()
    return PaperFit(FitStatus.EMPTIED if emptied else FitStatus.OK, coefficients)
