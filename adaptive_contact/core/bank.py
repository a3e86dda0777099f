"""Processes a tick of all legs of a robot in one compiled call.

:class:`LearnerBank` holds a learner per leg.  :class:`LegGroup` takes learners through a tick: this
is what makes six legs cost little more than one.  A tick has two halves.  The first,
:meth:`LegGroup.detect_contacts`, goes from samples to contact events.  The second,
:meth:`LegGroup.learn_from_tick`, learns from the tick and predicts the next; no event waits for it.

Whatever a step of one leg raises resets that leg and no other (:meth:`LegGroup._guarded`).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Final, TypeVar, TypeVarTuple

import msgspec
import numpy as np

from adaptive_contact.checks.leg_ids import watch_ids
from adaptive_contact.checks.watch import watch_angles
from adaptive_contact.compiled import mark_cache_complete
from adaptive_contact.core.detect.leg_batch import LegBatch
from adaptive_contact.core.detect.standing import Standing
from adaptive_contact.core.detect.stream import fault_of
from adaptive_contact.core.detect.swing_labels import close_swing, copy_rows, let_go_row
from adaptive_contact.core.learn.mode import LearnerMode, WhenAmbiguous
from adaptive_contact.core.learn.rls import RecursiveLeastSquares, moves_at_most
from adaptive_contact.core.leg_learner import EVENTS, ContactLearner, check_sample
from adaptive_contact.fit.refit_job import InlineRefitter, Refitter
from adaptive_contact.model.library import Library, with_changes
from adaptive_contact.model.model_file import Baseline
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.robot.description import MAX_JOINTS
from adaptive_contact.wire import ContactEvent, ServoSample, is_leg_id

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
# Called with the leg and what its learning raised.
OnFault = Callable[[str, Exception], None]
# Against a publisher that invents names, legs that are not described are bounded; described ones
# never are.  Bounded are their number, and the sum of the squares of their joints: the arrays of a
# leg grow faster than that, to 14 MB for 16 joints.
MAX_LEGS: Final = 32
MAX_SQUARES: Final = 1024


class LegGroup:
    """Processes the ticks of several learners together.

    Args:
        learners: any, of one robot or of several.
        on_fault: called with a fault in one leg's learning, after which that leg is reset; the
            status reports it.  Without it, faults are raised.
    """

    def __init__(
        self, learners: Sequence[ContactLearner], *, on_fault: OnFault | None = None
    ) -> None:
        self.learners = tuple(learners)
        self._on_fault = on_fault
        self._batches: list[tuple[LegBatch, list[int]]] = []  # with the places of their rows
        self._homes: list[LegBatch | None] = [None] * len(self.learners)
        self._open: set[int] = set()  # judged, and not finished

    def advance(self, samples: Sequence[ServoSample | None]) -> list[ContactEvent | None]:
        """Process one sample per leg.

        Args:
            samples: the next of each learner, None where there is none.

        Returns:
            The event of each, or None.
        """
        events = self.detect_contacts(samples)
        self.learn_from_tick()
        return events

    def detect_contacts(self, samples: Sequence[ServoSample | None]) -> list[ContactEvent | None]:
        """Detect contacts in the samples: the first half of a tick, up to its events.

        A learner's status and state are whole only after :meth:`learn_from_tick`, which its next
        sample calls if it was not called.

        Args:
            samples: the next of each learner, None where there is none.

        Returns:
            The event of each, or None.
        """
        if self._open and any(samples[i] is not None for i in self._open):
            self.learn_from_tick()
        self._regroup()
        events: list[ContactEvent | None] = [None] * len(self.learners)
        for batch, _ in self._batches:
            batch.accepted.fill(False)
        here = False
        for i, (learner, sample) in enumerate(zip(self.learners, samples, strict=True)):
            if sample is None:
                continue
            if self._guarded(i, learner.admit_sample, sample):
                here = True
                self._open.add(i)
        if not here:
            return events
        # Every batch is judged before the first event is made.
        for batch, members in [pair for pair in self._batches if pair[0].evaluate_tick() & EVENTS]:
            for i, flags in zip(members, batch.flags, strict=True):
                learner = self.learners[i]
                if flags & EVENTS and batch.accepted[learner.place.row]:
                    events[i] = self._guarded(i, learner.event_of, flags)
        return events

    def learn_from_tick(self) -> None:
        """Learn from the tick, then put commands in force and predict the next one.

        A leg whose model appears, changes or goes is put into its batch here, too: no event waits
        for that.
        """
        if self._open:
            another: list[int] = []
            for batch, members in self._batches:
                for i, flags in zip(members, batch.flags, strict=True):
                    if i in self._open and self._guarded(
                        i, self.learners[i].learn_from_tick, flags
                    ):
                        another.append(i)
                batch.predict_next_tick()
            self._open.clear()
            for i in another:
                self._guarded(i, self.learners[i].adopt_model)
        self._regroup()

    def _guarded(self, at: int, step: Callable[[*Ts], T], *given: *Ts) -> T | None:
        """Do a step of one leg; whatever it raises resets that leg alone, and the others go on."""
        try:
            return step(*given)
        except Exception as fault:  # a fault of ours, in one leg of many
            self._reset(at, fault)
            return None

    def _reset(self, at: int, fault: Exception) -> None:
        """Reset a leg whose step raised; without ``on_fault``, raise."""
        if self._on_fault is None:
            raise fault
        learner = self.learners[at]
        learner.reset_after_fault(fault)
        self._on_fault(learner.leg.id, fault)

    def _regroup(self) -> None:
        """Put learners of equal libraries into one batch, where a leg's batch is another now."""
        for learner, home in zip(self.learners, self._homes, strict=True):
            if learner.place.batch is not home:
                break
        else:
            return
        groups: list[list[ContactLearner]] = []
        for learner in self.learners:
            for group in groups:
                if group[0].place.batch.alike(learner.place.batch):
                    group.append(learner)
                    break
            else:
                groups.append([learner])
        places = {id(learner): i for i, learner in enumerate(self.learners)}
        self._batches = []
        for group in groups:
            batch = group[0].place.batch
            if batch.count != len(group) or any(o.place.batch is not batch for o in group):
                batch = LegBatch.from_places([learner.place for learner in group])
            group.sort(key=lambda learner: learner.place.row)
            self._batches.append((batch, [places[id(o)] for o in group]))
        self._homes = [learner.place.batch for learner in self.learners]


class LearnerBank:
    """Holds a learner per leg, made when a leg is first seen.

    Args:
        robot: its description.
        baseline: what is known of its legs' free motion.
        refitter: does the sparse refits; in line where absent.
        on_fault: called with a fault in one leg's learning, after which that leg is reset;
            without it, faults are raised.
        when_ambiguous: whether contacts are reported while a leg is ambiguous.
        mode: what its learners may do to follow their legs.

    Raises:
        BaselineError: the baseline belongs to another robot.
    """

    def __init__(
        self,
        robot: Robot,
        baseline: Baseline | None = None,
        *,
        refitter: Refitter | None = None,
        on_fault: OnFault | None = None,
        when_ambiguous: WhenAmbiguous = WhenAmbiguous.WITHHOLD,
        mode: LearnerMode = LearnerMode.FULL,
    ) -> None:
        if baseline is not None:
            baseline.check_fits(robot)
        self.robot = robot
        self.baseline = baseline
        self._refitter = refitter or InlineRefitter()
        self._conventions = watch_angles(robot, self._refitter)
        self._ids = watch_ids(robot, baseline, self._refitter)
        self._standing = Standing()
        self._learners: dict[str, ContactLearner] = {}
        self._on_fault = on_fault
        self._when_ambiguous, self._mode = when_ambiguous, mode
        self._group = LegGroup(())

    @property
    def legs(self) -> tuple[str, ...]:
        """Return the legs seen so far."""
        return tuple(self._learners)

    def learner(self, leg: str, joints: int | None = None) -> ContactLearner | None:
        """Return the learner of a leg, made if need be.

        Args:
            leg: its id; one that the description lacks gets a learner without geometry, so that
                its samples must carry their phase.
            joints: how many joints its samples have, for such a leg.

        Returns:
            The learner, or None for an unusable id, and for one leg too many.
        """
        if leg not in self._learners:
            described = leg in self.robot.leg_ids
            if not is_leg_id(leg) or not (described or self.has_room([joints or 0])):
                return None
            self.add(self.make(leg, joints or 0))
        return self._learners[leg]

    def has_room(self, joints: Sequence[int]) -> bool:
        """Return whether more legs that the description lacks, of so many joints, get learners."""
        others = [o.leg for o in self._learners.values() if o.leg.id not in self.robot.leg_ids]
        every = [*(len(leg.joints) for leg in others), *joints]
        return (
            all(1 <= n <= MAX_JOINTS for n in joints)
            and len(self._learners) + len(joints) <= MAX_LEGS
            and sum(n * n for n in every) <= MAX_SQUARES
        )

    def make(self, leg: str, joints: int) -> ContactLearner:
        """Make a leg's learner, to be added; on any thread if the description lacks the leg."""
        robot, baseline = self.robot, self.baseline
        if leg not in robot.leg_ids:
            stranger = Leg(id=leg, joints=tuple(f"joint{i + 1}" for i in range(joints)))
            robot = msgspec.structs.replace(robot, legs=(*robot.legs, stranger))
            baseline = None  # one of that name there would be of another leg
        return ContactLearner(
            robot,
            leg,
            baseline,
            refitter=self._refitter,
            conventions=self._conventions,
            ids=self._ids,
            standing=self._standing,
            when_ambiguous=self._when_ambiguous,
            mode=self._mode,
        )

    def add(self, learner: ContactLearner) -> None:
        """Add a learner, to be judged with the others from now on."""
        self._learners[learner.leg.id] = learner
        self._group.learn_from_tick()
        self._group = LegGroup(tuple(self._learners.values()), on_fault=self._on_fault)

    def update(self, samples: Mapping[str, ServoSample]) -> list[ContactEvent]:
        """Take in at most one sample per leg.

        Args:
            samples: by leg; those of legs that get no learner are ignored, ask
                :meth:`learner` first to count them.

        Returns:
            The events they decide, in the order of ``samples``.

        Raises:
            TypeError: one is no sample, such as the map of a payload.
        """
        for sample in samples.values():
            check_sample(sample)
        events = self.detect_contacts(samples)
        self.learn_from_tick()
        return events

    def detect_contacts(self, samples: Mapping[str, ServoSample]) -> list[ContactEvent]:
        """Detect contacts in one sample per leg; :meth:`learn_from_tick` does what can wait.

        Args:
            samples: by leg, at most one each.

        Returns:
            The events they decide, in the order of ``samples``.
        """
        for leg, sample in samples.items():
            joints = len(sample.measured)
            if leg not in self._learners and not fault_of(sample, joints):
                self.learner(leg, joints)
        events = self._group.detect_contacts([samples.get(leg) for leg in self._learners])
        if not any(events):  # as in nearly every tick
            return []
        decided = dict(zip(self._learners, events, strict=True))
        return [event for leg in samples if (event := decided.get(leg)) is not None]

    def learn_from_tick(self) -> None:
        """Learn from the tick; statuses and states are complete after it."""
        self._group.learn_from_tick()
        self._conventions.poll()
        self._ids.poll()


def compile_ahead() -> None:
    """Compile what a tick needs, or load it, before the first one; safe to call again."""
    for part in ("scipy.linalg", "scipy.special"):  # else they load in the tick that needs them
        importlib.import_module(part)
    joints = ("coxa", "femur", "tibia")
    leg = Leg(id="any", joints=joints)
    plain = Library("servo", joints, leg.joint_axes)
    library = with_changes(plain, np.zeros((plain.size, len(joints))))
    batch = LegBatch([leg], library, [0.005], 20_000_000, max_step=0.5)
    batch.evaluate_tick()
    batch.predict_next_tick()
    every = np.ones((library.size, len(joints)), dtype=np.bool_)
    coefficients, scale = np.zeros(every.shape), np.ones(library.size)
    recursion = RecursiveLeastSquares(coefficients, every, scale, np.ones(len(joints)))
    recursion.learn(batch.row_values[0], 0)
    moves_at_most(recursion.coefficients, scale, 1.0)
    copy_rows(batch.row_values[0], batch.rows[0], 0, 0)
    let_go_row(batch.rows[0], 0)
    close_swing(batch.rows[0], batch.row_values[0], 0, 0, 0, 0, 0, -1)
    mark_cache_complete()
