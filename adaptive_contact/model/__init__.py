"""Describes a leg's free motion: library, model, noise, tail, and the file of them."""

from __future__ import annotations

from adaptive_contact.model.factor import Factor
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import (
    ChangeLibrary,
    Library,
    LibraryName,
    leg_library,
    with_changes,
)
from adaptive_contact.model.model_file import (
    Baseline,
    LegBaseline,
    load_baseline,
    save_baseline,
    shipped_baseline,
)
from adaptive_contact.model.training_domain import Domain
from adaptive_contact.model.window import Rows, Window, stack

__all__ = [
    "Baseline",
    "ChangeLibrary",
    "Domain",
    "Factor",
    "LegBaseline",
    "LegModel",
    "Library",
    "LibraryName",
    "Rows",
    "Window",
    "leg_library",
    "load_baseline",
    "save_baseline",
    "shipped_baseline",
    "stack",
    "with_changes",
]
