"""Identification: from rows of free motion to a sparse closed-form model, by PySINDy."""

from __future__ import annotations

from adaptive_contact.fit.sparse_regression import Fit, FitSettings, FitStatus, fit_sparse

__all__ = ["Fit", "FitSettings", "FitStatus", "fit_sparse"]
