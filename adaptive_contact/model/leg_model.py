r"""Defines the closed-form leg model: a library and a sparse matrix of coefficients.

.. math:: \hat\theta[k+1] = \theta[k] + \Xi^\top \Theta(x[k], u[k])
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.errors import IdentificationError
from adaptive_contact.model.library import Library
from adaptive_contact.model.window import Rows

__all__ = ["LegModel"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class LegModel:
    """Predicts one leg's contact-free motion, one tick ahead.

    Attributes:
        library: the terms.
        coefficients: (p, J), zero outside the support.
        version: 0 for a baseline, 1 once it moves, +1 with every model that takes its place.
    """

    library: Library
    coefficients: Array
    version: int = 0

    def __post_init__(self) -> None:
        expected = (self.library.size, len(self.library.joints))
        if self.coefficients.shape != expected:
            raise IdentificationError(
                f"model: coefficients are {self.coefficients.shape}; expected {expected} "
                f"for the library '{self.library.name}'"
            )
        if not np.isfinite(self.coefficients).all():
            raise IdentificationError("model: a coefficient is not finite; fit a new one")

    def moved(self, coefficients: Array, version: int) -> LegModel:
        """Return the same model with other coefficients."""
        return LegModel(self.library, coefficients, version)

    @property
    def support(self) -> NDArray[np.bool_]:
        """(p, J) which terms each joint uses."""
        return np.asarray(self.coefficients != 0.0)

    def increment(self, measured: Array, desired: Array, preview: Array) -> Array:
        """Predict the next movement.

        Args:
            measured: (..., N + 1, J) rad, lag 0 first.
            desired: (..., N' + 1, J) rad, lag 0 first.
            preview: (..., M, J) rad.

        Returns:
            (..., J) rad, to be added to ``measured[..., 0, :]``.
        """
        return self.library.evaluate(measured, desired, preview) @ self.coefficients

    def residual(self, rows: Rows) -> Array:
        """Compute (n, J) rad, measured minus predicted, for windows cut from a stream."""
        return rows.increment - self.increment(rows.measured, rows.desired, rows.preview)

    def equations(self, digits: int = 4) -> list[str]:
        """Write one equation per joint as text, its largest coefficients first."""
        lines = []
        for joint, name in enumerate(self.library.joints):
            parts = [f"{c:+.{digits}g}·{term}" for term, c in self.terms(joint)]
            lines.append(f"θ_{name}[k+1] = θ_{name} {' '.join(parts)}".rstrip())
        return lines

    def terms(self, joint: int) -> list[tuple[str, float]]:
        """Return a joint's terms and coefficients, largest first."""
        column = self.coefficients[:, joint]
        order = np.argsort(-np.abs(column), kind="stable")
        return [(self.library.names[i], float(column[i])) for i in order if column[i] != 0.0]
