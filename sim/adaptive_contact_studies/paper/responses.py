"""Figure 2: several responses of one joint to its command, with what models foretold."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.fit import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import LegModel, LibraryName, Window, leg_library, stack
from adaptive_contact.robot import Robot
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.identification import PAPER_WINDOW
from adaptive_contact_studies.paper.rows import (
    NO_MODEL,
    factor_of,
    free_rows,
    residual_unit,
)

__all__ = ["Fitted", "fitted", "predictions", "responses"]

Array = NDArray[np.float64]

FEMUR: Final = 1
# Ticks of the test stream that are drawn, three swings, from this one on where there are so many.
_FIRST: Final = 1000
_DRAWN: Final = 70


class Fitted(NamedTuple):
    """A model, and how its fit ended.

    Attributes:
        model: None where the fit left nothing, so that nobody predicts with zeros.
        status: of the fit.
    """

    model: LegModel | None
    status: FitStatus


def fitted(
    robot: Robot, stream: Stream, name: LibraryName, window: Window, threshold: float
) -> Fitted:
    """A model of a stream's free swings; λ in units of the residual."""
    library = leg_library(robot, robot.leg(stream.piece.leg_run.leg), name, window)
    rows = free_rows(stream, library)
    factor = factor_of(library, rows.windows, rows.windows.increment)
    fit = fit_sparse(factor, FitSettings(threshold=threshold, unit=residual_unit(factor)))
    return Fitted(
        None if fit.status in NO_MODEL else LegModel(library, fit.coefficients), fit.status
    )


def predictions(model: LegModel | None, measured: Array, desired: Array) -> Array:
    """(n, J) rad, the positions foretold one tick before; NaN where nothing foretells them.

    That is without a model, and where the window was not full.
    """
    out = np.full_like(measured, np.nan)
    if model is None:
        return out
    cut = stack(measured, desired, model.library.window)
    out[cut.tick + 1] = cut.measured[:, 0] + model.increment(cut.measured, cut.desired, cut.preview)
    return out


def responses(
    robot: Robot, train: Stream, test: Stream, thresholds: dict[LibraryName, float]
) -> dict[str, Any]:
    """What Figure 2 draws."""
    windows: dict[LibraryName, Window] = {"paper": PAPER_WINDOW, "servo": Window()}
    first = max(min(_FIRST, len(test.swing) - _DRAWN), 0)
    drawn = slice(first, first + _DRAWN)
    shown: dict[str, Any] = {
        "t_s": np.arange(len(test.swing))[drawn] * 0.02,
        "measured": np.degrees(test.measured[drawn, FEMUR]),
        "desired": np.degrees(test.desired[drawn, FEMUR]),
        "swing": test.swing[drawn],
        "status": {},
    }
    for name, window in windows.items():
        fit = fitted(robot, train, name, window, thresholds[name])
        told = predictions(fit.model, test.measured, test.desired)
        shown["status"][name] = fit.status.value
        shown[name] = np.degrees(told[drawn, FEMUR])
    return shown
