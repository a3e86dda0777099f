"""Reports a model to people and programs."""

from __future__ import annotations

from collections.abc import Iterable

from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import ChangeLibrary
from adaptive_contact.robot import Leg
from adaptive_contact.wire import ModelReport, ModelTerm

__all__ = ["report_of"]


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
    )


def _terms(named: Iterable[tuple[str, float]]) -> list[ModelTerm]:
    """Those that there are."""
    return [ModelTerm(name=name, coefficient=float(c)) for name, c in named if c != 0.0]
