"""Refits to be tried: a leg of one term, answers that are given, and rows of a trial."""

from __future__ import annotations

import numpy as np

from adaptive_contact.fit import FitStatus
from adaptive_contact.fit.refit_job import RefitJob, RefitResult
from adaptive_contact.learn.candidate import (
    REFIT_DUE_TICKS,
    TRIAL_ROWS,
    Candidate,
    first_refit_after,
)
from adaptive_contact.learn.replay_buffer import ReplayBuffer
from adaptive_contact.model import LegModel
from adaptive_contact.model.labelled_swing import Row, Touch

from .ticks import Tick, rows_of

NOISE = np.array([0.01, 0.01, 0.01])


class Given:
    """Answers every job with the same candidate, and keeps the jobs."""

    def __init__(self, coefficients: np.ndarray, status: FitStatus = FitStatus.OK) -> None:
        self.coefficients, self.status = coefficients, status
        self.jobs: list[RefitJob] = []

    def submit(self, job: RefitJob) -> None:
        """Keep it."""
        self.jobs.append(job)

    @property
    def asked(self) -> int:
        """How many there were."""
        return len(self.jobs)

    def collect(self, leg: str, number: int) -> RefitResult:
        """The candidate."""
        return RefitResult(number, self.status, self.coefficients, 0.1, 1.0)


def row(rng: np.random.Generator, p: int, *, truth: float) -> Row:
    """A free tick, in which only the first term is excited."""
    theta = np.zeros(p)
    theta[0] = rng.normal() + 2.0
    target = theta[0] * truth + rng.normal(size=3) * NOISE
    return Row(theta, target, 0)


def fill(
    buffer: ReplayBuffer,
    rng: np.random.Generator,
    p: int,
    segments: int = 60,
    *,
    truth: float = 0.05,
) -> None:
    """Lifts of a dozen free ticks, in three regions by turns; 60 are enough for a refit."""
    for k in range(segments):
        ticks = [row(rng, p, truth=truth) for _ in range(12)]
        buffer.add(rows_of([Tick(tick.theta, tick.target) for tick in ticks]), k % 3, 0)


def stopped(model: LegModel) -> Touch:
    """A leg that should move by 0.1 rad and stands; the second term is excited there only."""
    theta = np.zeros((1, 3, model.library.size))
    theta[:, 0, 0], theta[:, 0, 1] = 2.0, 1.0
    whiten = np.broadcast_to(np.eye(3) / NOISE, (1, 3, 3, 3))
    return Touch(theta, np.zeros((1, 3, 3)), whiten, np.full((1, 3), 30.0), np.ones(1))


def swing_done(
    trial: Candidate, model: LegModel, buffer: ReplayBuffer, *, learned: bool = True
) -> None:
    """A swing has ended."""
    if trial.swing_done(model.library.period_s, learned=learned):
        trial.request(model, buffer, 0)


def ask(trial: Candidate, model: LegModel, buffer: ReplayBuffer) -> None:
    """As many swings as there are before the first refit, or between one and the next."""
    for _ in range(first_refit_after("rf")[0]):
        swing_done(trial, model, buffer)


def answer(trial: Candidate) -> None:
    """The ticks until a refit's result is due."""
    for _ in range(REFIT_DUE_TICKS + 1):
        trial.tick()


def tried(model: LegModel, candidate: np.ndarray, contacts: int) -> tuple[Candidate, LegModel]:
    """After a whole trial on ticks that the candidate fits."""
    trial = Candidate("rf", NOISE, np.ones(model.library.size), Given(candidate))
    buffer = ReplayBuffer()
    rng = np.random.default_rng(0)
    p = model.library.size
    fill(buffer, rng, p, truth=0.06)
    for _ in range(contacts):
        trial.contacts.add(stopped(model))
    ask(trial, model, buffer)
    answer(trial)
    assert trial.trying
    promoted = None
    for _ in range(2 * TRIAL_ROWS):
        promoted = compared(trial, row(rng, p, truth=0.06), model)
        if promoted is not None or not trial.trying:
            break
    return trial, promoted or model


def compared(trial: Candidate, new: Row, model: LegModel, *, valid: bool = True) -> LegModel | None:
    """A row of the trial, as the adapter lets it be tried."""
    off = (new.target - new.theta @ model.coefficients) / NOISE
    return trial.compare(new, off.tolist(), model, valid=valid)
