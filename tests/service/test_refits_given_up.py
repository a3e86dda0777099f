"""What a leg is told of a refit that was given up."""

from __future__ import annotations

import dataclasses

import numpy as np

from adaptive_contact.fit import FitStatus
from adaptive_contact.fit.refit_job import Job
from adaptive_contact.learn.periodic_refit import REFIT_DUE_TICKS, PeriodicRefit, first_refit_after
from adaptive_contact.learn.replay_buffer import ReplayBuffer
from adaptive_contact.model import Library
from adaptive_contact.model.labelled_swing import ROW, Rows
from adaptive_contact.model.library import with_changes
from adaptive_contact.service.refits import result_of_lost

WHY = "the process that fits died or took too long"


class Giving:
    """Gives up every refit, as lost or with another status in its place."""

    def __init__(self, up_with: FitStatus) -> None:
        self._status = up_with
        self._result: object = None

    def submit(self, job: Job) -> None:
        """Fail at once."""
        result = result_of_lost(job)
        assert result.status is FitStatus.LOST
        self._result = dataclasses.replace(result, status=self._status)

    def collect(self, leg: str, number: int) -> object:
        """The failure."""
        return self._result


def test_the_status_of_a_leg_tells_a_lost_fit_from_one_that_is_not_finite() -> None:
    """Through the leg's own refits, whose reason is what LearnerStatus carries."""
    plain = Library("linear", ("a", "b"), ("pitch", "pitch"))
    library = with_changes(plain, np.zeros((plain.size, 2)))
    p = library.size
    rng = np.random.default_rng(0)
    buffer = ReplayBuffer()
    for _ in range(40):
        values = np.concatenate([np.tile(rng.normal(size=p), (12, 1)), np.zeros((12, 4))], axis=1)
        buffer.add(Rows(values, np.zeros(12, dtype=ROW), 2), 0, 0)
    for status, words in (
        (FitStatus.LOST, f"refused: the fit ended with 'lost: {WHY}'"),
        (FitStatus.NOT_FINITE, "refused: the fit ended with 'not_finite'"),
    ):
        refit = PeriodicRefit("rf", library, 0.005, Giving(up_with=status))
        for _ in range(first_refit_after("rf")[0]):
            refit.end_swing(buffer, 0, learned=True)
        for _ in range(REFIT_DUE_TICKS + 1):
            refit.tick()
        assert refit.counts.refused == 1
        assert refit.counts.last_reason == words
