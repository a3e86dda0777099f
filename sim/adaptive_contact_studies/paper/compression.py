r"""The paper's fit as PySINDy makes it, from the compressed factor.

``DiscreteSINDy`` with ``STLSQ`` sees the rows :math:`(\Theta, X_{next})`; here it sees the triangle
of their QR factorisation.  Column norms, ridge solutions, thresholds and the unbiased refit depend
on the rows through :math:`\Theta^\top\Theta` and :math:`\Theta^\top X_{next}` only, so that
supports are the same and coefficients differ by rounding.  (PySINDy's unbiased refit drops
directions whose singular value is below :math:`10^{-6}` of the largest; the triangle has the same
singular values.)

``raw`` thresholds coefficients in the units of the data, ``normalised`` those of columns with unit
Euclidean norm, which PySINDy offers as ``normalize_columns``: λ then grows with the square root of
the number of rows.

The compressed fit against PySINDy's own on the raw rows: equality and speed.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.fit import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import Factor, Library, LibraryName, Window, leg_library
from adaptive_contact.robot import shipped_robot
from adaptive_contact_studies.paper.data import Stream, streams_of
from adaptive_contact_studies.paper.plan import PAPER_LEG, Plan
from adaptive_contact_studies.paper.rows import PAPER_WINDOW, free_rows, residual_unit
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

# PySINDy's default ridge term, which the paper does not mention changing.
RIDGE: Final = 0.05


class PaperFit(NamedTuple):
    """A fit as the paper makes it."""

    status: FitStatus  # `ok`, or `emptied` where some state has no terms left
    coefficients: Array  # (p, states)


def paper_fit(factor: Factor, threshold: float, *, normalised: bool = False) -> PaperFit:
    """Fit finite rows with PySINDy's STLSQ, unscaled targets."""
    coefficients = _stlsq(
        *factor.system, threshold=threshold, alpha=RIDGE, normalize_columns=normalised
    )
    kept = (coefficients != 0.0).any(axis=0).all()
    return PaperFit(FitStatus.OK if kept else FitStatus.EMPTIED, coefficients)


def _stlsq(rows: Array, target: Array, **settings: Any) -> Array:
    """(p, states) coefficients of PySINDy's STLSQ."""
    from pysindy.optimizers import STLSQ

    optimizer = STLSQ(**settings)
    with warnings.catch_warnings():
        # Read off the result instead: an emptied state from the support.
        warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
        warnings.filterwarnings("ignore", message=".*did not converge")
        optimizer.fit(rows, target)
    return np.asarray(optimizer.coef_, dtype=np.float64).T


_COMPARED: Final[tuple[tuple[LibraryName, Window, float], ...]] = (
    ("servo", Window(), 0.05),
    ("servo", Window(), 0.3),
    ("paper", PAPER_WINDOW, 0.1),
    ("paper", PAPER_WINDOW, 10.0),
)


def compare(streams: Sequence[Stream], library: Library, threshold: float) -> dict[str, Any]:
    """Time both fits of the free rows of some streams, of one library and one λ."""
    windows = free_rows(streams, library).windows
    theta, library_s = _timed(
        lambda: library.evaluate(windows.measured, windows.desired, windows.preview)
    )
    target = windows.increment

    def build() -> Factor:
        factor = Factor(library.size, target.shape[1])
        factor.add(theta, target)
        return factor

    factor, factor_s = _timed(build)
    unit: Array = np.array(residual_unit(fit_sparse(factor, FitSettings())))
    settings = FitSettings(threshold=threshold, unit=tuple(unit.tolist()))
    fit, compressed_s = _timed(lambda: fit_sparse(factor, settings))
    scale = factor.scale()
    scaled, wanted = theta / scale, target / unit

    def raw() -> Array:
        # The same problem in PySINDy's words: its ridge term is per problem, ours per row.
        ridge = settings.ridge * len(theta)
        found = _stlsq(scaled, wanted, threshold=threshold, alpha=ridge) / scale[:, None]
        return np.asarray(found * unit)

    coefficients, raw_s = _timed(raw)
    return {
        "library": library.name,
        "terms": library.size,
        "rows": len(theta),
        "threshold": threshold,
        "kept": [int(n) for n in fit.support.sum(axis=0)],  # (J,) terms left to each joint
        "raw_s": raw_s,  # PySINDy's STLSQ on the raw rows, Θ given
        "compressed_s": compressed_s,  # the same fit with the factor held
        "factor_s": factor_s,  # building the factor from Θ
        "library_s": library_s,  # evaluating Θ, which both need
        "speed_up": raw_s / compressed_s,
        "same_support": bool(((coefficients != 0) == fit.support).all()),
        # largest of a coefficient, raw units
        "difference": float(np.abs(coefficients - fit.coefficients).max()),
    }


@rests_on(*SIMULATOR, *LEARNER, "adaptive_contact_studies.paper.rows")
def compare_all(work: Work, plan: Plan) -> list[dict[str, Any]]:
    """Both libraries, at a λ that keeps nearly every term and one that leaves the sparse model."""
    streams, robot = streams_of(work, plan.paper_runs("train")), shipped_robot()
    return [
        compare(streams, leg_library(robot, robot.leg(PAPER_LEG), name, window), threshold)
        for name, window, threshold in _COMPARED
    ]


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Do work three times; its result, and the CPU time of the best."""
    best = float("inf")
    for _ in range(3):
        start = time.process_time()
        result = work()
        best = min(best, time.process_time() - start)
    return result, best
