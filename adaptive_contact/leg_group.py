"""Takes several learners one tick further, the arithmetic of all legs in one compiled call.

This is what makes six legs cost little more than one.  A tick has two halves.  The first,
:meth:`LegGroup.judge`, goes from samples to contact events.  The second, :meth:`LegGroup.finish`,
learns from the tick and predicts the next; no event waits for it.

Whatever a step of one leg raises resets that leg and no other: each step is in a `try` of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

import numpy as np

from adaptive_contact.compiled import note_cached
from adaptive_contact.detect.layout import DECIDED, RELEASE_PENDING
from adaptive_contact.detect.leg_batch import LegBatch, LegPlace
from adaptive_contact.learn.rls import RecursiveLeastSquares, moves_at_most
from adaptive_contact.model.library import Library, with_changes
from adaptive_contact.robot import Leg
from adaptive_contact.wire import ContactEvent, ServoSample

__all__ = ["LegGroup", "Member", "OnFault", "check_sample", "compile_ahead"]

# Called with the leg and what its learning raised.
OnFault = Callable[[str, Exception], None]
# Flags of a tick that make an event; few ticks have one.
_EVENTS: Final = DECIDED | RELEASE_PENDING


class Member(Protocol):
    """Defines a learner of one leg, as a group takes it through a tick; in this order.

    Attributes:
        leg: its description.
        place: its arrays.
    """

    leg: Leg
    place: LegPlace

    def take(self, sample: ServoSample) -> bool:
        """Put a sample into the leg's row of the arrays; False if it is refused."""

    def event_of(self, flags: int) -> ContactEvent | None:
        """Make the event of a judged tick, if there is one."""

    def finish(self, flags: int) -> bool:
        """Learn from a judged tick; True if another model is to be taken up."""

    def take_up_model(self) -> None:
        """Put the model of another adapter in force, such as that of a cold start."""

    def reset_after_fault(self, fault: Exception) -> None:
        """Restore what was last saved, after a step of this leg raised."""


def check_sample(sample: object) -> None:
    """Refuse what is not a sample; bad values in one are counted, never raised.

    Raises:
        TypeError: such as for the map of a payload.
    """
    if not isinstance(sample, ServoSample):
        raise TypeError(
            f"expected a ServoSample, found {type(sample).__name__}; pass ServoSample(t_ns=..., "
            "seq=..., measured=[...], desired=[...]) of adaptive_contact.wire, or what its "
            "decode() makes of a payload"
        )


class LegGroup:
    """Takes several learners through time together.

    Args:
        learners: any, of one robot or of several.
        on_fault: called with a fault in one leg's learning, after which that leg is reset; the
            status reports it.  Without it, faults are raised.
    """

    def __init__(self, learners: Sequence[Member], *, on_fault: OnFault | None = None) -> None:
        self.learners = tuple(learners)
        self._on_fault = on_fault
        self._batches: list[tuple[LegBatch, list[int]]] = []  # with the places of their rows
        self._homes: list[LegBatch | None] = [None] * len(self.learners)
        self._open: set[int] = set()  # judged, and not finished

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
        """Judge the samples: the first half of a tick, up to its events.

        A learner's status and state are whole only after :meth:`finish`, which its next sample
        calls if it was not called.

        Args:
            samples: the next of each learner, None where there is none.

        Returns:
            The event of each, or None.
        """
        if self._open and any(samples[i] is not None for i in self._open):
            self.finish()
        self._regroup()
        events: list[ContactEvent | None] = [None] * len(self.learners)
        here: list[int] = []
        for batch, _ in self._batches:
            batch.accepted[:] = False
        for i, (learner, sample) in enumerate(zip(self.learners, samples, strict=True)):
            if sample is None:
                continue
            try:
                if learner.take(sample):
                    here.append(i)
            except Exception as fault:  # of any kind: it is this leg's alone
                self._fault(learner, fault)
        if not here:
            return events
        self._open.update(here)
        for batch, members in [pair for pair in self._batches if pair[0].judge() & _EVENTS]:
            for i, flags in zip(members, batch.flags, strict=True):
                learner = self.learners[i]
                if not flags & _EVENTS or not batch.accepted[learner.place.row]:
                    continue
                try:
                    events[i] = learner.event_of(flags)
                except Exception as fault:  # of any kind: it is this leg's alone
                    self._fault(learner, fault)
        return events

    def finish(self) -> None:
        """Finish what was judged: learning, then commands and predictions.

        A leg whose model appears, changes or goes is put into its batch here, too: no event waits
        for that.
        """
        if self._open:
            taking_over: list[Member] = []
            for batch, members in self._batches:
                for i, flags in zip(members, batch.flags, strict=True):
                    if i not in self._open:
                        continue
                    learner = self.learners[i]
                    try:
                        if learner.finish(flags):
                            taking_over.append(learner)
                    except Exception as fault:  # of any kind: it is this leg's alone
                        self._fault(learner, fault)
                batch.finish()
            for learner in taking_over:
                try:
                    learner.take_up_model()
                except Exception as fault:  # of any kind: it is this leg's alone
                    self._fault(learner, fault)
            self._open.clear()
        self._regroup()

    def _fault(self, learner: Member, fault: Exception) -> None:
        """Reset the leg whose step raised, so that the others go on; raise without ``on_fault``."""
        if self._on_fault is None:
            raise fault
        learner.reset_after_fault(fault)
        self._on_fault(learner.leg.id, fault)

    def _regroup(self) -> None:
        """Put learners of equal libraries into one batch, where a leg's batch is another now."""
        for learner, home in zip(self.learners, self._homes, strict=True):
            if learner.place.batch is not home:
                break
        else:
            return
        groups: list[list[Member]] = []
        for learner in self.learners:
            for group in groups:
                if group[0].place.batch.alike(learner.place.batch):
                    group.append(learner)
                    break
            else:
                groups.append([learner])
        places = {id(learner): i for i, learner in enumerate(self.learners)}
        self._batches = [
            (LegBatch.of([learner.place for learner in group]), [places[id(o)] for o in group])
            for group in groups
        ]
        self._homes = [learner.place.batch for learner in self.learners]


def compile_ahead() -> None:
    """Compile what a tick needs, or load it, before the first one; safe to call again."""
    joints = ("coxa", "femur", "tibia")
    leg = Leg(id="any", joints=joints)
    plain = Library("servo", joints, leg.joint_axes)
    library = with_changes(plain, np.zeros((plain.size, len(joints))))
    batch = LegBatch([leg], library, [0.005], 20_000_000, max_step=0.5)
    batch.judge()
    batch.finish()
    every = np.ones((library.size, len(joints)), dtype=np.bool_)
    coefficients, scale = np.zeros(every.shape), np.ones(library.size)
    recursion = RecursiveLeastSquares(coefficients, every, scale, np.ones(len(joints)))
    recursion.update(np.zeros(library.size), np.zeros(len(joints)))
    moves_at_most(recursion.coefficients, scale, 1.0)
    note_cached()
