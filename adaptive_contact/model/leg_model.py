r"""Defines the closed-form leg model: a library and a sparse matrix of coefficients.

.. math:: \hat\theta[k+1] = \theta[k] + \Xi^\top \Theta(x[k], u[k])
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.errors import IdentificationError
from adaptive_contact.model.library import ChangeLibrary, Library
from adaptive_contact.robot import Leg
from adaptive_contact.wire import MAX_ANGLE_RAD, ModelReport, ModelTerm


@dataclasses.dataclass(frozen=True)
class LegModel:
    """Predicts one leg's contact-free motion, one tick ahead."""

    library: Library  # the terms
    coefficients: Array  # (p, J), zero outside the support
    version: int = 0  # 0 for a baseline, 1 once it moves, +1 with every model that takes its place

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
    def support(self) -> Mask:
        """Return which terms each joint uses, (p, J)."""
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


def rollout(model: LegModel, window: Array, commands: Sequence[Sequence[float]]) -> list[Array]:
    """Predict positions several ticks ahead, each prediction taken for the next reading.

    Args:
        model: of the leg free of contact; of a library without preview.
        window: (w,) rad, measured and desired up to the tick before, as a prediction is made from.
        commands: (J,) rad each, from the next tick on.

    Returns:
        (J,) rad, where the leg would be at each of those ticks; fewer where the model, left to
        itself, runs away: one of polynomials does.
    """
    shape = model.library.window
    joints = len(model.library.joints)
    flat = window.copy()
    past = flat.reshape(-1, joints)
    measured, desired = past[: shape.past_measured + 1], past[shape.past_measured + 1 :]
    places: list[Array] = []
    for command in commands:
        now = measured[0] + model.library.evaluate_flat(flat) @ model.coefficients
        if not np.all(np.abs(now) <= MAX_ANGLE_RAD):  # neither does NaN
            break
        places.append(now)
        for rows, newest in ((measured, now), (desired, command)):
            rows[1:] = rows[:-1].copy()
            rows[0] = newest
    return places


def report_of(leg: Leg, model: LegModel, threshold: float, origin: str | None) -> ModelReport:
    """Report the terms, coefficients and equations of a leg's model.

    Args:
        leg: whose.
        model: in force.
        threshold: of the statistic over one tick.
        origin: where the model comes from.
    """
    joints = range(len(leg.joints))
    library = model.library
    first: list[list[ModelTerm]] = []
    if isinstance(library, ChangeLibrary) and model.support[len(library.first) :].any():
        first = [_terms(zip(library.names, column, strict=False)) for column in library.first.T]
    return ModelReport(
        leg=leg.id,
        model_version=model.version,
        joints=list(leg.joints),
        terms=[_terms(model.terms(joint)) for joint in joints],
        first=first,
        equations=model.equations(),
        library=library.name,
        threshold=threshold,
        origin=origin,
        slope_rad=library.slope_rad if library.name == "servo" else None,
    )


def _terms(named: Iterable[tuple[str, float]]) -> list[ModelTerm]:
    """Return the terms that are in use."""
    return [ModelTerm(name=name, coefficient=float(c)) for name, c in named if c != 0.0]
