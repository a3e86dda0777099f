"""A model as it is told to people and programs."""

from __future__ import annotations

from adaptive_contact.identify import LegModel
from adaptive_contact.robot import Leg
from adaptive_contact.wire import ModelReport, ModelTerm

__all__ = ["report_of"]


def report_of(leg: Leg, model: LegModel, threshold: float, origin: str | None) -> ModelReport:
    """Terms, coefficients and equations of a leg's model.

    Args:
        leg: whose.
        model: in force.
        threshold: of the statistic over one tick.
        origin: where the model comes from.
    """
    joints = range(len(leg.joints))
    return ModelReport(
        leg=leg.id,
        model_version=model.version,
        joints=list(leg.joints),
        terms=[
            [ModelTerm(name=name, coefficient=value) for name, value in model.terms(joint)]
            for joint in joints
        ],
        equations=model.equations(),
        library=model.library.name,
        threshold=threshold,
        origin=origin,
    )
