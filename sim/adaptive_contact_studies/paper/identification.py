r"""Identification as in the paper's section 4.2, and what R² does not show.

The state is the paper's Eq. 6, :math:`x[k] = (\theta[k], …, \theta[k-N])`, and the library its
Eq. 8; the sweep of λ stops when some state has no terms left.  R² is given for all states, for the
position :math:`\theta[k+1]`, and for its first and second backward differences.  Beside it stand
the root mean square over the noise floor, the sensitivity of the prediction to the joint's own
command, the number of terms and the condition number.

Figure 2: several responses of one joint to its command, with what models predicted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.fit import Fit, FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import (
    Factor,
    LegModel,
    Library,
    LibraryName,
    Window,
    leg_library,
)
from adaptive_contact.model.window import Rows
from adaptive_contact.robot import Leg, Robot
from adaptive_contact_studies.paper.compression import RIDGE, PaperFit, paper_fit
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.rows import (
    NO_MODEL,
    PAPER_WINDOW,
    FreeRows,
    blockwise,
    factor_of,
    free_rows,
    noise_floor,
    over_floor,
    pick,
    predictions,
    residual_unit,
    rms_deg,
)

# Log-spaced, three to a decade, and the paper's own choice.
LAMBDAS: Final = tuple(sorted({round(10.0 ** (e / 3), 6) for e in range(-12, 7)} | {5.0}))
PAPER_LAMBDA: Final = 5.0
# What stands for the condition number of columns that repeat each other.
SINGULAR: Final = "infinite (singular)"
# The sparsest model whose held-out error is within this of the best, for every joint, is picked:
# the product's rule (docs/decisions/0005-half-a-tick.md).
TOLERANCE: Final = 1.005
FOLDS: Final = 5
# Our own sweep, in units of the residual.
OUR_LAMBDAS: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
# Conventions in which a λ can be meant: unit of angles, whether columns are normalised, N, N', M.
CONVENTIONS: Final = (
    ("rad", False, PAPER_WINDOW),
    ("deg", False, PAPER_WINDOW),
    ("rad", True, PAPER_WINDOW),
    ("rad", True, Window(past_measured=1, past_desired=1, preview=1)),
)
_STEP_RAD: Final = 1e-3
_SELECTED: Final[tuple[LibraryName, ...]] = ("paper", "servo")
_WINDOWS: Final[tuple[tuple[LibraryName, tuple[int, int, int]], ...]] = (
    ("linear", (1, 1, 0)),
    ("linear", (3, 3, 0)),
    ("paper", (0, 0, 1)),
    ("paper", (1, 1, 0)),
    ("paper", (1, 1, 1)),
    ("paper", (2, 2, 0)),
    ("paper", (2, 2, 1)),
    ("paper", (3, 3, 0)),
    ("servo", (1, 1, 0)),
    ("servo", (2, 2, 0)),
    ("servo", (3, 3, 0)),
    ("servo", (3, 3, 1)),
    ("servo", (5, 5, 0)),
)


def identification(
    robot: Robot, train: Stream, test: Stream, progress: Callable[[float], None]
) -> dict[str, Any]:
    """All of section 4.2 on one training and one test stream."""
    leg = robot.leg(train.piece.leg_run.leg)
    library = leg_library(robot, leg, "paper", PAPER_WINDOW)
    rows, held = free_rows(train, library), free_rows(test, library)
    floor = noise_floor()
    sweeps = []
    for unit, normalised, window in CONVENTIONS:
        swept = leg_library(robot, leg, "paper", window)
        fitted, tried = free_rows(train, swept), free_rows(test, swept)
        sweeps.append(_sweep(swept, fitted, tried, unit, normalised))
        progress(0.6 / len(CONVENTIONS))
    selection = []
    for name in _SELECTED:
        selection.append(_selection(robot, leg, name, train, test))
        progress(0.3 / len(_SELECTED))
    windows = []
    for named, (past_measured, past_desired, preview) in _WINDOWS:
        window = Window(past_measured, past_desired, preview)
        windows.append(_window_row(robot, leg, named, window, train, test))
        progress(0.1 / len(_WINDOWS))
    return {
        "window": dataclasses.asdict(PAPER_WINDOW),
        "rows": {"train": len(rows.swing), "test": len(held.swing)},
        "floor_deg": float(np.degrees(floor)),
        "reading_noise_deg": rms_deg(test.measured - test.arrays.angle),
        "naive": _scores(held.windows, held.windows.measured[:, 0], states=None),
        "sweeps": sweeps,
        "selection": selection,
        "windows": windows,
    }


def _sweep(
    library: Library, train: FreeRows, test: FreeRows, unit: str, normalised: bool
) -> dict[str, Any]:
    """The paper's sweep of λ in one convention."""
    factor_of_unit = 180.0 / np.pi if unit == "deg" else 1.0
    fitted = _in_unit(train.windows, factor_of_unit)
    tried = _in_unit(test.windows, factor_of_unit)
    factor = factor_of(library, fitted, _next_state(fitted))
    position = fitted.measured[:, 0] + fitted.increment
    folds = _fold_factors(library, FreeRows(fitted, train.swing), position)
    r, _ = factor.system
    points: list[dict[str, Any]] = []
    joints = len(library.joints)
    for threshold in (0.0, *LAMBDAS):
        fit_of = partial(paper_fit, threshold=threshold, normalised=normalised)
        fit = fit_of(factor)
        predicted = blockwise(library, tried, fit.coefficients) / factor_of_unit
        scores = _scores(test.windows, predicted[:, :joints], states=predicted)
        on_train = blockwise(library, fitted, fit.coefficients) / factor_of_unit
        points.append(
            {
                "lambda": threshold,
                "status": fit.status.value,
                "terms": fit.terms,
                "train": _scores(train.windows, on_train[:, :joints], states=on_train),
                "test": scores,
                "held_out_rms": _held_out(folds, fit_of, [FitStatus.OK], factor_of_unit),
                "sensitivity": _sensitivity(library, tried, fit.coefficients[:, :joints]),
                "condition": _support_condition(r, fit.coefficients[:, :joints]),
                "largest": float(np.abs(fit.coefficients).max()),
            }
        )
        if fit.status is FitStatus.EMPTIED and threshold >= PAPER_LAMBDA:
            break
    emptied = [p["lambda"] for p in points if p["status"] == "emptied"]
    return {
        "unit": unit,
        "normalised": normalised,
        "window": dataclasses.asdict(library.window),
        "size": library.size,
        "ridge": RIDGE,
        "condition": shown_condition(_condition(r)),
        "points": points,
        "emptied_at": emptied[0] if emptied else None,
        "picked": sparsest_of(points),
    }


def sparsest_of(points: Iterable[dict[str, Any]]) -> float | None:
    """The largest λ at which every joint's held-out error is near its best.

    A mean over joints would let one of them pay for the others' sparsity.  The smallest λ where the
    joints' best lie apart; None where no fit keeps all joints.
    """
    points = [p for p in points if p["status"] == "ok" and p["held_out_rms"] is not None]
    if not points:
        return None
    errors = np.array([p["held_out_rms"] for p in points], dtype=np.float64)
    near = (errors <= TOLERANCE * errors.min(axis=0)).all(axis=1)
    values = [float(p["lambda"]) for p in points]
    return max((v for v, n in zip(values, near, strict=True) if n), default=min(values))


def _in_unit(windows: Rows, factor: float) -> Rows:
    angles = {name: factor * getattr(windows, name) for name in Rows._fields if name != "tick"}
    return windows._replace(**angles)


def _next_state(windows: Rows) -> Array:
    """(n, (N + 1) J) the next state: the new positions, then the older ones moved up."""
    new = windows.measured[:, :1] + windows.increment[:, None]
    state = np.concatenate([new, windows.measured[:, :-1]], axis=1)
    return np.asarray(state.reshape(len(state), state.shape[1] * state.shape[2]))


def _scores(windows: Rows, position: Array, states: Array | None) -> dict[str, Any]:
    """R² and root mean square of predicted positions, rad.

    Args:
        windows: n of them, in rad.
        position: (n, J) predicted θ[k+1].
        states: (n, states) predicted next state; None for the naive prediction, which repeats
            the present one.
    """
    now = windows.measured[:, 0]
    actual = now + windows.increment
    figures: dict[str, Any] = {
        "position": _r2(position, actual),
        "velocity": _r2(position - now, windows.increment),
        "rms_deg": rms_deg(actual - position),
        "over_floor": over_floor(actual - position),
    }
    if windows.measured.shape[1] > 1:
        before = windows.measured[:, 1]
        figures["acceleration"] = _r2(position - 2 * now + before, actual - 2 * now + before)
        wanted = _next_state(windows)
        predicted = windows.measured.reshape(wanted.shape) if states is None else states
        figures["all"] = _r2(predicted, wanted)
    return figures


def _r2(predicted: Array, actual: Array) -> float:
    """Share of the variance explained, all columns together; NaN where nothing varies."""
    if not len(actual):
        return float("nan")
    left = np.square(predicted - actual).sum()
    whole = np.square(actual - actual.mean(axis=0)).sum()
    return float(1.0 - left / whole) if whole > 0.0 else float("nan")


def _sensitivity(library: Library, windows: Rows, coefficients: Array) -> list[float]:
    """Mean change of each joint's prediction per change of its own present command.

    A difference quotient; the library and the command may be in any unit of angle.
    """
    if not len(windows.tick):
        return [float("nan")] * len(library.joints)
    some = slice(0, None, max(1, len(windows.tick) // 4000))
    measured, desired, preview = (part[some] for part in windows[:3])
    base = library.evaluate(measured, desired, preview) @ coefficients
    slopes = []
    for joint in range(len(library.joints)):
        moved = desired.copy()
        moved[:, 0, joint] += _STEP_RAD
        change = library.evaluate(measured, moved, preview) @ coefficients - base
        slopes.append(float(change[:, joint].mean() / _STEP_RAD))
    return slopes


def _support_condition(r: Array, coefficients: Array) -> list[float | str | None]:
    """Condition number of each joint's kept columns, scaled to unit norm; None without any."""
    values: list[float | str | None] = []
    for column in coefficients.T:
        kept = r[:, column != 0.0]
        if kept.shape[1] == 0:
            values.append(None)
            continue
        values.append(shown_condition(_condition(kept / np.linalg.norm(kept, axis=0))))
    return values


def shown_condition(condition: float) -> float | str:
    """A condition number as the results hold it: JSON knows no infinity, and none is not known."""
    return condition if np.isfinite(condition) else SINGULAR


def _condition(matrix: Array) -> float:
    """Largest over smallest singular value; infinite where rows or columns are dependent."""
    if len(matrix) < matrix.shape[1]:
        return float("inf")
    values = np.linalg.svd(matrix, compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0.0 else float("inf")


def _fold_factors(library: Library, rows: FreeRows, target: Array) -> list[Factor]:
    """One factor per fold of swings, ten neighbours together."""
    fold = rows.swing // 10 % FOLDS
    parts = [fold == f for f in range(FOLDS)]
    return [factor_of(library, pick(rows.windows, part), target[part]) for part in parts]


def _held_out(
    folds: Sequence[Factor],
    fit_of: Callable[[Factor], PaperFit | Fit],
    ends: Collection[FitStatus],
    unit: float = 1.0,
) -> list[float] | None:
    """(J,) degrees on swings a fit has not seen; None where one has no rows, or ends otherwise."""
    terms, outputs = folds[0].terms, folds[0].outputs
    squares, count = np.zeros(outputs), 0.0
    for f, inside in enumerate(folds):
        others = Factor.merged((o for i, o in enumerate(folds) if i != f), terms, outputs)
        fit = fit_of(others)
        if fit.status not in ends or inside.rows <= 0:
            return None
        squares += np.square(inside.rms(fit.coefficients)) * inside.rows
        count += inside.rows
    return [float(v) for v in np.degrees(np.sqrt(squares / count) / unit)]


def _selection(
    robot: Robot, leg: Leg, name: LibraryName, train: Stream, test: Stream
) -> dict[str, Any]:
    """Our own sweep: scaled columns, increments, λ in units of the residual."""
    window = PAPER_WINDOW if name == "paper" else Window()
    library = leg_library(robot, leg, name, window)
    rows, held = free_rows(train, library), free_rows(test, library)
    folds = _fold_factors(library, rows, rows.windows.increment)
    whole = Factor.merged(folds, library.size, len(library.joints))
    unit = residual_unit(fit_sparse(whole, FitSettings()))
    points = []
    for threshold in OUR_LAMBDAS:
        fit_of = partial(fit_sparse, settings=FitSettings(threshold=threshold, unit=unit))
        fit = fit_of(whole)
        residual = held.windows.increment - blockwise(library, held.windows, fit.coefficients)
        points.append(
            {
                "lambda": threshold,
                "status": fit.status.value,
                "terms": [int(n) for n in fit.support.sum(axis=0)],
                "held_out_rms": _held_out(folds, fit_of, [FitStatus.OK, FitStatus.EMPTIED]),
                "test_rms_deg": rms_deg(residual),
                "over_floor": over_floor(residual),
                "sensitivity": _sensitivity(library, held.windows, fit.coefficients),
            }
        )
    return {
        "library": name,
        "window": dataclasses.asdict(window),
        "size": library.size,
        "points": points,
        "picked": sparsest_of(points),
    }


def _window_row(
    robot: Robot, leg: Leg, name: LibraryName, window: Window, train: Stream, test: Stream
) -> dict[str, Any]:
    """One line of the study of N, N' and M: plain least squares, error on the test set."""
    library = leg_library(robot, leg, name, window)
    rows, held = free_rows(train, library), free_rows(test, library)
    factor = factor_of(library, rows.windows, rows.windows.increment)
    fit = fit_sparse(factor, FitSettings())
    residual = held.windows.increment - blockwise(library, held.windows, fit.coefficients)
    return {
        "library": name,
        "window": [window.past_measured, window.past_desired, window.preview],
        "terms": library.size,
        "status": fit.status.value,
        "condition": shown_condition(fit.condition),
        "test_rms_deg": rms_deg(residual),
        "over_floor": over_floor(residual),
    }


FEMUR: Final = 1
# Ticks of the test stream that are drawn, three swings, from this one on where there are so many.
_FIRST: Final = 1000
_DRAWN: Final = 70


class Fitted(NamedTuple):
    """A model, and how its fit ended."""

    model: LegModel | None  # None where the fit left nothing, so that no prediction uses zeros
    status: FitStatus  # of the fit


def fitted(
    robot: Robot, stream: Stream, name: LibraryName, window: Window, threshold: float
) -> Fitted:
    """A model of a stream's free swings; λ in units of the residual."""
    library = leg_library(robot, robot.leg(stream.piece.leg_run.leg), name, window)
    rows = free_rows(stream, library)
    factor = factor_of(library, rows.windows, rows.windows.increment)
    unit = residual_unit(fit_sparse(factor, FitSettings()))
    fit = fit_sparse(factor, FitSettings(threshold=threshold, unit=unit))
    return Fitted(
        None if fit.status in NO_MODEL else LegModel(library, fit.coefficients), fit.status
    )


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
        predicted = predictions(fit.model, test.measured, test.desired)
        shown["status"][name] = fit.status.value
        shown[name] = np.degrees(predicted[drawn, FEMUR])
    return shown
