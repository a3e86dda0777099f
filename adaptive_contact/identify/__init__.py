"""From windows of samples to a closed-form, contact-free leg model."""

from __future__ import annotations

from adaptive_contact.identify.domain import Domain
from adaptive_contact.identify.library import (
    ChangeLibrary,
    Library,
    LibraryName,
    leg_library,
    with_changes,
)
from adaptive_contact.identify.model import LegModel
from adaptive_contact.identify.regression import Factor, Fit, FitSettings, FitStatus, fit_sparse
from adaptive_contact.identify.window import Rows, Window, stack

__all__ = [
    "ChangeLibrary",
    "Domain",
    "Factor",
    "Fit",
    "FitSettings",
    "FitStatus",
    "LegModel",
    "Library",
    "LibraryName",
    "Rows",
    "Window",
    "fit_sparse",
    "leg_library",
    "stack",
    "with_changes",
]
