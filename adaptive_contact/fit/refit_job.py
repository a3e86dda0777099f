r"""Finds the structure of a leg's servos from its free rows: a job that any process can run.

The control law saturates at an error of the slope *s*, which is no coefficient: terms of another
slope are other terms.  For each slope of a grid the family of legs
(:mod:`~adaptive_contact.model.leg_prior`) says what coefficients to expect, and so how probable the
rows are.  Of a joint, with the prior's residual :math:`r = y - \Theta\mu`, its spread *S* and
:math:`A = \Theta S^\top / \sigma`,

.. math:: \ln p = -\tfrac12 \big(\lVert r/\sigma \rVert^2 - b^\top M^{-1} b\big)
          - \tfrac12 \ln\lvert M \rvert, \qquad M = I + A^\top A, \quad b = A^\top r / \sigma .

That is the sum over the rows of what each was worth when it was predicted from those before it: no
row is judged by a fit to itself.  The model of the likeliest slope is sparse: STLSQ, with the
family for its prior.

A leg that began with the family has its noise from there, too.  Play and friction make that of some
legs ten times as large.  Where the rows exceed it, the leg goes on with its own.

The work is a pure function, so that it can run in another process and be repeated exactly in a
replay.  Who runs it is a :class:`Refitter`; without one, the learner does it in line at the tick
where the result falls due.
"""

from __future__ import annotations

import dataclasses
from typing import Final, Protocol

import numpy as np

from adaptive_contact.arrays import Array, scipy
from adaptive_contact.fit.prior import fit_prior
from adaptive_contact.fit.sparse_regression import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.leg_prior import in_family, leg_prior, prior_noise
from adaptive_contact.model.library import Library
from adaptive_contact.model.model_file import LegBaseline

# Slopes that are tried, over the present one; the next refit goes on from the one that was found.
SLOPES: Final = (0.25, 0.4, 0.63, 1.0, 1.6, 2.5, 4.0)
SLOPE_RANGE: Final = (0.035, 0.8)  # rad; half and twice of what the family was made of
# By so much the rows have to be likelier (the logarithm).  Where the slope is right no other gains;
# where none is, neighbours differ by up to 38; off by 4 it is 30 to 600 (decision 55).
LEAST_GAIN: Final = 40.0
# Where the residuals' mean square exceeds that of the prior so many times, the prior's noise is not
# the leg's: at the same level its lifts would not settle.
PRIOR_EXCEEDED: Final = 2.5
# λ, in units of the noise: a baseline's fit chooses 0.05 to 0.3.
THRESHOLD: Final = 0.1


@dataclasses.dataclass(frozen=True)
class RefitJob:
    """Holds what a refit needs."""

    # leg, number: name it
    leg: str
    number: int
    values: Array  # (n, p + J) regressors and movements of free rows, in order
    library: Library  # of the first q of p terms
    quantum_rad: float  # position step
    # (J,) rad, residuals that the prior expects; None for a leg that began with a baseline
    prior_rms: Array | None = None

    def run(self) -> RefitResult:
        """Find the slope, and fit a model of it."""
        return refit(self)


@dataclasses.dataclass(frozen=True)
class RefitResult:
    """Holds the result of a refit."""

    number: int
    status: FitStatus = FitStatus.OK  # how it ended
    slope_rad: float = 0.0  # the likeliest
    gain: float = 0.0  # logarithm of how much likelier the rows are than by the present slope
    level: float = 1.0  # mean square of the residuals over the prior's
    start: LegBaseline | None = None  # what to go on from; None where the present model may stay


class Job(Protocol):
    """Describes work on numbers alone, for any process: a refit, or a search for signs or ids."""

    @property
    def leg(self) -> str:
        """Id of the leg."""

    @property
    def number(self) -> int:
        """Number of the job among that leg's."""

    def run(self) -> object:
        """Run the job."""


class Refitter(Protocol):
    """Runs jobs."""

    def submit(self, job: Job) -> None:
        """Take a job; never blocks."""

    def collect(self, leg: str, number: int) -> object | None:
        """Return the result, or None while there is none; never blocks."""


class InlineRefitter:
    """Runs a job when its result is asked for; one of each leg waits, the newest."""

    def __init__(self) -> None:
        self._jobs: dict[str, Job] = {}

    def submit(self, job: Job) -> None:
        """Keep the job."""
        self._jobs[job.leg] = job

    def collect(self, leg: str, number: int) -> object | None:
        """Run the job."""
        job = self._jobs.get(leg)
        if job is None or job.number != number:
            return None
        del self._jobs[leg]
        return job.run()


def refit(job: RefitJob) -> RefitResult:
    """Find the slope, and fit a model of it."""
    joints = len(job.library.joints)
    theta, target = job.values[:, :-joints], job.values[:, -joints:]
    if not np.isfinite(job.values).all():
        return RefitResult(job.number, FitStatus.NOT_FINITE)
    if not in_family(job.library):
        return RefitResult(job.number)
    window = job.library.window_of(theta[:, : job.library.size])
    present = job.library.slope_rad
    slopes = [present * f for f in SLOPES]
    slopes = [s for s in slopes if s == present or SLOPE_RANGE[0] <= s <= SLOPE_RANGE[1]]
    tried = {slope: _Posterior(job, slope, window, target) for slope in slopes}
    # One noise for all, or a slope would win by what it says of the noise.
    least: Array = np.stack([posterior.rms for posterior in tried.values()]).min(axis=0)
    sigma: Array = np.maximum(least, job.quantum_rad / 12**0.5)
    evidence = {slope: posterior.evidence(sigma) for slope, posterior in tried.items()}
    best = max(evidence, key=lambda slope: evidence[slope])
    gain = evidence[best] - evidence[present]
    level = 1.0 if job.prior_rms is None else float(np.square(sigma / job.prior_rms).mean())
    found = RefitResult(job.number, FitStatus.OK, best, gain, level)
    likelier = gain >= LEAST_GAIN
    if not (likelier or level > PRIOR_EXCEEDED):
        return found
    start = tried[best if likelier else present].start(sigma)
    if start is None:
        return dataclasses.replace(found, status=FitStatus.NOT_FINITE)
    return dataclasses.replace(found, start=start)


class _Posterior:
    """Rows as a leg of one slope sees them.

    Attributes:
        rms: (J,) rad, residual at the family's noise.
    """

    def __init__(self, job: RefitJob, slope: float, window: Array, target: Array) -> None:
        self._quantum = job.quantum_rad
        library = dataclasses.replace(job.library, slope_rad=slope)
        self._prior = prior = leg_prior(library, job.quantum_rad)
        self._theta, self._target = library.evaluate_flat(window), target
        residual = target - self._theta @ prior.model.coefficients
        assert prior.spread is not None
        self._spread = prior.spread
        # Per joint, in directions of the spread.
        seen = [self._theta @ spread.T for spread in prior.spread]
        self._gram = np.array([a.T @ a for a in seen])
        self._aim = np.array([a.T @ r for a, r in zip(seen, residual.T, strict=True)])
        self._squares = np.square(residual).sum(axis=0)
        moved = [x for x, _ in self._solved(prior.noise.rms)]
        off = [r - a @ x for a, r, x in zip(seen, residual.T, moved, strict=True)]
        self.rms = np.sqrt(np.square(off).mean(axis=1))

    def evidence(self, sigma: Array) -> float:
        """Compute the logarithm of the rows' probability, but for a constant of all slopes."""
        total = 0.0
        for j, (x, root) in enumerate(self._solved(sigma)):
            total -= 0.5 * float(self._squares[j] - self._aim[j] @ x) / float(sigma[j]) ** 2
            total -= float(np.log(np.diag(root)).sum())
        return total

    def start(self, sigma: Array) -> LegBaseline | None:
        """Fit the model to go on from, with what is not known of it; None where there is none."""
        library, factor = self._prior.model.library, Factor(*self._prior.model.coefficients.shape)
        factor.add(self._theta, self._target)
        known = fit_prior(factor, library, self._quantum, 1.0)
        fit = fit_sparse(factor, FitSettings(THRESHOLD, unit=tuple(sigma.tolist()), prior=known))
        if fit.status is not FitStatus.OK:
            return None
        roots = [root for _, root in self._solved(sigma)]
        spread = np.array(
            [
                scipy.linalg.solve_triangular(root, own, lower=True)
                for root, own in zip(roots, self._spread, strict=True)
            ]
        )
        model = LegModel(library, fit.coefficients)
        # Rows may be of one motion only: a leg is not judged more strictly for it.
        noise = prior_noise(np.maximum(sigma, self._prior.noise.rms))
        return dataclasses.replace(self._prior, model=model, noise=noise, spread=spread)

    def _solved(self, sigma: Array) -> list[tuple[Array, Array]]:
        """Per joint (d,) by how many spreads the coefficients are off, and (d, d) M's root."""
        found = []
        for gram, aim, own in zip(self._gram, self._aim, sigma, strict=True):
            root = np.linalg.cholesky(np.eye(len(gram)) + gram / own**2)
            x = scipy.linalg.cho_solve((root, True), aim / own**2, check_finite=False)
            found.append((x, root))
        return found
