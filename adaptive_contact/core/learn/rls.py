r"""Estimates coefficients by recursive least squares that forgets only where it learns.

One estimator for the J joints of a leg.  Each joint has its own covariance over the terms of its
own support, as a square-root factor :math:`P_j = S_j S_j^\top`; joints with fewer terms than the
others are filled up with zeros, which stay zero.  A row :math:`\varphi` with noise
:math:`\sigma_j` enters by

.. math::
   v = S_j^\top \varphi / \sigma_j, \quad m = v^\top v, \quad
   \xi_j \leftarrow \xi_j + \frac{S_j v}{1 + m} \frac{y_j - \varphi^\top \xi_j}{\sigma_j}, \quad
   S_j \leftarrow S_j + \frac{\sqrt f - 1}{m} (S_j v) v^\top, \quad f = \frac{1}{\lambda (1 + m)} .

A row whose innovation is s > 3 of its own standard deviations counts less, by Huber's weight
:math:`w = 3 / s`: :math:`m` and the gain are those of :math:`\sqrt w \varphi` and
:math:`\sqrt w y_j`.
With λ = 1 this is the square-root measurement update of Potter (1963), and one-by-one equals
batch. With λ < 1 it is the restricted exponential forgetting of Kulhavý (1987) in square-root
form: only the direction that the row excites is forgotten, towards :math:`m = (1 - \lambda) /
\lambda`; a leg that stands still brings no new direction and changes nothing.  :math:`S S^\top`
cannot lose definiteness.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array, Mask, scipy
from adaptive_contact.compiled import Handover, compiled
from adaptive_contact.model.free_motion import Covariance


@dataclasses.dataclass(frozen=True)
class RlsSettings:
    """Holds the settings of the recursion."""

    # λ per row in the direction of the row; 0.998 remembers about 500 rows of equal excitation,
    # some 40 swings
    forgetting: float = 0.998
    # standard deviation of a coefficient at the start, in noise units: how far one term may move
    # the prediction
    prior: float = 0.03
    bound: float = 20.0  # no standard deviation grows above this, in the same units
    huber: float = 3.0  # innovations beyond this many of their own standard deviations count less


class RecursiveLeastSquares:
    """Estimates the coefficients of one leg, row by row.

    Args:
        coefficients: (p, J) to start from.
        support: (p, J) which may move.
        scale: (p,) typical size of each regressor.
        noise: (J,) rad, standard deviation of a residual.
        settings: see :class:`RlsSettings`.
        most: that a term of a plausible model moves a typical tick by, rad.

    Attributes:
        rows: learned.
        current: (p, J) coefficients at present; written over by the next row.
    """

    def __init__(
        self,
        coefficients: Array,
        support: Mask,
        scale: Array,
        noise: Array,
        settings: RlsSettings | None = None,
        most: float = np.inf,
    ) -> None:
        self.settings = settings or RlsSettings()
        self.noise, self._scale = noise.copy(), scale.copy()
        self._limits = np.array([self.settings.forgetting, self.settings.huber, most])
        self.rows = 0
        self.current = np.array(coefficients, order="C")
        counts = support.sum(axis=0)
        size = int(counts.max(initial=0))
        self._counts = counts
        self._held = np.arange(size) < counts[:, None]  # (J, n); the rest is filling
        self._index = np.zeros((len(noise), size), dtype=np.int64)  # places in a row of regressors
        self._index[self._held] = np.nonzero(support.T)[1]
        self._per_scale = np.where(self._held, 1.0 / scale[self._index], 0.0)
        # Where they sit in the matrix of coefficients.
        self._places = (self._index[self._held], np.nonzero(self._held)[0])
        # Inside, everything is in units of the noise: no division is left for a row.
        self._per_noise = 1.0 / self.noise
        self._to_raw = self._per_scale * self.noise[:, None]
        self._xi = self._scaled(coefficients)  # (J, n)
        self._s = np.zeros((len(noise), size, size))
        self._innovations = np.zeros(len(noise))
        self._room = np.zeros((2, len(noise), size))
        self.reset_covariance()

    @property
    def coefficients(self) -> Array:
        """(p, J) coefficients at present, a copy."""
        return self.current.copy()

    @property
    def support(self) -> Mask:
        """(p, J) terms that may move, per joint."""
        full = np.zeros(self.current.shape, dtype=bool)
        full[self._places] = True
        return full

    @property
    def factor(self) -> Array:
        """(J, n, n) square roots S of the covariances, of each joint's own terms in their order."""
        return np.asarray(self._s * self.noise[:, None, None])

    def restore(self, coefficients: Array, factor: Array) -> bool:
        """Take over a saved state; False where its covariance has another shape.

        Args:
            coefficients: (p, J).
            factor: as :attr:`factor`; or (J, q, q) of the q terms of all joints, as before 0.1.0.
        """
        self.reseed(coefficients)
        self._s[:] = 0.0
        terms = np.unique(self._index[self._held])
        if factor.shape[1:] not in (self._s.shape[1:], (len(terms), len(terms))):
            return False
        for joint, (index, held) in enumerate(zip(self._index, self._held, strict=True)):
            n = int(held.sum())
            own = slice(n) if factor.shape == self._s.shape else np.searchsorted(terms, index[held])
            self._set_root(joint, factor[joint, own] / self.noise[joint])
        self._bound()
        return True

    def copy(self) -> RecursiveLeastSquares:
        """Return an independent copy; constant arrays are shared."""
        other = copy.copy(self)
        other._xi, other._s, other.current = self._xi.copy(), self._s.copy(), self.current.copy()
        return other

    def __getstate__(self) -> dict[str, Any]:
        return {name: of for name, of in vars(self).items() if name != "_learn"}

    def reset_covariance(self) -> None:
        """Reset the covariance to the prior: every term may move by as much as it says."""
        self._s[:] = 0.0
        index = np.arange(self._s.shape[1])
        self._s[:, index, index] = self.settings.prior * self._held

    def reseed(self, coefficients: Array) -> None:
        """Take over the coefficients of an accepted refit; the covariance stays."""
        self.current[:] = coefficients
        self._xi[:] = self._scaled(coefficients)

    @property
    def size(self) -> int:
        """n, terms of the joint that has the most."""
        return self._index.shape[1]

    @property
    def roots(self) -> Covariance:
        """Views of the terms' places, their reciprocal scales, and the square roots."""
        return Covariance(self._index, self._per_scale, self._s)

    def uncertainty(self, theta: Array) -> Array:
        """Compute the variance of predictions that comes from the coefficients, over the noise's.

        Args:
            theta: (..., p) regressors.

        Returns:
            (..., J), 0 for a model known exactly.
        """
        phi = theta[..., self._index] * self._per_scale
        v = np.matmul(phi[..., None, :], self._s)[..., 0, :]
        return np.asarray(np.square(v).sum(axis=-1))

    def learn(self, values: Array, at: int) -> bool:
        """Learn one row of several; one with a value that is not finite is left out.

        Args:
            values: (n, p + J and more) regressors, and behind them what they should have
                predicted, rad.
            at: which row.

        Returns:
            Whether the coefficients are plausible.
        """
        sound, plausible = self._learn(values, at)
        if sound:
            self.rows += 1
            if self.rows % 64 == 0:
                self._bound()
        return bool(plausible)

    def inflate(self, directions: Array) -> None:
        """Inflate the covariance along some directions, as the leg has changed.

        Args:
            directions: (J, d, p) standard deviations of a change along each direction, in raw
                units of the coefficients.
        """
        for joint, (index, held) in enumerate(zip(self._index, self._held, strict=True)):
            moves = directions[joint][:, index[held]] / self._to_raw[joint, held]
            n = int(held.sum())
            self._set_root(joint, np.concatenate([self._s[joint, :n, :n], moves.T], axis=1))
        self._bound()

    @functools.cached_property
    def _learn(self) -> Any:
        """Learning of a row, bound to the arrays, which stay where they are; few copies learn."""
        return LEARNED.bind(
            learn_row,
            {
                "index": self._index, "counts": self._counts, "per_scale": self._per_scale,
                "per_noise": self._per_noise, "to_raw": self._to_raw, "xi": self._xi, "s": self._s,
                "limits": self._limits, "innovations": self._innovations, "room": self._room,
                "current": self.current, "scale": self._scale,
            },
        )  # fmt: skip

    def _scaled(self, coefficients: Array) -> Array:
        """(J, n), in units of scale and noise, of (p, J)."""
        joints = np.arange(len(self._index))[:, None]
        unit = np.where(self._held, self._to_raw, np.inf)
        return np.asarray(coefficients[self._index, joints] / unit)

    def _set_root(self, joint: int, root: Array) -> None:
        """Set the root of a joint's covariance, (n, m), as the square one that equals it."""
        n = len(root)
        if n:
            triangle = scipy.linalg.qr(root.T, mode="r", check_finite=False)[0][:n]
            self._s[joint, :n, : len(triangle)] = triangle.T

    def _bound(self) -> None:
        limit = self.settings.bound
        deviation = np.sqrt(np.square(self._s).sum(axis=2))
        over = deviation > limit
        if over.any():
            shrink = np.where(over, limit / np.maximum(deviation, 1e-300), 1.0)
            self._s *= shrink[:, :, None]


LEARNED: Final = Handover(
    index=(np.int64, 2), counts=(np.int64, 1), per_scale=(np.float64, 2), per_noise=(np.float64, 1),
    to_raw=(np.float64, 2), xi=(np.float64, 2), s=(np.float64, 3), limits=(np.float64, 1),
    innovations=(np.float64, 1), room=(np.float64, 3), current=(np.float64, 2),
    scale=(np.float64, 1),
)  # fmt: skip
receive_learned: Final = LEARNED.receive


@compiled
def learn_row(handed, values, at_row):
    """Learn one row of several, in place.

    Of its p regressors, each joint's n terms stand at (J, n) ``index``; ``xi`` is (J, n), their
    coefficients in units of scale and noise, ``s`` (J, n, n) the roots of their covariances.
    (J,) ``innovations`` and (p, J) ``current``, coefficients in raw units, are filled; (2, J, n)
    ``room`` is scratch; ``limits`` are forgetting, Huber's, and what is plausible.

    Returns:
        Whether it was learned, or left out, as an innovation is not finite; and whether no term of
        ``current`` moves a typical tick by more than ``most``.
    """
    (
        index, counts, per_scale, per_noise, to_raw, xi, s, limits, innovations, room, current,
        scale,
    ) = receive_learned(handed)  # fmt: skip
    forgetting, huber, most = limits[0], limits[1], limits[2]
    row = values[at_row]
    joints, size = index.shape
    terms = len(current)
    theta, target = row[:terms], row[terms : terms + joints]
    whole = size - size % 4
    sound = True
    for j in range(joints):
        innovation = target[j] * per_noise[j]
        for k in range(size):
            phi = theta[index[j, k]] * per_scale[j, k]
            room[0, j, k] = phi
            innovation -= xi[j, k] * phi
        innovations[j] = innovation
        sound &= math.isfinite(innovation)
    if not sound:
        return False, moves_at_most(current, scale, most)
    for j in range(joints):
        phi, v, root = room[0, j], room[1, j], s[j]
        v[:] = 0.0
        for k in range(0, whole, 4):  # four at a time, in order: v is read and written less often
            p, q, r, t = phi[k], phi[k + 1], phi[k + 2], phi[k + 3]
            for c in range(size):
                v[c] = (
                    v[c] + p * root[k, c] + q * root[k + 1, c] + r * root[k + 2, c]
                    + t * root[k + 3, c]
                )  # fmt: skip
        for k in range(whole, size):
            for c in range(size):
                v[c] += phi[k] * root[k, c]
        m = 0.0
        for c in range(size):
            m += v[c] * v[c]
        # Huber's weight on the innovation, in units of its own standard deviation.
        size_of = abs(innovations[j]) / math.sqrt(1.0 + m)
        weight = 1.0 if size_of <= huber else huber / size_of
        gain = weight * innovations[j] / (1.0 + weight * m)
        # Without excitation (m = 0) there is nothing to learn and nothing to forget.
        shrink = math.sqrt(1.0 / (forgetting * (1.0 + weight * m))) - 1.0
        rate = shrink / m if m > 1e-12 else 0.0
        for k in range(size):
            sv = 0.0
            for c in range(size):
                sv += root[k, c] * v[c]
            xi[j, k] += sv * gain
            at = sv * rate
            for c in range(size):
                root[k, c] += at * v[c]
        for k in range(counts[j]):
            current[index[j, k], j] = xi[j, k] * to_raw[j, k]
    return True, moves_at_most(current, scale, most)


@compiled
def moves_at_most(coefficients, scale, most):
    """Return whether no term of (p, J) coefficients moves a typical tick by more; false for NaN."""
    for i in range(coefficients.shape[0]):
        for j in range(coefficients.shape[1]):
            if not abs(coefficients[i, j] * scale[i]) <= most:
                return False
    return True


def is_plausible(coefficients: Array, scale: Array, most_rad: float) -> bool:
    """Return whether a model moves a typical tick by no more than a servo can; false for NaN.

    Args:
        coefficients: (p, J).
        scale: (p,) typical size of each regressor.
        most_rad: that a term moves it by.
    """
    # Copies, as compiled code takes an array that may not be written to for another kind.
    return bool(moves_at_most(np.array(coefficients, order="C"), np.array(scale), most_rad))
