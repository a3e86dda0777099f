"""Several learners one sample further, their libraries and statistics evaluated together.

This is what makes six legs cost little more than one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.block import Block
from adaptive_contact.identify import Domain
from adaptive_contact.wire import ContactEvent, ServoSample

if TYPE_CHECKING:
    from adaptive_contact.adapt.learner import ContactLearner

__all__ = ["Team", "within_domain"]

Array = NDArray[np.float64]


class Team:
    """Learners that go through time together.

    Args:
        learners: any, of one robot or of several.
    """

    def __init__(self, learners: Sequence[ContactLearner]) -> None:
        self.learners = tuple(learners)
        self._blocks: list[tuple[Block, list[int]]] = []
        self._without = list(range(len(self.learners)))  # a model, and so without a block
        self._homes: list[Block | None] = [None] * len(self.learners)

    def advance(self, samples: Sequence[ServoSample | None]) -> list[ContactEvent | None]:
        """Take learners one sample further, each with its own.

        Args:
            samples: the next of each learner, None where there is none.

        Returns:
            The event of each, or None.
        """
        events: list[ContactEvent | None] = [None] * len(self.learners)
        admitted = [
            sample is not None and learner.admit(sample)
            for learner, sample in zip(self.learners, samples, strict=True)
        ]
        for i, learner in enumerate(self.learners):
            sample = samples[i]
            if admitted[i] and sample is not None:
                events[i] = learner.released(sample)
        self._settle()
        for i in self._without:
            sample = samples[i]
            if admitted[i] and sample is not None:
                self.learners[i].watch(sample)
        for block, places in self._blocks:
            rows: list[int] = []
            work: list[tuple[int, ContactLearner, ServoSample]] = []
            for row, i in enumerate(places):
                sample = samples[i]
                if admitted[i] and sample is not None:
                    rows.append(row)
                    work.append((i, self.learners[i], sample))
            if rows:
                _tick(block, rows, work, events)
        return events

    def _settle(self) -> None:
        """Give every learner its place anew if one has got, changed or lost its tracker."""
        for learner, home in zip(self.learners, self._homes, strict=True):
            tracker = learner.tracker
            if tracker is not None and (home is None or tracker.home is not home):
                break
            if tracker is None and home is not None:
                break
        else:
            return
        groups: list[list[int]] = []
        self._without = []
        for i, learner in enumerate(self.learners):
            if learner.tracker is None:
                self._without.append(i)
                continue
            for group in groups:
                if self.learners[group[0]].alike(learner):
                    group.append(i)
                    break
            else:
                groups.append([i])
        self._blocks = [(Block([self.learners[i] for i in group]), group) for group in groups]
        trackers = [learner.tracker for learner in self.learners]
        self._homes = [None if tracker is None else tracker.home for tracker in trackers]


def _tick(
    block: Block,
    rows: list[int],
    work: list[tuple[int, ContactLearner, ServoSample]],
    events: list[ContactEvent | None],
) -> None:
    """One tick of a block: some of its rows, with their place, learner and sample."""
    trackers = block.trackers
    block.take(
        rows,
        [
            trackers[row].repair(sample.measured, sample.valid)
            for row, (_, _, sample) in zip(rows, work, strict=True)
        ],
    )
    judged = [
        row for row, (_, learner, sample) in zip(rows, work, strict=True) if learner.observe(sample)
    ]
    said = dict(zip(judged, block.judge(judged), strict=True)) if judged else {}
    ready = []
    for row, (i, learner, sample) in zip(rows, work, strict=True):
        verdict = said.get(row)
        if verdict is not None:
            decided = learner.decide(verdict, sample)
            if decided is not None:
                events[i] = decided
        if learner.command(sample):
            ready.append(row)
        else:
            trackers[row].predicted = False
        learner.learn()
    block.push(rows, [sample.desired for _, _, sample in work])
    if ready:
        block.predict(ready)


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
