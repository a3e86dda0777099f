"""The compressed fit is PySINDy's own on the raw rows, for both libraries."""

from __future__ import annotations

import warnings

import numpy as np
import pysindy as ps
import pytest
from pysindy.feature_library.base import BaseFeatureLibrary

from adaptive_contact.fit import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import Window, leg_library
from adaptive_contact.robot import Robot
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.identification import paper_fit
from adaptive_contact_studies.paper.rows import PAPER_WINDOW, factor_of, free_rows

# N, N', M of the study, and a smaller one.  The larger has singular values below 1e-6 of the
# largest, which PySINDy's unbiased refit cuts off; the smaller keeps full rank in its eyes.
PAPER = PAPER_WINDOW
SMALL = Window(past_measured=1, past_desired=1, preview=1)
# Of a coefficient that is zero but for rounding.
ROUNDING = 1e-11


def discrete_sindy(
    library: BaseFeatureLibrary,
    state: np.ndarray,
    control: np.ndarray,
    following: np.ndarray,
    **stlsq: object,
) -> np.ndarray:
    """(terms, states) coefficients of PySINDy's discrete-time model."""
    model = ps.DiscreteSINDy(feature_library=library, optimizer=ps.STLSQ(**stlsq))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(state, t=1, x_next=following, u=control)
    return np.asarray(model.coefficients()).T


def system(robot: Robot, stream: Stream, name: str, window: Window):
    library = leg_library(robot, robot.leg("rf"), name, window)
    windows = free_rows([stream], library)
    n = len(windows.tick)
    state = windows.measured.reshape(n, -1)
    control = np.concatenate([windows.desired.reshape(n, -1), windows.preview.reshape(n, -1)], 1)
    return library, windows, state, control


@pytest.mark.parametrize(
    ("name", "window", "threshold", "sparse"),
    [
        ("servo", Window(), 0.0, False),
        ("servo", Window(), 0.3, True),
        ("servo", Window(), 0.5, True),
        ("paper", SMALL, 0.1, False),
        ("paper", SMALL, 10.0, True),
        ("paper", PAPER, 0.0, False),
        ("paper", PAPER, 20.0, True),
    ],
)
def test_our_fit_equals_stlsq_on_the_raw_rows(
    robot: Robot,
    free_stream: Stream,
    name: str,
    window: Window,
    threshold: float,
    sparse: bool,
) -> None:
    """Increments over their residual, columns over their root mean square."""
    library, windows, *_ = system(robot, free_stream, name, window)
    factor = factor_of(library, windows, windows.increment)
    unit = fit_sparse(factor, FitSettings()).rms
    settings = FitSettings(threshold=threshold, unit=tuple(unit.tolist()))
    fit = fit_sparse(factor, settings)
    scale = factor.scale()
    theta = library.evaluate(windows.measured, windows.desired, windows.preview)
    optimizer = ps.STLSQ(threshold=threshold, alpha=settings.ridge * len(theta))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        optimizer.fit(theta / scale, windows.increment / unit)
    expected = optimizer.coef_.T / scale[:, None] * unit
    assert fit.status is FitStatus.OK
    np.testing.assert_array_equal(fit.support, expected != 0)
    np.testing.assert_allclose(fit.coefficients, expected, rtol=0, atol=1e-8)
    # No agreement of two empty models, of models that keep everything, or of tiny numbers.
    kept = fit.support.sum(axis=0)
    assert (kept > 3).all()
    assert not sparse or (kept < 0.8 * library.size).all()
    assert np.abs(expected).max(axis=0).min() > 0.01
    assert (fit.rms < 0.2 * np.sqrt(np.square(windows.increment).mean(axis=0))).all()


@pytest.mark.parametrize("window", [SMALL, PAPER])
@pytest.mark.parametrize(
    ("threshold", "normalised"),
    [(0.0, False), (0.01, False), (0.1, False), (0.0, True), (0.2, True), (1.0, True)],
)
def test_the_papers_fit_equals_discrete_sindy_with_its_own_library(
    robot: Robot, free_stream: Stream, window: Window, threshold: float, normalised: bool
) -> None:
    """Eq. 8 in PySINDy's own words, all delayed states predicted; raw and normalised columns."""
    library, windows, state, control = system(robot, free_stream, "paper", window)
    new = (windows.measured[:, 0] + windows.increment)[:, None]
    following = np.concatenate([new, windows.measured[:, :-1]], axis=1).reshape(len(state), -1)
    fit = paper_fit(factor_of(library, windows, following), threshold, normalised=normalised)
    theirs = ps.PolynomialLibrary(degree=2) + ps.FourierLibrary(n_frequencies=1)
    coefficients = discrete_sindy(
        theirs, state, control, following,
        threshold=threshold, alpha=0.05, normalize_columns=normalised,
    )  # fmt: skip
    expected = in_our_order(coefficients, state.shape[1] + control.shape[1])
    assert (expected != 0).any()
    differ = (fit.coefficients != 0) != (expected != 0)
    # A delayed state is a copy of another: of its other terms the refit leaves rounding, or zero.
    assert np.abs(fit.coefficients - expected)[differ].max(initial=0.0) < ROUNDING
    np.testing.assert_allclose(fit.coefficients, expected, rtol=0, atol=1e-8)


def in_our_order(theirs: np.ndarray, variables: int) -> np.ndarray:
    """From 1, x, pairs, sin x0, cos x0, sin x1 … to 1, x, sin, cos, pairs."""
    pairs = variables * (variables + 1) // 2
    waves = 1 + variables + pairs
    order = [
        *range(1 + variables),
        *(waves + 2 * i for i in range(variables)),
        *(waves + 2 * i + 1 for i in range(variables)),
        *range(1 + variables, 1 + variables + pairs),
    ]
    assert sorted(order) == list(range(len(theirs)))
    return theirs[order]
