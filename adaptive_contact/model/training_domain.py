r"""Computes the leverage of a row: how far it lies outside of what a fit has seen.

Least squares on rows :math:`\varphi_i` knows its prediction at :math:`\varphi` to

.. math::
   h(\varphi) = \varphi^\top
   \Big(\sum_i \varphi_i \varphi_i^\top + \rho^2 I\Big)^{-1} \varphi

times the noise variance (the leverage), so that a residual there has variance :math:`1 + h`.
Where the leg has been, h is a few hundredths; in a motion that no swing of a short recording held,
it is 10 or 100, and a residual there is evidence on the model, not on the ground.  ρ is the prior
of a term, and keeps h finite for one that was never excited.

That holds where the model is right and its rows are many motions.  Fitted to a few, it errs in the
next one by more, and by the more, the faster that is: there, the part of h that comes from how the
leg moves, beyond where it stands, counts for more (:attr:`Domain.inflation`).
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, scipy
from adaptive_contact.errors import IdentificationError
from adaptive_contact.model.factor import Factor

# A term of typical size that was never seen is assumed to move a tick by less than twenty times
# the noise (6 degrees for an AX-12A's leg).
PRIOR_DEVIATIONS: Final = 20.0
# And one that was no part of the fit to move it by nothing.
BEYOND_DEVIATIONS: Final = 1e-4


@dataclasses.dataclass(frozen=True)
class Domain:
    """Describes where in the space of its regressors a fit has been."""

    # (p, p) upper triangle R with :math:`R^T R` the sum over rows of the regressors' outer
    # products, each regressor in units of its scale
    triangle: Array
    scale: Array  # (p,) typical size of each regressor, above 0
    # further terms of the library, of which it says nothing: they were no part of the fit
    beyond: int = 0
    # (p,) factor on each term's part of h, beyond the part of terms of less inflation; 1 for each
    # where absent
    inflation: Array | None = None
    _reach: Array = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        p = len(self.scale)
        if self.triangle.shape != (p, p) or not np.isfinite(self.triangle).all():
            raise IdentificationError(
                f"domain: expected a finite triangle of shape {(p, p)}, found "
                f"{self.triangle.shape}; fit a new one"
            )
        factors = np.ones(p) if self.inflation is None else self.inflation
        if factors.shape != (p,) or not (np.isfinite(factors).all() and (factors >= 0.0).all()):
            raise IdentificationError(
                f"domain: expected {p} inflations of 0 and more, found {factors.shape}; "
                "fit a new one"
            )
        order = np.argsort(factors, kind="stable")
        stacked = np.concatenate([self.triangle, np.eye(p) / PRIOR_DEVIATIONS])
        whole = scipy.linalg.qr(stacked[:, order], mode="r", check_finite=False)[0][:p]
        # h = |R^-T (θ / scale)|²; the prior makes R well conditioned.  Each of its parts is what a
        # term adds to those before it.
        reach = scipy.linalg.solve_triangular(whole, np.eye(p), trans="T")
        if self.inflation is not None:
            reach = reach[:, np.argsort(order, kind="stable")] * np.sqrt(factors[order])[:, None]
        object.__setattr__(self, "_reach", reach / self.scale)

    @classmethod
    def from_factor(cls, factor: Factor, scale: Array) -> Domain:
        """Make the domain of a fit.

        Args:
            factor: what it was fitted to.
            scale: (p,); zeros (columns that were never there) count as one.
        """
        p = factor.terms
        scale = np.where(scale > 0.0, scale, 1.0)
        rows = factor.system[0] / scale
        triangle = np.zeros((p, p))
        if len(rows):
            found = scipy.linalg.qr(rows, mode="r", check_finite=False)[0][:p]
            triangle[: len(found)] = found
        return cls(triangle, scale)

    @property
    def rows(self) -> float:
        """Return the number of rows seen: the constant, which comes first, is one in every row."""
        return float(np.square(self.triangle[:, 0] * self.scale[0]).sum())

    @property
    def reach(self) -> Array:
        """Return G, (p, p), with h the square of G θ; without the terms beyond."""
        return self._reach

    def leverage(self, theta: Array) -> Array:
        """Compute the leverage h of rows.

        Args:
            theta: (..., p + beyond) regressors.

        Returns:
            (...,) 0 where everything is known.
        """
        if self.beyond:
            theta = theta[..., : -self.beyond]
        return np.asarray(np.square(theta @ self._reach.T).sum(axis=-1))
