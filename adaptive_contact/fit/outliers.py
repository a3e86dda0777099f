"""Finds rows to leave out of a fit: wild readings, and ticks that may have touched.

Where it is not known when a leg touched, a tenth of the ticks may be of touches, and sixty terms
fitted to four hundred ticks explain them away: residuals of ten deviations shrink to two or three,
and no bound on the fit's own residuals finds them.  Least trimmed squares (Rousseeuw 1984, by the
concentration steps of Rousseeuw and Van Driessen 1999) fits the ticks that go together best; the
others are let in again as far as that model explains them.  And a foot that touches goes on
touching: what stands out in the first half of a swing takes the ticks before it along, as the
swing began in touch; in the second half, those after it.

That also cuts the tail off what is no touch, and a threshold is read from the tail.  So where there
are ticks enough for one, the swings are asked first whether there is anything to leave out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.fit.prior import fit_prior
from adaptive_contact.fit.sparse_regression import FitSettings, fit_sparse
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.leg_prior import in_family
from adaptive_contact.model.library import Library

# Share that the first fits are made of: three times the touches that a tenth would be may be among
# the rest.
CORE_SHARE: Final = 0.75
STEPS: Final = 30  # of concentration
# Ticks beside one that stands out, in which a touch begins or ends.
GUARD_TICKS: Final = 1
# Rows that a class of speed needs for a noise of its own.
SPEED_ROWS: Final = 80
# Standard deviation of a normal variable over the median of its size.
MAD_DEVIATION: Final = 1.4826
# A joint that stands still reads the same again and again, and the ticks that go together best may
# be of nothing else.  When it moves, its readings are rounded, which makes a movement uncertain by
# so many position steps: standard deviation, and median of the size.
DEVIATION_STEPS: Final = 6**-0.5
MEDIAN_STEPS: Final = 1.0 - 2**-0.5


def inliers(
    library: Library, theta: Array, target: Array, position: Ints, quantum_rad: float
) -> Mask:
    """Find the rows that a fit can explain; twice, as the first fit still carries the others.

    It is fitted as a leg is: by least squares alone a few wild rows are explained by coefficients
    that no leg has.

    Args:
        library: the terms to choose from.
        theta: (n, p) regressors.
        target: (n, J) rad, movements.
        position: (n,) tick of each.
        quantum_rad: position step of the servos.
    """
    keep: Mask = np.asarray(np.isfinite(theta).all(axis=1) & np.isfinite(target).all(axis=1))
    for _ in range(2):
        factor = Factor(theta.shape[1], target.shape[1])
        factor.add(theta[keep], target[keep])
        prior = fit_prior(factor, library, quantum_rad, 1.0) if in_family(library) else None
        fit = fit_sparse(factor, FitSettings(prior=prior))
        residual = target - theta @ fit.coefficients
        # Median absolute deviation: the outliers must not set the scale they are judged by.
        sigma = MAD_DEVIATION * np.median(np.abs(residual[keep]), axis=0)
        # Rows further out than this many standard deviations, in whitened distance, are no noise: a
        # touch in a recording assumed free, or a bad reading.  Free ticks reach 6 in 10^6.
        near = np.abs(residual) < 10.0 * np.maximum(sigma, DEVIATION_STEPS * quantum_rad)
        keep = np.asarray(keep & near.all(axis=1))
    # A wild reading is in the windows of the next ticks, too.
    spoilt = position[~keep, None] + np.arange(1, library.window.length + 1)
    return np.asarray(keep & ~np.isin(position, spoilt))


class Untouched(NamedTuple):
    """Holds which rows to learn from, where it is not known whether the leg touched."""

    keep: Mask  # (n,) False for what is left out
    touched: int  # swings in which something is no noise


def untouched(
    theta: Array, target: Array, position: Ints, quantum_rad: float, *, tail: bool
) -> Untouched:
    """Find the rows that one linear model explains, swing by swing.

    Args:
        theta: (n, p) regressors, finite.
        target: (n, J) rad, movements, finite.
        position: (n,) tick of each, with gaps of at least 3 between swings.
        quantum_rad: position step of the servos.
        tail: a threshold is to be read from the noise, which keeps its tail if hardly anything
            touched.

    Returns:
        What stands out is left out, and what must have touched with it.
    """
    if len(theta) < theta.shape[1]:
        return Untouched(np.ones(len(theta), dtype=bool), 0)
    return _Swings(theta, target, position, quantum_rad).untouched(tail=tail)


class _Swings:
    """Their ticks, scaled and sorted by speed once for all the fits."""

    def __init__(self, theta: Array, target: Array, position: Ints, quantum_rad: float) -> None:
        size = np.sqrt(np.square(theta).mean(axis=0))
        self._rows: Array = theta / np.where(size > 0.0, size, 1.0)  # in units of the typical size
        self._target = target
        self._quantum = quantum_rad
        self._speeds = _Speeds(target, quantum_rad)
        # (n,) number of each row's swing, from 0.
        self._swing = np.cumsum(np.diff(position, prepend=position[:1]) > 2, dtype=np.int64)

    def untouched(self, *, tail: bool) -> Untouched:
        keep = self._explained()
        # No free tick goes this far out from the model of the others; one touch in ten stays within
        # it.
        near: Mask = np.asarray((self._deviations(keep) < 6.0).all(axis=1))
        touched = len(np.unique(self._swing[~near]))
        # Where the foot touched in more than this share of the swings, the light touches that stay
        # within it are many enough to set the tail.
        if tail and touched <= 0.01 * (int(self._swing[-1]) + 1):
            keep = _with_their_touch(near, self._swing)
        return Untouched(keep, touched)

    def _explained(self) -> Mask:
        keep = self._core()
        # The deviation of three normal joints, over that of the three quarters of their ticks that
        # lie nearest: (0.75 / P(χ²₅ < 4.1))^½, rounded.
        widen = 1.25
        # Rounds of letting in.
        for _ in range(8):
            # In any joint; free ticks go further out once in 700.
            fits: Mask = np.asarray((self._deviations(keep) < 3.5 * widen).all(axis=1))
            let_in = _with_their_touch(fits, self._swing)
            widen = 1.0
            if _settled(keep, let_in):
                return let_in
            keep = let_in
        return keep

    def _core(self) -> Mask:
        """The ticks that go together best."""
        n = len(self._rows)
        share = int(CORE_SHARE * n)
        keep = np.ones(n, dtype=bool)
        for _ in range(STEPS):
            residual, _ = self._fit(keep)
            scale = np.maximum(self._speeds.noise(residual, _median), MEDIAN_STEPS * self._quantum)
            distance = np.square(residual / scale).sum(axis=1)
            best = np.zeros(n, dtype=bool)
            best[np.argpartition(distance, share)[:share]] = True
            if _settled(keep, best):
                return best
            keep = best
        return keep

    def _deviations(self, keep: Mask) -> Array:
        """(n, J) residuals over what they should be, by a fit to some rows.

        Those of the rows fitted to are smaller than the noise, those of the others larger, both by
        their leverage.
        """
        residual, normal = self._fit(keep)
        count = int(keep.sum())
        # The ridge leaves about half of the terms free.
        freedom = max(count - 0.5 * self._rows.shape[1], 0.5 * count, 1.0)

        def deviation(rank: Ints, off: Array) -> float:
            kept = keep[rank]
            if 2 * np.count_nonzero(kept) > len(rank):
                return math.sqrt(float(np.square(off[kept]).mean()) * count / freedom)
            return MAD_DEVIATION * _median(rank, off)  # too few of such are among those fitted to

        noise = np.maximum(self._speeds.noise(residual, deviation), DEVIATION_STEPS * self._quantum)
        whitened = np.linalg.solve(np.linalg.cholesky(normal), self._rows.T)
        leverage = np.square(whitened).sum(axis=0)
        expected = np.where(keep, np.maximum(1.0 - leverage, 0.2), 1.0 + leverage)
        return np.asarray(np.abs(residual) / noise / np.sqrt(expected)[:, None])

    def _fit(self, keep: Mask) -> tuple[Array, Array]:
        """(n, J) residuals of all by a fit to some, and the normal matrix of those."""
        rows, target = self._rows[keep], self._target[keep]
        normal: Array = rows.T @ rows
        # A term is held at zero by so many rows of its typical size.
        normal[np.diag_indices_from(normal)] += 5.0
        return self._target - self._rows @ np.linalg.solve(normal, rows.T @ target), normal


class _Speeds:
    """Rows in classes of speed: of each joint, and of the leg's fastest.

    A model errs more where a joint is fast, and where another is that pulls at it: each class is
    twice as fast as the next, and has rows enough for a noise of its own.  But none errs more where
    it is slower: what stands out there was stopped.  And it is the speed that was measured: by what
    is predicted, a leg on the ground, whose servos pull ever harder, were a class of its own.
    """

    def __init__(self, target: Array, quantum_rad: float) -> None:
        speed = np.abs(target)
        self._of_leg = _classes(speed.max(axis=1), quantum_rad)
        self._of_joint = [_classes(own, quantum_rad) for own in speed.T]

    def noise(self, residual: Array, size: Callable[[Ints, Array], float]) -> Array:
        """(n, J) noise of ticks as fast, the larger of the two.

        Args:
            residual: (n, J) rad.
            size: of some rows, and one joint's residuals there.
        """
        noise = np.empty_like(residual)
        for joint, own in enumerate(self._of_joint):
            off = residual[:, joint]
            both = [_no_less_where_fast(ranks, off, size) for ranks in (own, self._of_leg)]
            noise[:, joint] = np.maximum(*both)
        return noise


def _no_less_where_fast(
    ranks: list[Ints], off: Array, size: Callable[[Ints, Array], float]
) -> Array:
    noise = np.empty_like(off)
    least = math.inf
    for rank in ranks:
        least = min(least, size(rank, off[rank]))
        noise[rank] = least
    return noise


def _median(_: Ints, off: Array) -> float:
    return float(np.median(np.abs(off)))


def _classes(speed: Array, quantum_rad: float) -> list[Ints]:
    """Places of the rows by speed, the fastest first."""
    order = np.argsort(-speed, kind="stable")
    steps = np.log2(np.maximum(speed[order] / quantum_rad, 1.0)).astype(np.int64)
    edges = [0]
    for edge in (np.flatnonzero(np.diff(steps)) + 1).tolist():
        if edge - edges[-1] >= SPEED_ROWS:
            edges.append(edge)
    if len(order) - edges[-1] < SPEED_ROWS and len(edges) > 1:
        edges.pop()
    return np.split(order, edges[1:])


def _with_their_touch(fits: Mask, swing: Ints) -> Mask:
    """Take out, with each row that stands out, those that touched before or after it."""
    keep = np.ones(len(fits), dtype=bool)
    edges = np.flatnonzero(np.diff(swing)) + 1
    for begin, end in zip([0, *edges.tolist()], [*edges.tolist(), len(fits)], strict=True):
        out = np.flatnonzero(~fits[begin:end])
        half = (end - begin) / 2
        early, late = out[out < half], out[out >= half]
        if len(early):
            keep[begin : begin + int(early[-1]) + 1 + GUARD_TICKS] = False
        if len(late):
            keep[begin + max(0, int(late[0]) - GUARD_TICKS) : end] = False
    return keep


def _settled(before: Mask, after: Mask) -> bool:
    # So few changed sides in the last step.
    return int(np.count_nonzero(before != after)) <= 1e-3 * len(before)
