"""Fits a sparse closed-form model to rows of free motion, by PySINDy."""

from __future__ import annotations

from adaptive_contact.fit.sparse_regression import Fit, FitSettings, FitStatus, fit_sparse

__all__ = ["Fit", "FitSettings", "FitStatus", "fit_sparse"]
