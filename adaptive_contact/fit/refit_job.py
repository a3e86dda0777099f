"""Defines the periodic sparse refit: a job that any process can run, and its result.

The work is a pure function of compressed factors, so that it can run in another process and be
repeated exactly in a replay.  Who runs it is a :class:`Refitter`; without one, the learner does
it in line at the tick where the result falls due.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.fit.sparse_regression import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.training_domain import Domain

# λ, in units of the noise; the grid of a baseline's fit without its extremes.
SWEEP = (0.05, 0.15, 0.3)
TOLERANCE = 1.005


@dataclasses.dataclass(frozen=True)
class RefitJob:
    """Holds what a refit needs."""

    # leg, number: name it
    leg: str
    number: int
    # fit, held_out: compressed factors of the buffer
    fit: Factor
    held_out: Factor
    noise: Array  # (J,) rad, the unit of λ
    # rows that stand for what was known before, fitted to with the others
    prior: Factor | None = None
    # where the model has been by its baseline; None if that is not known
    domain: Domain | None = None

    def run(self) -> RefitResult:
        """Fit a sparse model, λ and support chosen on the held-out segments."""
        return refit(self)


@dataclasses.dataclass(frozen=True)
class RefitResult:
    """Holds the result of a refit."""

    number: int
    status: FitStatus  # how the fit ended
    coefficients: Array  # (p, J)
    threshold: float  # λ that was chosen
    held_out: float  # root mean square over the noise, mean over joints, on the held-out segments
    domain: Domain | None = None  # where the leg's model has been by now; None if that is not known


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
    """Fit a sparse model, λ and support chosen on the held-out segments."""
    unit = tuple(job.noise.tolist())
    tried: list[tuple[float, Array, Array]] = []
    whole = job.fit
    if job.prior is not None:
        whole = Factor.merged([job.fit, job.prior], whole.terms, whole.outputs)
    status = FitStatus.OK
    for threshold in SWEEP:
        fit = fit_sparse(whole, FitSettings(threshold=threshold, ridge=1e-6, unit=unit))
        if fit.status is not FitStatus.OK:
            status = fit.status
            break
        errors = job.held_out.rms(fit.coefficients) / job.noise
        if np.isfinite(errors).all():
            tried.append((threshold, errors, fit.coefficients))
    if not tried:
        empty = np.zeros((job.fit.terms, job.fit.outputs))
        worst = FitStatus.TOO_FEW_ROWS if status is FitStatus.OK else status
        return RefitResult(job.number, worst, empty, 0.0, float("nan"))
    # In every joint: a mean would let one pay for the others' sparsity.
    best = np.min([errors for _, errors, _ in tried], axis=0)
    worst_of = [float((errors / best).max()) for _, errors, _ in tried]
    limit = max(TOLERANCE, min(worst_of))
    threshold, errors, coefficients = max(
        (entry for entry, worst in zip(tried, worst_of, strict=True) if worst <= limit),
        key=lambda entry: entry[0],
    )
    domain = None if job.domain is None else job.domain.widened(job.fit)
    held_out = float(errors.mean())
    return RefitResult(job.number, FitStatus.OK, coefficients, threshold, held_out, domain)
