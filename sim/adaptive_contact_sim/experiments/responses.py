"""Figure 2: several responses of one joint to its command, with what models foretold."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.identify import (
    FitSettings,
    LegModel,
    LibraryName,
    Window,
    fit_sparse,
    leg_library,
    stack,
)
from adaptive_contact.robot import Robot
from adaptive_contact_sim.experiments.data import Stream
from adaptive_contact_sim.experiments.identification import PAPER_WINDOW
from adaptive_contact_sim.experiments.rows import factor_of, free_rows, residual_unit

__all__ = ["fitted", "predictions", "responses"]

Array = NDArray[np.float64]

FEMUR: Final = 1
# Ticks of the test stream that are drawn: three swings.
_SHOWN: Final = slice(1000, 1070)


def fitted(
    robot: Robot, stream: Stream, name: LibraryName, window: Window, threshold: float
) -> LegModel:
    """A model of a stream's free swings; λ in units of the residual."""
    library = leg_library(robot, robot.leg(stream.piece.leg_run.leg), name, window)
    rows = free_rows(stream, library)
    factor = factor_of(library, rows.windows, rows.windows.increment)
    fit = fit_sparse(factor, FitSettings(threshold=threshold, unit=residual_unit(factor)))
    return LegModel(library, fit.coefficients)


def predictions(model: LegModel, measured: Array, desired: Array) -> Array:
    """(n, J) rad, the positions foretold one tick before; NaN where the window was not full."""
    cut = stack(measured, desired, model.library.window)
    out = np.full_like(measured, np.nan)
    out[cut.tick + 1] = cut.measured[:, 0] + model.increment(cut.measured, cut.desired, cut.preview)
    return out


def responses(
    robot: Robot, train: Stream, test: Stream, thresholds: dict[LibraryName, float]
) -> dict[str, Any]:
    """What Figure 2 draws."""
    windows: dict[LibraryName, Window] = {"paper": PAPER_WINDOW, "servo": Window()}
    shown: dict[str, Any] = {
        "t_s": np.arange(len(test.swing))[_SHOWN] * 0.02,
        "measured": np.degrees(test.measured[_SHOWN, FEMUR]),
        "desired": np.degrees(test.desired[_SHOWN, FEMUR]),
        "swing": test.swing[_SHOWN],
    }
    for name, window in windows.items():
        model = fitted(robot, train, name, window, thresholds[name])
        told = predictions(model, test.measured, test.desired)
        shown[name] = np.degrees(told[_SHOWN, FEMUR])
    return shown
