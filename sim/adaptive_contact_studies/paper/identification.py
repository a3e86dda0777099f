r"""Identification as in the paper's section 4.2, and what R² does not show.

The state is the paper's Eq. 6, :math:`x[k] = (\theta[k], …, \theta[k-N])`, and the library its
Eq. 8; the sweep of λ stops when some state has no terms left.  R² is given for all states, for the
position :math:`\theta[k+1]`, and for its first and second backward differences.  Beside it stand
the root mean square over the noise floor and the number of terms.

``DiscreteSINDy`` with ``STLSQ`` sees the rows :math:`(\Theta, X_{next})`; here it sees the triangle
of their QR factorisation.  Column norms, ridge solutions, thresholds and the unbiased refit depend
on the rows through :math:`\Theta^\top\Theta` and :math:`\Theta^\top X_{next}` only, so that
supports are the same and coefficients differ by rounding.  λ is of coefficients in the units of the
data, or, where they are *normalised*, of columns with unit Euclidean norm (``normalize_columns``):
it then grows with the square root of the number of rows.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, Final, NamedTuple

import numpy as np
from pysindy.optimizers import STLSQ

from adaptive_contact.arrays import Array
from adaptive_contact.fit import FitStatus
from adaptive_contact.fit.train import learn
from adaptive_contact.model import Factor, LibraryName, Window, leg_library
from adaptive_contact.model.window import Rows
from adaptive_contact.robot import shipped_robot
from adaptive_contact_studies.paper.data import Stream, streams_of
from adaptive_contact_studies.paper.plan import PAPER_LEG, Plan
from adaptive_contact_studies.paper.rows import (
    PAPER_WINDOW,
    factor_of,
    free_rows,
    noise_floor,
    over_floor,
    rms_deg,
)
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

# Log-spaced, three to a decade, and the paper's own choice.
LAMBDAS: Final = tuple(sorted({round(10.0 ** (e / 3), 6) for e in range(-12, 7)} | {5.0}))
_SHORT: Final = Window(past_measured=1, past_desired=1, preview=1)
_SOURCES: Final = (
    *(*SIMULATOR, *LEARNER, "adaptive_contact_studies.paper.data"),
    "adaptive_contact_studies.paper.rows",
)


# PySINDy's default ridge term, which the paper does not mention changing.
RIDGE: Final = 0.05


class PaperFit(NamedTuple):
    """A fit as the paper makes it."""

    status: FitStatus  # `ok`, or `emptied` where some state has no terms left
    coefficients: Array  # (p, states)


def paper_fit(factor: Factor, threshold: float, *, normalised: bool = False) -> PaperFit:
    """Fit finite rows with PySINDy's STLSQ, unscaled targets."""
    optimizer = STLSQ(threshold=threshold, alpha=RIDGE, normalize_columns=normalised)
    with warnings.catch_warnings():
        # Read off the result instead: an emptied state from the support.
        warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
        warnings.filterwarnings("ignore", message=".*did not converge")
        optimizer.fit(*factor.system)
    coefficients = np.asarray(optimizer.coef_, dtype=np.float64).T
    kept = (coefficients != 0.0).any(axis=0).all()
    return PaperFit(FitStatus.OK if kept else FitStatus.EMPTIED, coefficients)


class Sweep(NamedTuple):
    """A convention in which the paper's λ can be meant."""

    plan: Plan
    window: Window
    unit: str  # of angles, ``rad`` or ``deg``
    normalised: bool  # columns


def sweeps_of(plan: Plan) -> list[Sweep]:
    """All conventions."""
    return [
        Sweep(plan, PAPER_WINDOW, "rad", normalised=False),
        Sweep(plan, PAPER_WINDOW, "deg", normalised=False),
        Sweep(plan, PAPER_WINDOW, "rad", normalised=True),
        Sweep(plan, _SHORT, "rad", normalised=True),
    ]


@rests_on(*_SOURCES)
def swept(work: Work, sweep: Sweep) -> dict[str, Any]:
    """Fit at every λ, with errors on both sets."""
    robot = shipped_robot()
    train, test = paper_streams(work, sweep.plan)
    library = leg_library(robot, robot.leg(PAPER_LEG), "paper", sweep.window)
    rows, held = free_rows(train, library), free_rows(test, library)
    scale = 180.0 / np.pi if sweep.unit == "deg" else 1.0
    fitted = _scale_angles(rows, scale)
    whole = factor_of(library, fitted, _next_state(fitted))
    points: list[dict[str, Any]] = []
    for threshold in (0.0, *LAMBDAS):
        fit = paper_fit(whole, threshold, normalised=sweep.normalised)
        point: dict[str, Any] = {
            "lambda": threshold,
            "status": fit.status.value,
            "terms": [int(n) for n in np.count_nonzero(fit.coefficients, axis=0)],
        }
        for name, windows in (("train", rows), ("test", held)):
            predicted = (
                library.evaluate(*_scale_angles(windows, scale)[:3]) @ fit.coefficients / scale
            )
            position = predicted[:, : len(library.joints)]
            point[name] = _scores(windows, position, states=predicted)
        points.append(point)
        if fit.status is FitStatus.EMPTIED and threshold >= 5.0:
            break
    emptied = [p["lambda"] for p in points if p["status"] == "emptied"]
    best = min(points, key=lambda p: max(p["test"]["over_floor"]))
    return {
        "unit": sweep.unit,
        "normalised": sweep.normalised,
        "window": dataclasses.asdict(sweep.window),
        "ridge": RIDGE,
        "points": points,
        "emptied_at": emptied[0] if emptied else None,
        "best": best["lambda"],
    }


@rests_on(*_SOURCES)
def selected(work: Work, item: tuple[Plan, LibraryName, Window]) -> dict[str, Any]:
    """Fit as the product does, λ chosen by its own rule, with errors on the test set."""
    plan, name, window = item
    train, test = paper_streams(work, plan)
    streams = {PAPER_LEG: [stream.stretch for stream in train]}
    training = learn(
        shipped_robot(), streams, origin="the paper's segments", library=name, window=window
    )
    model, found = training.baseline.legs[PAPER_LEG].model, training.figures[PAPER_LEG]
    windows = free_rows(test, model.library)
    position = windows.measured[:, 0] + model.increment(*windows[:3])
    return {
        "library": name,
        "lambda": found.threshold,
        "terms": found.terms,
        "size": found.library_size,
        "held_out_rms": np.degrees(found.held_out_rms),
        "test": _scores(windows, position, states=None),
    }


def identification(work: Work, plan: Plan) -> dict[str, Any]:
    """All of section 4.2 on the paper's training and test segments."""
    robot = shipped_robot()
    train, test = paper_streams(work, plan)
    library = leg_library(robot, robot.leg(PAPER_LEG), "paper", PAPER_WINDOW)
    rows, held = free_rows(train, library), free_rows(test, library)
    ours: list[tuple[Plan, LibraryName, Window]] = [
        (plan, "paper", PAPER_WINDOW),
        (plan, "servo", Window()),
    ]
    return {
        "rows": {"train": len(rows.tick), "test": len(held.tick)},
        "floor_deg": float(np.degrees(noise_floor())),
        "reading_noise_deg": rms_deg(
            np.concatenate([stream.arrays.measured - stream.arrays.angle for stream in test])
        ),
        "naive": _scores(held, held.measured[:, 0], states=None),
        "sweeps": work.each("sweeps of λ", swept, sweeps_of(plan)),
        "selection": work.each("our own fits", selected, ours),
    }


def paper_streams(work: Work, plan: Plan) -> tuple[list[Stream], list[Stream]]:
    """The paper's training and test segments."""
    return streams_of(work, plan.paper_runs("train")), streams_of(work, plan.paper_runs("tune"))


def _scale_angles(windows: Rows, factor: float) -> Rows:
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
    left = np.square(predicted - actual).sum()
    whole = np.square(actual - actual.mean(axis=0)).sum() if len(actual) else 0.0
    return float(1.0 - left / whole) if whole > 0.0 else float("nan")
