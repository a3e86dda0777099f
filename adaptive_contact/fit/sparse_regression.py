"""Fits sparse linear models to a compressed factor.

The fit is PySINDy's STLSQ (Brunton et al. 2016; de Silva et al. 2020).
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import warnings
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from adaptive_contact.arrays import Array, Mask, scipy
from adaptive_contact.model.factor import Factor

if TYPE_CHECKING:
    from pysindy.optimizers import STLSQ

# Singular values below this share of the largest count as zero in the unbiased refit; the value of
# scikit-learn's LinearRegression, which PySINDy's own refit uses.
RANK_CUTOFF: Final = 1e-6


class FitStatus(enum.StrEnum):
    """Says how a fit ended; all but ``ok`` and ``emptied`` leave the coefficients zero."""

    OK = "ok"
    EMPTIED = "emptied"  # the threshold removed every term of at least one joint
    TOO_FEW_ROWS = "too_few_rows"
    NOT_FINITE = "not_finite"
    # Never finished.  A status is shown to people as it is; this one is never computed with.
    LOST = "lost: the process that fits died or took too long"


@dataclasses.dataclass(frozen=True)
class Prior:
    """Holds what is known of the coefficients before the data, a Gaussian for each joint."""

    mean: Array  # (p, J)
    # (J, q, p) rows that stand for it among those of the data: their outer products sum to the
    # precision, in units of a row's
    rows: Array
    used: Mask  # (p, J) terms that a joint may have


@dataclasses.dataclass(frozen=True)
class FitSettings:
    """Holds the settings of one sparse fit."""

    # λ of STLSQ, on coefficients in units of `unit` per column root mean square: a term stays if
    # it moves the prediction by more than λ units
    threshold: float = 0.0
    ridge: float = 1e-9  # ridge term per row, in the same scaled units
    # (J,) what a prediction is measured in, rad; the noise floor makes λ dimensionless
    unit: tuple[float, ...] | None = None
    iterations: int = 20  # STLSQ's limit
    # what is known of the coefficients; they are fitted from nothing without
    prior: Prior | None = None


@dataclasses.dataclass(frozen=True)
class Fit:
    """Holds the result of a fit."""

    status: FitStatus  # how it ended
    coefficients: Array  # (p, J), raw units
    support: Mask  # (p, J) bool
    rms: Array  # (J,) on the rows it was fitted to
    rows: float  # raw rows behind it

    def usable(self, still: Mask) -> bool:
        """Return whether it predicts every joint that moves.

        Args:
            still: (J,) which stand; not all can.
        """
        if self.status is not FitStatus.EMPTIED:
            return self.status is FitStatus.OK
        moved = self.support.any(axis=0)
        return bool(moved.any() and (moved | still).all())


def fit_sparse(factor: Factor, settings: FitSettings) -> Fit:
    """Fit a sparse linear model to all rows a factor holds, with PySINDy's STLSQ.

    Columns are scaled to unit root mean square and rows to unit weight, so that neither λ nor
    the ridge term depends on units or on the number of rows.

    Returns:
        The model with its status; never raises for bad data.
    """
    p, joints = factor.terms, factor.outputs
    empty = np.zeros((p, joints))

    def failed(status: FitStatus) -> Fit:
        nothing = np.zeros((p, joints), dtype=bool)
        return Fit(status, empty, nothing, factor.rms(empty), factor.rows)

    if factor.rows < p:
        return failed(FitStatus.TOO_FEW_ROWS)
    r, qty = factor.system
    if not (np.isfinite(r).all() and np.isfinite(qty).all()):
        return failed(FitStatus.NOT_FINITE)
    scale = factor.scale()
    unit = np.ones(joints) if settings.unit is None else np.asarray(settings.unit)
    root = np.sqrt(factor.rows)
    if settings.prior is None:
        scaled = _stlsq(r / scale / root, qty / unit / root, settings)
        systems = [(r, qty[:, joint]) for joint in range(joints)]
    else:  # of every joint its own, as what is known of it is
        systems = [_with_prior(r, qty, settings.prior, joint) for joint in range(joints)]
        scaled = np.concatenate(
            [
                _stlsq(theta / scale / root, target[:, None] / unit[joint] / root, settings)
                for joint, (theta, target) in enumerate(systems)
            ],
            axis=1,
        )
    support = scaled != 0.0
    if settings.prior is not None:  # a column of zeros has a coefficient of rounding errors
        support &= settings.prior.used
    coefficients = np.zeros((p, joints))
    for joint, (theta, target) in enumerate(systems):
        kept = support[:, joint]
        if kept.any():
            # The unbiased refit, by a rank-revealing solver: a constant or repeated column gets
            # the minimum-norm answer instead of noise.
            solution = scipy.linalg.lstsq(
                theta[:, kept] / scale[kept], target, cond=RANK_CUTOFF, check_finite=False
            )[0]
            coefficients[kept, joint] = solution / scale[kept]
    status = FitStatus.OK if support.any(axis=0).all() else FitStatus.EMPTIED
    return Fit(status, coefficients, support, factor.rms(coefficients), factor.rows)


def _with_prior(r: Array, qty: Array, prior: Prior, joint: int) -> tuple[Array, Array]:
    """Rows of one joint, with those that its prior stands for below them."""
    rows = prior.rows[joint]
    theta = np.concatenate([r, rows]) * prior.used[:, joint]
    return theta, np.concatenate([qty[:, joint], rows @ prior.mean[:, joint]])


def _stlsq(theta: Array, target: Array, settings: FitSettings) -> Array:
    """(p, J) thresholded coefficients in scaled units."""
    from sklearn import config_context

    optimizer = _stlsq_class()(
        threshold=settings.threshold,
        alpha=settings.ridge,
        max_iter=settings.iterations,
        unbias=False,
        # Of it only which terms are not zero is ever looked at; without one, a whole least-squares
        # problem is solved for it.
        initial_guess=np.ones((target.shape[1], theta.shape[1])),
    )
    # The factor took in finite rows only; checking them again is a good part of a small fit.
    unchecked = config_context(assume_finite=True, skip_parameter_validation=True)
    with unchecked, warnings.catch_warnings():
        # Both are read off the result instead: an emptied joint from the support, and a fit
        # that still lost terms in its last round is as good as its held-out error says.
        warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
        warnings.filterwarnings("ignore", message=".*did not converge")
        optimizer.fit(theta, target)
    return np.asarray(optimizer.coef_, dtype=np.float64).T


@functools.cache
def _stlsq_class() -> type[STLSQ]:
    """PySINDy's, with its ridge regressions handed to LAPACK without sklearn's checks between.

    A round's system has 62 unknowns at most, and its checks took three times as long as its
    solution; the numbers are the same.
    """
    from pysindy.optimizers import STLSQ  # 1.6 s to import: only where a fit is made

    class QuickSTLSQ(STLSQ):
        def _regress(self, x: Array, y: Array, dim: int, sparse_sub: Any) -> Array:
            gram = x.T @ x
            gram.flat[:: len(gram) + 1] += self.alpha
            _, solution, info = scipy.linalg.lapack.dposv(gram, x.T @ y, overwrite_a=1)
            if info != 0:  # not positive definite to rounding: sklearn knows what to do then
                return np.asarray(super()._regress(x, y, dim, sparse_sub))
            self.iters += 1
            return np.asarray(solution)

    return QuickSTLSQ
