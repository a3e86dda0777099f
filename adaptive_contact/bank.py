"""Holds the learners of all legs of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import msgspec

from adaptive_contact.diagnose.angle_watch import ConventionWatch
from adaptive_contact.diagnose.leg_ids import IdWatch
from adaptive_contact.fit.refit_job import InlineRefitter, Refitter
from adaptive_contact.learn.mode import WhenAmbiguous
from adaptive_contact.leg_group import LegGroup, OnFault, check_sample
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model.model_file import Baseline
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.wire import ContactEvent, ServoSample, is_leg_id

__all__ = ["MAX_LEGS", "LearnerBank"]

# A leg that is not described is one too many from here on, against a publisher that invents names.
# A described one never is.
MAX_LEGS: Final = 32


class LearnerBank:
    """Holds a learner per leg, made when a leg is first seen.

    Args:
        robot: its description.
        baseline: what is known of its legs' free motion.
        refitter: does the sparse refits and cold starts; in line where absent.
        on_fault: called with a fault in one leg's learning, after which that leg is reset;
            without it, faults are raised.
        when_ambiguous: whether contacts are reported while a leg is ambiguous.

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
    ) -> None:
        if baseline is not None:
            baseline.check_fits(robot)
        self.robot = robot
        self.baseline = baseline
        self._refitter = refitter or InlineRefitter()
        self._conventions = ConventionWatch(robot, self._refitter)
        self._ids = IdWatch(robot, baseline, self._refitter)
        self._learners: dict[str, ContactLearner] = {}
        self._on_fault = on_fault
        self._when_ambiguous = when_ambiguous
        self._group = LegGroup(())

    @property
    def legs(self) -> tuple[str, ...]:
        """Legs seen so far."""
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
        known = self._learners.get(leg)
        if known is not None:
            return known
        if not is_leg_id(leg):
            return None
        robot, baseline = self.robot, self.baseline
        if leg not in robot.leg_ids:
            if len(self._learners) >= MAX_LEGS or joints is None or not 1 <= joints <= 16:
                return None
            stranger = Leg(id=leg, joints=tuple(f"joint{i + 1}" for i in range(joints)))
            robot = msgspec.structs.replace(robot, legs=(*robot.legs, stranger))
            baseline = None  # one of that name there would be of another leg
        self._learners[leg] = ContactLearner(
            robot,
            leg,
            baseline,
            refitter=self._refitter,
            conventions=self._conventions,
            ids=self._ids,
            when_ambiguous=self._when_ambiguous,
        )
        self._group.finish()
        self._group = LegGroup(tuple(self._learners.values()), on_fault=self._on_fault)
        return self._learners[leg]

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
        events = self.judge(samples)
        self.finish()
        return events

    def judge(self, samples: Mapping[str, ServoSample]) -> list[ContactEvent]:
        """Judge at most one sample per leg; :meth:`finish` does what events need not wait for.

        Args:
            samples: by leg, at most one each.

        Returns:
            The events they decide, in the order of ``samples``.
        """
        for leg, sample in samples.items():
            if leg not in self._learners:
                self.learner(leg, len(sample.measured))
        events = self._group.judge([samples.get(leg) for leg in self._learners])
        if not any(events):  # as in nearly every tick
            return []
        decided = dict(zip(self._learners, events, strict=True))
        return [event for leg in samples if (event := decided.get(leg)) is not None]

    def finish(self) -> None:
        """Learn from what was judged; statuses and states are whole after it."""
        self._group.finish()
        self._conventions.look()
        self._ids.look()
