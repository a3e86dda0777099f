"""Several learners one sample further, their libraries and statistics evaluated together.

This is what makes six legs cost little more than one.  A tick has two halves: what its samples say
of contacts, and what no event needs to wait for: learning, and the prediction of the next.

Whatever a step of one leg raises, of any kind, makes that leg begin anew and no other: each step
stands in a `try` of its own, without a call around it, which costs more (decision 6).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from adaptive_contact.adapt.block import Block
from adaptive_contact.wire import ContactEvent, ServoSample

if TYPE_CHECKING:
    from adaptive_contact.adapt.detector import LegDetector
    from adaptive_contact.adapt.learner import ContactLearner

__all__ = ["OnFault", "Team", "check_sample"]

# Is told the leg and what its learning raised.
OnFault = Callable[[str, Exception], None]
# A learner's row in its block and place in its team, and itself with the sample of the tick.
_Seat = tuple[int, int, "ContactLearner", ServoSample]


def check_sample(sample: object) -> None:
    """Refuse what is no sample; bad values in one are counted, never raised.

    Raises:
        TypeError: such as for the map of a payload.
    """
    if not isinstance(sample, ServoSample):
        raise TypeError(
            f"expected a ServoSample, found {type(sample).__name__}; pass ServoSample(t_ns=..., "
            "seq=..., measured=[...], desired=[...]) of adaptive_contact.wire, or what its "
            "decode() makes of a payload"
        )


class _Half(NamedTuple):
    """A tick of a block that has been judged.

    Attributes:
        block: of which.
        taken: rows whose reading has been taken in; commands follow.
        going: those of them that go on.
    """

    block: Block
    taken: list[_Seat]
    going: list[_Seat]


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
        # What was judged and is not finished, and of whom.
        self._halves: list[_Half] = []
        self._watching: list[tuple[ContactLearner, ServoSample]] = []
        self._open: set[int] = set()

    def advance(self, samples: Sequence[ServoSample | None]) -> list[ContactEvent | None]:
        """Take learners one sample further, each with its own.

        Args:
            samples: the next of each learner, None where there is none.

        Returns:
            The event of each, or None.
        """
        events = self.judge(samples)
        self.finish()
        return events

    def judge(self, samples: Sequence[ServoSample | None]) -> list[ContactEvent | None]:
        """The first half of a tick: whoever waits for its events need not wait for the second.

        A learner's status and state are whole only after :meth:`finish`, which its next sample
        calls where nobody has.

        Args:
            samples: the next of each learner, None where there is none.

        Returns:
            The event of each, or None.
        """
        if self._open and any(samples[i] is not None for i in self._open):
            self._finish()
        here: dict[int, tuple[ContactLearner, ServoSample]] = {}
        events: list[ContactEvent | None] = [None] * len(self.learners)
        for i, (learner, given) in enumerate(zip(self.learners, samples, strict=True)):
            if given is None:
                continue
            try:
                frame = learner.frame
                sample = learner.admit(given if frame is None else frame.sample(given))
                if sample is None:
                    continue
                if learner.owes_release:
                    events[i] = learner.released(sample)
            except Exception as fault:
                self._fault(learner, fault)
            else:
                here[i] = (learner, sample)
        self._settle()
        self._open.update(here)
        self._watching += [here[i] for i in self._without if i in here]
        for block, places in self._blocks:
            work = [(row, i, *here[i]) for row, i in enumerate(places) if i in here]
            if work:
                self._judge(block, work, events)
        return events

    def finish(self) -> None:
        """The second half of what was judged: commands, learning, predictions.

        Who has got, changed or lost a model takes its place among the others here, too: no event
        waits for that.
        """
        if self._open:
            self._finish()
        self._settle()

    def _finish(self) -> None:
        halves, watching = self._halves, self._watching
        self._halves, self._watching = [], []
        self._open.clear()
        for learner, sample in watching:
            try:
                learner.watch(sample)
            except Exception as fault:
                self._fault(learner, fault)
        for half in halves:
            self._follow(half)

    def _fault(self, learner: ContactLearner, fault: Exception) -> None:
        """A step of one leg raised, which must not end the others' service; raised if none asks."""
        if self._on_fault is None:
            raise fault
        learner.begin_anew(fault)
        self._on_fault(learner.leg.id, fault)

    def _judge(
        self, block: Block, work: Sequence[_Seat], events: list[ContactEvent | None]
    ) -> None:
        """The first half of a tick of a block: those of its rows that have a sample."""
        trackers = block.trackers
        # Who faults on the way begins anew, elsewhere.
        sound: list[_Seat] = []
        readings = []
        for seat in work:
            row, _, learner, sample = seat
            try:
                readings.append(trackers[row].repair(sample.measured, sample.valid))
            except Exception as fault:
                self._fault(learner, fault)
            else:
                sound.append(seat)
        if not sound:
            return
        block.take([row for row, *_ in sound], readings)
        observed: list[_Seat] = []
        judged: list[int] = []
        for seat in sound:
            row, _, learner, sample = seat
            try:
                if learner.observe(sample):
                    judged.append(row)
            except Exception as fault:
                self._fault(learner, fault)
            else:
                observed.append(seat)
        said = dict(zip(judged, block.judge(judged), strict=True)) if judged else {}
        going: list[_Seat] = []
        for seat in observed:
            row, i, learner, sample = seat
            try:
                if row in said and (decided := learner.decide(said[row], sample)) is not None:
                    events[i] = decided
            except Exception as fault:
                self._fault(learner, fault)
            else:
                going.append(seat)
        self._halves.append(_Half(block, sound, going))

    def _follow(self, half: _Half) -> None:
        """The second half of a tick of a block."""
        block = half.block
        ready: list[int] = []
        for row, _, learner, sample in half.going:
            if learner.tracker is not block.trackers[row]:  # begun anew since it was judged
                continue
            try:
                if learner.command(sample):
                    ready.append(row)
                else:
                    block.trackers[row].predicted = False
                learner.learn()
            except Exception as fault:
                self._fault(learner, fault)
        block.push([row for row, *_ in half.taken], [sample.desired for *_, sample in half.taken])
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
        if self._halves:  # in blocks that are about to go
            self._finish()
            detectors = [learner.detector for learner in self.learners]
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
