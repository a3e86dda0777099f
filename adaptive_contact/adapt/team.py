"""Several learners one sample further, their libraries and statistics evaluated together.

This is what makes six legs cost little more than one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from adaptive_contact.adapt.block import Block
from adaptive_contact.wire import ContactEvent, ServoSample

if TYPE_CHECKING:
    from adaptive_contact.adapt.detector import LegDetector
    from adaptive_contact.adapt.learner import ContactLearner

__all__ = ["OnFault", "Team"]

P = ParamSpec("P")
Result = TypeVar("Result")
# Is told the leg and what its learning raised.
OnFault = Callable[[str, Exception], None]


class Team:
    """Learners that go through time together.

    Args:
        learners: any, of one robot or of several.
        on_fault: told of a fault in one's learning, which makes that one begin anew and stands in
            its status; without, faults are raised.
    """

    def __init__(
        self, learners: Sequence[ContactLearner], *, on_fault: OnFault | None = None
    ) -> None:
        self.learners = tuple(learners)
        self._on_fault = on_fault
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
        here: dict[int, tuple[ContactLearner, ServoSample]] = {}
        for i, (learner, sample) in enumerate(zip(self.learners, samples, strict=True)):
            if sample is not None and self._of_one(learner, learner.admit, sample):
                here[i] = (learner, sample)
        events: list[ContactEvent | None] = [None] * len(self.learners)
        for i, (learner, sample) in here.items():
            events[i] = self._of_one(learner, learner.released, sample)
        self._settle()
        for i in self._without:
            if i in here:
                learner, sample = here[i]
                self._of_one(learner, learner.watch, sample)
        for block, places in self._blocks:
            work = [(row, i, *here[i]) for row, i in enumerate(places) if i in here]
            if work:
                self._tick(block, work, events)
        return events

    def _of_one(
        self, learner: ContactLearner, step: Callable[P, Result], *args: P.args, **more: P.kwargs
    ) -> Result | None:
        """What a step of one leg gives; None where it faults and somebody is told."""
        try:
            return step(*args, **more)
        except Exception as fault:  # of one leg, which must not end the others' service
            if self._on_fault is None:
                raise
            learner.begin_anew(fault)
            self._on_fault(learner.leg.id, fault)
            return None

    def _tick(
        self,
        block: Block,
        work: Sequence[tuple[int, int, ContactLearner, ServoSample]],
        events: list[ContactEvent | None],
    ) -> None:
        """One tick of a block: some of its rows, each with its place, learner and sample."""
        trackers = block.trackers
        repaired = [
            self._of_one(learner, trackers[row].repair, sample.measured, sample.valid)
            for row, _, learner, sample in work
        ]
        # Who faulted begins anew, elsewhere.
        work = [one for one, reading in zip(work, repaired, strict=True) if reading is not None]
        readings = [reading for reading in repaired if reading is not None]
        if not work:
            return
        rows = [row for row, *_ in work]
        block.take(rows, readings)
        seen = [self._of_one(learner, learner.observe, sample) for *_, learner, sample in work]
        judged = [row for row, can in zip(rows, seen, strict=True) if can]
        said = dict(zip(judged, block.judge(judged), strict=True)) if judged else {}
        ready: list[int] = []

        def conclude(row: int, i: int, learner: ContactLearner, sample: ServoSample) -> None:
            verdict = said.get(row)
            decided = None if verdict is None else learner.decide(verdict, sample)
            if decided is not None:
                events[i] = decided
            if learner.command(sample):
                ready.append(row)
            else:
                trackers[row].predicted = False
            learner.learn()

        for one, can in zip(work, seen, strict=True):
            if can is not None:
                self._of_one(one[2], conclude, *one)
        block.push(rows, [sample.desired for *_, sample in work])
        if ready:
            block.predict(ready)

    def _settle(self) -> None:
        """Give every learner its place anew if one has got, changed or lost its tracker."""
        detectors = [learner.detector for learner in self.learners]
        for detector, home in zip(detectors, self._homes, strict=True):
            if (detector is None) != (home is None):
                break
            if detector is not None and detector.tracker.home is not home:
                break
        else:
            return
        groups: list[list[tuple[int, LegDetector]]] = []
        self._without = []
        for i, detector in enumerate(detectors):
            if detector is None:
                self._without.append(i)
                continue
            for group in groups:
                if group[0][1].alike(detector):
                    group.append((i, detector))
                    break
            else:
                groups.append([(i, detector)])
        self._blocks = [
            (Block([detector for _, detector in group]), [i for i, _ in group]) for group in groups
        ]
        self._homes = [None if d is None else d.tracker.home for d in detectors]
