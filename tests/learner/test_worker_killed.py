"""A learner whose fitting process is killed in the middle of every fit."""

from __future__ import annotations

import signal
import time

import numpy as np
import pytest

from adaptive_contact.fit.refit_job import Job
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.service.refits import WaitingRefitter

from .conftest import FakeLeg, outcomes, play, samples

pytestmark = pytest.mark.e2e

SWINGS = 150
STOPS = [16 if n % 2 else None for n in range(SWINGS)]


class Assassin(WaitingRefitter):
    """Kills its process whenever that has a job in hand."""

    def __init__(self) -> None:
        super().__init__()
        self.killed = 0

    def submit(self, job: Job) -> None:
        """Hold the process up, give it the job, and kill it."""
        process = self._process
        process.send_signal(signal.SIGSTOP)
        super().submit(job)
        until = time.monotonic() + 20.0
        with self._changed:
            while self._waiting:
                assert time.monotonic() < until
                self._changed.wait(0.01)
        process.kill()
        self.killed += 1


def test_a_worker_killed_in_every_fit_costs_its_learner_nothing(
    robot: Robot, baseline: Baseline
) -> None:
    gain = [1.0 if n < 20 else 0.85 for n in range(SWINGS)]
    leg = FakeLeg(seed=31).run(SWINGS, touch=lambda n: STOPS[n], change=lambda n: gain[n])
    stream = samples(*leg[:3])
    kept, killed = WaitingRefitter(), Assassin()
    try:
        known = ContactLearner(robot, "rf", baseline, refitter=kept)
        events = play(known, stream)
        learner = ContactLearner(robot, "rf", baseline, refitter=killed)
        assert play(learner, stream) == events
    finally:
        kept.close()
        killed.close()
    assert killed.killed >= 2, "or this test says nothing"
    assert killed.failures == 0
    assert learner.status == known.status
    assert np.array_equal(learner.model.coefficients, known.model.coefficients)
    assert outcomes(events, range(60, SWINGS), STOPS).count("hit") >= 43
