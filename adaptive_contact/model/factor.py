r"""Compresses the rows of a regression into a triangular factor.

Rows :math:`(\Theta, Y)` enter a QR factorisation of :math:`[\Theta\; Y]` and are forgotten; what
stays is the triangle

.. math:: \begin{pmatrix} R & Q^\top Y \\ 0 & S \end{pmatrix}

of p + J rows, whatever the number of samples.  Since :math:`\|\Theta\xi - y\|^2 =
\|R\xi - Q^\top y\|^2 + \|s\|^2`, every least-squares, ridge or thresholded fit of the raw rows has
the same solution on the triangle.  Evicting data means dropping a factor; a triangle is never
downdated, which would be numerically unsafe.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from adaptive_contact.arrays import Array, scipy


class Factor:
    """Holds the triangle of the QR factorisation of [Θ Y], fed block by block.

    Attributes:
        terms: p, columns of Θ.
        outputs: J, columns of Y.
        rows: how many raw rows it holds.
    """

    def __init__(self, terms: int, outputs: int) -> None:
        self.terms = terms
        self.outputs = outputs
        self.rows = 0.0
        self._held = np.zeros((0, terms + outputs))  # the triangle as far as it is made
        self._waiting: list[Array] = []  # raw rows that are not in it yet

    def add(self, theta: Array, target: Array) -> int:
        """Add rows; those with a value that is not finite are left out.

        Args:
            theta: (n, p) regressors.
            target: (n, J) what they should predict.

        Returns:
            How many rows were left out.
        """
        block = np.concatenate([theta, target], axis=1)
        block = block[np.isfinite(block).all(axis=1)]
        if len(block):
            self._waiting.append(block)
            self.rows += len(block)
        # Raw rows wait until there are so many, or until they are needed: one factorisation of a
        # thousand rows costs less than ten of a hundred.
        if sum(map(len, self._waiting)) > 4096:
            self._compress()
        return len(theta) - len(block)

    @classmethod
    def merged(cls, factors: Iterable[Factor], terms: int, outputs: int) -> Factor:
        """Merge several factors into a new one."""
        total = cls(terms, outputs)
        for factor in factors:
            total._waiting.append(factor._triangle)
            total.rows += factor.rows
        return total

    @property
    def _triangle(self) -> Array:
        if self._waiting:
            self._compress()
        return self._held

    def _compress(self) -> None:
        stacked = np.concatenate([self._held, *self._waiting], axis=0)
        self._waiting.clear()
        width = self.terms + self.outputs
        if len(stacked) <= width:
            self._held = stacked  # nothing to compress yet
        else:
            self._held = scipy.linalg.qr(stacked, mode="r", overwrite_a=True, check_finite=False)[
                0
            ][:width]

    @property
    def system(self) -> tuple[Array, Array]:
        """Return the compressed regression problem, ``(R (m, p), QᵀY (m, J))``, m ≤ p + J.

        The rows of S are kept: they add the same constant to every candidate's error.
        """
        return self._triangle[:, : self.terms], self._triangle[:, self.terms :]

    def scale(self) -> Array:
        """Compute (p,) root mean squares of the columns of Θ, 1 where a column is all zero."""
        if self.rows <= 0:
            return np.ones(self.terms)
        rms = np.sqrt(np.square(self._triangle[:, : self.terms]).sum(axis=0) / self.rows)
        return np.where(rms > 1e-12, rms, 1.0)

    def rms(self, coefficients: Array) -> Array:
        """Compute the root mean square error of a linear model on all that the factor holds.

        Args:
            coefficients: (p, J).

        Returns:
            (J,) in the unit of Y; NaN where the factor is empty.
        """
        if self.rows <= 0:
            return np.full(self.outputs, np.nan)
        r, qty = self.system
        return np.asarray(np.sqrt(np.square(qty - r @ coefficients).sum(axis=0) / self.rows))
