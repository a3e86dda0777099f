"""Several learners one sample further, their libraries and statistics evaluated together.

This is what makes six legs cost little more than one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.tracker import Tracker
from adaptive_contact.detect import statistic
from adaptive_contact.identify import Domain
from adaptive_contact.wire import ContactEvent, ServoSample

if TYPE_CHECKING:
    from adaptive_contact.adapt.learner import ContactLearner

__all__ = ["Verdict", "advance", "within_domain"]

Array = NDArray[np.float64]


class Verdict(NamedTuple):
    """What the statistic says of a tick.

    Attributes:
        scores: statistic over threshold for each window, NaN where it reaches too far back.
        distance: of the last residual from zero, whitened and squared, in any direction.
    """

    scores: list[float]
    distance: float

    @property
    def score(self) -> float:
        """The largest."""
        # The window of one tick is always usable; longer ones may be NaN, which `max` passes over
        # when it does not come first.
        return max(self.scores)


def advance(
    work: Sequence[tuple[ContactLearner, ServoSample]],
) -> list[ContactEvent | None]:
    """Take several learners one sample further, each with its own.

    Args:
        work: learners, each at most once, with the sample that is next for it.

    Returns:
        The event of each, or None.
    """
    events: list[ContactEvent | None] = [None] * len(work)
    admitted = [i for i, (learner, sample) in enumerate(work) if learner.admit(sample)]
    judged = [i for i in admitted if work[i][0].observe(work[i][1])]
    said = dict(zip(judged, _verdicts([work[i][0] for i in judged]), strict=True))
    ready: list[Tracker] = []
    for i in admitted:
        learner, sample = work[i]
        events[i] = learner.decide(said.get(i), sample)
        if learner.command(sample):
            assert learner.tracker is not None
            ready.append(learner.tracker)
        elif learner.tracker is not None:
            learner.tracker.predicted = False
        learner.learn()
    _predict(ready)
    return events


def _verdicts(learners: Sequence[ContactLearner]) -> list[Verdict]:
    """The statistic of each learner's tick; those with as many joints go together."""
    if not learners:
        return []
    trackers = [learner.tracker for learner in learners]
    assert all(t is not None for t in trackers)
    if len({t.residuals.shape for t in trackers if t is not None}) > 1:
        return [verdict for learner in learners for verdict in _verdicts([learner])]
    said = statistic(
        np.array([t.residuals for t in trackers if t is not None]),
        np.array([t.increments for t in trackers if t is not None]),
        np.array([learner.whitening for learner in learners]),
        np.array([t.usable for t in trackers if t is not None]),
    )
    scores = said.value / np.array([learner.thresholds for learner in learners])
    return [
        Verdict(row, distance)
        for row, distance in zip(scores.tolist(), said.distance.tolist(), strict=True)
    ]


def _predict(trackers: Sequence[Tracker]) -> None:
    """Predict the next tick of each; legs with the same library go together."""
    if not trackers:
        return
    first = trackers[0].model.library
    if any(t.model.library is not first and t.model.library != first for t in trackers[1:]):
        for tracker in trackers:
            _predict([tracker])
        return
    theta = first.evaluate_flat(np.array([t.window for t in trackers]))
    coefficients = np.array([t.model.coefficients for t in trackers])
    increments = np.matmul(theta[:, None, :], coefficients)[:, 0]
    for tracker, row, increment in zip(trackers, theta, increments, strict=True):
        tracker.foresee(row, increment)


def within_domain(
    scores: Sequence[float], thetas: Sequence[Array], domain: Domain | None
) -> tuple[float, int]:
    """The largest score where the model is not asked to extrapolate.

    A window's statistic counts over one plus the mean leverage of its rows.

    Args:
        scores: statistic over threshold of each window, shortest first; NaN for none.
        thetas: (p,) regressors of each tick's prediction, newest first.
        domain: where the model has been; None if that is not known.

    Returns:
        The score, and the ticks of its window.
    """
    spread = 0.0
    best, width = 0.0, 1
    for ticks, (score, theta) in enumerate(zip(scores, thetas, strict=False), 1):
        spread += 0.0 if domain is None else float(domain.leverage(theta))
        known = score / (1.0 + spread / ticks)
        if known > best:
            best, width = known, ticks
    return best, width
