"""Regression rows of simulated streams, and the floor that no prediction gets below."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.fit import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import Factor, Library, Rows, Window, stack
from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.servo import QUANTUM_RAD
from adaptive_contact_studies.paper.data import Stream

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# N, N', M of the paper's model; the paper does not print its own (see the window study).
PAPER_WINDOW: Final = Window(past_measured=2, past_desired=2, preview=1)
# Rows whose regressors are held at once: 295 doubles each, some tens of megabytes.
BLOCK: Final = 20_000
# What a joint that never moves leaves as its residual, rad.
_LEAST: Final = 1e-9
# Fits that end so leave nothing but zeros: an error of theirs would be that of no prediction.
NO_MODEL: Final = frozenset({FitStatus.TOO_FEW_ROWS, FitStatus.NOT_FINITE})
_SEVERITY: Final = (
    FitStatus.OK,
    FitStatus.EMPTIED,
    FitStatus.NOT_FINITE,
    FitStatus.TOO_FEW_ROWS,
)


class FreeRows(NamedTuple):
    """Windows of free swing ticks.

    Attributes:
        windows: (n, ...) the windows with what came next.
        swing: (n,) number of the swing each lies in, for folds.
    """

    windows: Rows
    swing: Ints


def free_rows(stream: Stream, library: Library) -> FreeRows:
    """Windows whose tick and successor are free swing ticks, of finite values throughout.

    Args:
        stream: one leg's.
        library: whose window is cut.
    """
    cut = stack(stream.measured, stream.desired, library.window)
    use = stream.swing & stream.stretch.free
    rows = np.flatnonzero(use[cut.tick] & use[cut.tick + 1] & _finite(cut))
    number = np.cumsum(np.diff(stream.swing.astype(int), prepend=0) == 1)
    return FreeRows(pick(cut, rows), number[cut.tick[rows]])


def _finite(windows: Rows) -> NDArray[np.bool_]:
    """Mask of windows without a value that is not finite."""
    parts = (windows.measured, windows.desired, windows.preview, windows.increment)
    finite = np.ones(len(windows.tick), dtype=np.bool_)
    for part in parts:
        finite &= np.isfinite(part).all(axis=tuple(range(1, part.ndim)))
    return finite


def pick(windows: Rows, which: NDArray[Any]) -> Rows:
    """Some of the windows, by indices or a mask."""
    return Rows(
        windows.measured[which],
        windows.desired[which],
        windows.preview[which],
        windows.increment[which],
        windows.tick[which],
    )


def blockwise(library: Library, windows: Rows, coefficients: Array) -> Array:
    """Predict movements block by block, so that Θ never stands whole in memory.

    Args:
        library: the terms.
        windows: n of them.
        coefficients: (p, q).

    Returns:
        (n, q).
    """
    out = np.empty((len(windows.tick), coefficients.shape[1]))
    for start in range(0, len(out), BLOCK):
        part = slice(start, start + BLOCK)
        theta = library.evaluate(
            windows.measured[part], windows.desired[part], windows.preview[part]
        )
        out[part] = theta @ coefficients
    return out


def factor_of(library: Library, windows: Rows, target: Array) -> Factor:
    """The compressed regression of windows on a target, (n, q)."""
    factor = Factor(library.size, target.shape[1])
    for start in range(0, len(target), BLOCK):
        part = slice(start, start + BLOCK)
        theta = library.evaluate(
            windows.measured[part], windows.desired[part], windows.preview[part]
        )
        factor.add(theta, target[part])
    return factor


def worst(statuses: Iterable[FitStatus]) -> FitStatus:
    """The status of several fits that make one figure: that of the worst; ok without any."""
    return max(statuses, key=_SEVERITY.index, default=FitStatus.OK)


def residual_unit(factor: Factor) -> tuple[float, ...]:
    """(J,) the least-squares residual that λ is measured in, where there is one."""
    return tuple(np.maximum(fit_sparse(factor, FitSettings()).rms, _LEAST).tolist())


def noise_floor(encoder: EncoderSettings | None = None) -> float:
    r"""Standard deviation of a reading about the true angle, rad.

    Noise of :math:`\sigma` steps before rounding, and rounding itself, uniform over a step:
    :math:`q\sqrt{\sigma^2 + 1/12}`.  What is to be predicted is a reading, so that no model's
    residual is smaller.
    """
    settings = encoder or EncoderSettings()
    return QUANTUM_RAD * math.sqrt(settings.noise_steps**2 + 1.0 / 12.0)


def rms_deg(residual: Array) -> list[float]:
    """Root mean square of every column, degrees; NaN without rows."""
    if not len(residual):
        return [float("nan")] * residual.shape[1]
    return [float(v) for v in np.degrees(np.sqrt(np.square(residual).mean(axis=0)))]
