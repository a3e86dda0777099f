"""The compressed fit against PySINDy's own on the raw rows: equality and speed."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.identify import Factor, FitSettings, Library, fit_sparse
from adaptive_contact_sim.experiments.data import Stream
from adaptive_contact_sim.experiments.rows import free_rows

__all__ = ["Comparison", "compare"]

Array = NDArray[np.float64]
R = TypeVar("R")


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One library, one λ.

    Attributes:
        library, terms, rows, threshold: what was fitted.
        raw_s: PySINDy's STLSQ on the raw rows, Θ given.
        compressed_s: the same fit with the factor held.
        factor_s: building the factor from Θ.
        library_s: evaluating Θ, which both need.
        speed_up: ``raw_s`` over ``compressed_s``.
        same_support: whether both keep the same terms.
        difference: largest difference of a coefficient, raw units.
    """

    library: str
    terms: int
    rows: int
    threshold: float
    raw_s: float
    compressed_s: float
    factor_s: float
    library_s: float
    speed_up: float
    same_support: bool
    difference: float


def compare(stream: Stream, library: Library, threshold: float, *, repeats: int = 3) -> Comparison:
    """Time both fits of the free rows of a stream; the better of ``repeats``, CPU time.

    Args:
        stream: the paper's training segments.
        library: the terms.
        threshold: λ, in units of the residual.
        repeats: of each.
    """
    from pysindy.optimizers import STLSQ

    windows = free_rows(stream, library).windows
    theta, library_s = _timed(
        lambda: library.evaluate(windows.measured, windows.desired, windows.preview), 1
    )
    target = windows.increment

    def build() -> Factor:
        factor = Factor(library.size, target.shape[1])
        factor.add(theta, target)
        return factor

    factor, factor_s = _timed(build, repeats)
    unit = fit_sparse(factor, FitSettings()).rms
    settings = FitSettings(threshold=threshold, unit=tuple(unit.tolist()))
    fit, compressed_s = _timed(lambda: fit_sparse(factor, settings), repeats)
    scale = factor.scale()
    scaled, wanted = theta / scale, target / unit

    def raw() -> Array:
        # The same problem in PySINDy's words: its ridge term is per problem, ours per row.
        optimizer = STLSQ(threshold=threshold, alpha=settings.ridge * len(theta))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
            warnings.filterwarnings("ignore", message=".*did not converge")
            optimizer.fit(scaled, wanted)
        return np.asarray(optimizer.coef_, dtype=np.float64).T / scale[:, None] * unit

    coefficients, raw_s = _timed(raw, 1)
    return Comparison(
        library=library.name,
        terms=library.size,
        rows=len(theta),
        threshold=threshold,
        raw_s=raw_s,
        compressed_s=compressed_s,
        factor_s=factor_s,
        library_s=library_s,
        speed_up=raw_s / compressed_s,
        same_support=bool(((coefficients != 0) == fit.support).all()),
        difference=float(np.abs(coefficients - fit.coefficients).max()),
    )


def _timed(work: Callable[[], R], repeats: int) -> tuple[R, float]:
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        best = min(best, time.process_time() - start)
    return result, best
