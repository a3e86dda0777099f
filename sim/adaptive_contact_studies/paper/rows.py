"""Regression rows of simulated streams, and the floor that no prediction gets below."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.fit import Fit
from adaptive_contact.model import Factor, LegModel, Library, Rows, Window, stack
from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.servo import QUANTUM_RAD
from adaptive_contact_studies.paper.data import Stream

# N, N', M of the paper's model; the paper does not print its own (see the window study).
PAPER_WINDOW: Final = Window(past_measured=2, past_desired=2, preview=1)
# Rows whose regressors are held at once: 295 doubles each, some tens of megabytes.
BLOCK: Final = 20_000


class FreeRows(NamedTuple):
    """Windows of free swing ticks."""

    windows: Rows  # (n, ...) the windows with what came next
    swing: Ints  # (n,) number of the swing each lies in, for folds


def free_rows(stream: Stream, library: Library) -> FreeRows:
    """Windows whose tick and successor are free swing ticks, of finite values throughout."""
    cut = stack(stream.measured, stream.desired, library.window)
    use = stream.swing & stream.stretch.free
    usable = use[cut.tick] & use[cut.tick + 1]
    for part in cut[:4]:
        usable &= np.isfinite(part).all(axis=tuple(range(1, part.ndim)))
    rows = np.flatnonzero(usable)
    number = np.cumsum(np.diff(stream.swing.astype(int), prepend=0) == 1)
    return FreeRows(pick(cut, rows), number[cut.tick[rows]])


def pick(windows: Rows, which: NDArray[Any]) -> Rows:
    """Some of the windows, by indices or a mask."""
    return Rows(*(part[which] for part in windows))


def thetas(library: Library, windows: Rows) -> Iterator[tuple[slice, Array]]:
    """Θ of some rows at a time, and which, so that it never stands whole in memory."""
    for start in range(0, len(windows.tick), BLOCK):
        part = slice(start, start + BLOCK)
        yield part, library.evaluate(*(values[part] for values in windows[:3]))


def blockwise(library: Library, windows: Rows, coefficients: Array) -> Array:
    """(n, q) movements that (p, q) coefficients predict for n windows."""
    out = np.empty((len(windows.tick), coefficients.shape[1]))
    for part, theta in thetas(library, windows):
        out[part] = theta @ coefficients
    return out


def predictions(model: LegModel | None, measured: Array, desired: Array) -> Array:
    """(n, J) rad, the positions predicted one tick before; NaN where nothing predicts them.

    That is without a model, and where the window was not full.
    """
    out = np.full_like(measured, np.nan)
    if model is not None:
        cut = stack(measured, desired, model.library.window)
        moved = blockwise(model.library, cut, model.coefficients)
        out[cut.tick + 1] = cut.measured[:, 0] + moved
    return out


def factor_of(library: Library, windows: Rows, target: Array) -> Factor:
    """The compressed regression of windows on a target, (n, q)."""
    factor = Factor(library.size, target.shape[1])
    for part, theta in thetas(library, windows):
        factor.add(theta, target[part])
    return factor


def residual_unit(least_squares: Fit) -> tuple[float, ...]:
    """(J,) the least-squares residual that λ is measured in, where there is one."""
    # What a joint that never moves leaves as its residual, rad.
    return tuple(np.maximum(least_squares.rms, 1e-9).tolist())


def noise_floor() -> float:
    r"""Standard deviation of a reading about the true angle, rad.

    Noise of :math:`\sigma` steps before rounding, and rounding itself, uniform over a step:
    :math:`q\sqrt{\sigma^2 + 1/12}`.  What is to be predicted is a reading, so that no model's
    residual is smaller.
    """
    return QUANTUM_RAD * math.sqrt(EncoderSettings().noise_steps ** 2 + 1.0 / 12.0)


def rms_deg(residual: Array) -> list[float]:
    """Root mean square of every column, degrees; NaN without rows."""
    if not len(residual):
        return [float("nan")] * residual.shape[1]
    return [float(v) for v in np.degrees(np.sqrt(np.square(residual).mean(axis=0)))]


def over_floor(residual: Array) -> list[float]:
    """:func:`rms_deg` over the noise floor."""
    floor = float(np.degrees(noise_floor()))
    return [v / floor for v in rms_deg(residual)]
