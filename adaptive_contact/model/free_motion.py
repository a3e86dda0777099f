"""Defines what detection needs to know of a leg's free motion; the learning publishes it.

The value that passes the other way is
:class:`~adaptive_contact.model.labelled_swing.LabelledSwing`.
"""

from __future__ import annotations

from typing import NamedTuple

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.model.training_domain import Domain


class Covariance(NamedTuple):
    """Holds the covariance of a model's coefficients, over the noise's variance."""

    terms: Ints  # (J, n) which of the p terms each joint's recursion moves
    per_scale: Array  # (J, n) reciprocal scale of each
    root: Array  # (J, n, n) square root of their covariance


class FreeMotion(NamedTuple):
    """Holds all that a tick needs to judge a leg: model, whitening, thresholds, variance scale."""

    coefficients: Array  # (p, J) of the model in force; good until the next row is learned
    # of the residuals, over the baseline's; 1 for a leg as it was first known
    variance_scale: float
    covariance: Covariance | None  # of the coefficients while it is inflated, else None
    from_prior: bool  # the leg began with a prior: what it does in a stance is not known
    # the leg may differ from its model, which is of before a change, or of a prior
    changed: bool
    sure: bool  # the leg is as its model says: not changed, and valid by its status
    after_known: bool  # whitening and thresholds after the turn are of the leg itself
    whiten: Array  # (contexts, windows, J, J) of sums of residuals
    thresholds: Array  # (directions, windows) of the statistic
    domain: Domain | None  # where the model has been; None if that is not known
