r"""Recursive least squares that forgets only where it learns.

One estimator for the J joints of a leg.  Each joint has its own covariance, as a square-root
factor :math:`P_j = S_j S_j^\top`; terms outside a joint's support have zero rows in :math:`S_j`
and therefore never move.  A row :math:`\varphi` with noise :math:`\sigma_j` enters by

.. math::
   v = S_j^\top \varphi / \sigma_j, \quad m = v^\top v, \quad
   \xi_j \leftarrow \xi_j + \frac{S_j v}{1 + m} \frac{y_j - \varphi^\top \xi_j}{\sigma_j}, \quad
   S_j \leftarrow S_j + \frac{\sqrt f - 1}{m} (S_j v) v^\top, \quad f = \frac{1}{\lambda (1 + m)} .

With λ = 1 this is the square-root measurement update of Potter (1963), and one-by-one equals
batch. With λ < 1 it is the restricted exponential forgetting of Kulhavý (1987) in square-root
form: only the direction that the row excites is forgotten, towards :math:`m = (1 - \lambda) /
\lambda`; a leg that stands still brings no new direction and changes nothing.  :math:`S S^\top`
cannot lose definiteness.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

__all__ = ["RecursiveLeastSquares", "RlsSettings"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class RlsSettings:
    """Settings of the recursion.

    Attributes:
        forgetting: λ per row in the direction of the row; 0.998 remembers about 500 rows of
            equal excitation, some 40 swings.
        prior: standard deviation of a coefficient at the start, in noise units: how far one
            term may move the prediction.
        bound: no standard deviation grows above this, in the same units.
        huber: innovations beyond this many of their own standard deviations count less.
    """

    forgetting: float = 0.998
    prior: float = 0.03
    bound: float = 20.0
    huber: float = 3.0


class RecursiveLeastSquares:
    """Follows the coefficients of one leg.

    Args:
        coefficients: (p, J) to start from.
        support: (p, J) which may move.
        scale: (p,) typical size of each regressor.
        noise: (J,) rad, standard deviation of a residual.
        settings: see :class:`RlsSettings`.
    """

    def __init__(
        self,
        coefficients: Array,
        support: NDArray[np.bool_],
        scale: Array,
        noise: Array,
        settings: RlsSettings | None = None,
    ) -> None:
        self.settings = settings or RlsSettings()
        self.noise = noise.copy()
        self.rows = 0
        self._terms = np.flatnonzero(support.any(axis=1))
        self._support = support[self._terms].T.copy()  # (J, q)
        self._scale = scale[self._terms]
        self._full = coefficients.copy()
        self._xi = (coefficients[self._terms] * self._scale[:, None]).T.copy()  # (J, q), scaled
        self._s = np.zeros((len(noise), len(self._terms), len(self._terms)))
        self.reset_covariance()

    @property
    def coefficients(self) -> Array:
        """(p, J) at present."""
        self._full[self._terms] = self._xi.T / self._scale[:, None]
        return self._full.copy()

    @property
    def covariance(self) -> Array:
        """(J, q, q) of the scaled coefficients of :attr:`terms`."""
        return np.asarray(self._s @ self._s.transpose(0, 2, 1))

    @property
    def terms(self) -> NDArray[np.int64]:
        """(q,) rows of the coefficients that any joint may move."""
        return self._terms

    @property
    def support(self) -> NDArray[np.bool_]:
        """(p, J) terms that may move, per joint."""
        full = np.zeros((len(self._full), len(self._support)), dtype=bool)
        full[self._terms] = self._support.T
        return full

    @property
    def factor(self) -> Array:
        """(J, q, q) square roots S of the covariance."""
        return self._s

    def restore(self, coefficients: Array, factor: Array) -> None:
        """Take over a saved state: (p, J) coefficients and (J, q, q) square roots."""
        self.reseed(coefficients)
        self._s = factor * self._support[:, :, None]
        self._bound()

    def reset_covariance(self) -> None:
        """Back to the prior: every term free to move by as much as it says."""
        self._s[:] = 0.0
        index = np.arange(len(self._terms))
        self._s[:, index, index] = self.settings.prior * self.noise[:, None] * self._support

    def reseed(self, coefficients: Array) -> None:
        """Take over the coefficients of an accepted refit; what was known of them stays known."""
        self._full = coefficients.copy()
        self._xi = (coefficients[self._terms] * self._scale[:, None]).T.copy()

    def uncertainty(self, theta: Array) -> Array:
        """Variance of a prediction that comes from the coefficients, over the noise's.

        Args:
            theta: (..., p) regressors.

        Returns:
            (..., J), 0 for a model known exactly.
        """
        phi = theta[..., self._terms] / self._scale
        v = np.matmul(phi[..., None, None, :], self._s)[..., 0, :]
        return np.asarray(np.square(v).sum(axis=-1) / np.square(self.noise))

    def update(self, theta: Array, target: Array) -> None:
        """Take in one row.

        Args:
            theta: (p,) regressors.
            target: (J,) rad, what they should have predicted.  A row with a value that is not
                finite is left out.
        """
        phi = theta[self._terms] / self._scale
        innovations = ((target - self._xi @ phi) / self.noise).tolist()
        # A regressor that is not finite shows in every innovation.
        if not all(map(math.isfinite, innovations)):
            return
        v = np.matmul(phi, self._s)
        v /= self.noise[:, None]
        sv = np.matmul(self._s, v[:, :, None])[:, :, 0]
        gains, rates = [], []
        # Plain floats: for three joints they are faster than arrays.
        for innovation, m in zip(innovations, np.square(v).sum(axis=1).tolist(), strict=True):
            # Huber's weight on the innovation, in units of its own standard deviation.
            size = abs(innovation) / math.sqrt(1.0 + m)
            weight = 1.0 if size <= self.settings.huber else self.settings.huber / size
            gains.append(weight * innovation / (1.0 + weight * m))
            # Without excitation (m = 0) there is nothing to learn and nothing to forget.
            shrink = math.sqrt(1.0 / (self.settings.forgetting * (1.0 + weight * m))) - 1.0
            rates.append(shrink / m if m > 1e-12 else 0.0)
        self._xi += sv * np.array(gains)[:, None]
        sv *= np.array(rates)[:, None]
        self._s += sv[:, :, None] * v[:, None, :]
        self.rows += 1
        if self.rows % 64 == 0:
            self._bound()

    def loosen(self, directions: Array) -> None:
        """Let the coefficients move along some directions: something about the leg has changed.

        Args:
            directions: (J, d, p) standard deviations of a change along each direction, in raw
                units of the coefficients.
        """
        moves = directions[:, :, self._terms] * self._scale * self._support[:, None, :]
        for joint in range(len(self._s)):
            stacked = np.concatenate([self._s[joint].T, moves[joint]], axis=0)
            triangle = scipy.linalg.qr(stacked, mode="r", check_finite=False)[0]
            size = len(self._terms)
            self._s[joint] = triangle[:size].T
        self._bound()

    def _bound(self) -> None:
        limit = self.settings.bound * self.noise[:, None]
        deviation = np.sqrt(np.square(self._s).sum(axis=2))
        over = deviation > limit
        if over.any():
            shrink = np.where(over, limit / np.maximum(deviation, 1e-300), 1.0)
            self._s *= shrink[:, :, None]
