"""Composes the learner of one leg: samples in, contact events out.

Two values pass between detection and learning, and :class:`ContactLearner` passes them: labelled
swings (:class:`LabelledSwing`) to the adapter, and what is known of free motion
(:class:`~adaptive_contact.model.free_motion.FreeMotion`) back to the tick.  A tick calls
:meth:`~ContactLearner.admit_sample`, then the compiled part, then
:meth:`~ContactLearner.event_of` where there is an event, and later
:meth:`~ContactLearner.learn_from_tick`, which learns.  A
:class:`~adaptive_contact.core.bank.LegGroup` does so for several learners at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.checks.conventions.judge import ConventionFinding
from adaptive_contact.checks.limits import Limits
from adaptive_contact.checks.watch import Watch, watch_angles
from adaptive_contact.core.detect.history import MAX_STEP_RAD_S
from adaptive_contact.core.detect.layout import (
    BEGAN,
    DECIDED,
    RATE_OFF,
    RELEASE_PENDING,
    RESOLVED,
    RESTARTED,
    SOURCE,
    TOPPED,
    TOUCHED,
    TURNED,
    WEIGHED,
)
from adaptive_contact.core.detect.leg_batch import LegBatch, LegPlace
from adaptive_contact.core.detect.standing import Standing
from adaptive_contact.core.detect.stream import NEXT, Accepted, StreamGuard
from adaptive_contact.core.detect.swing_judge import SwingJudge
from adaptive_contact.core.detect.swing_labels import SwingLabels
from adaptive_contact.core.learn.adapter import Adapter
from adaptive_contact.core.learn.lifecycle import Lifecycle
from adaptive_contact.core.learn.mode import LearnerMode, WhenAmbiguous
from adaptive_contact.core.leg_report import LegReport
from adaptive_contact.fit.refit_job import InlineRefitter, Refitter
from adaptive_contact.model.glr import statistic
from adaptive_contact.model.labelled_swing import LabelledSwing
from adaptive_contact.model.leg_model import LegModel, report_of
from adaptive_contact.model.library import ChangeLibrary
from adaptive_contact.model.model_file import Baseline
from adaptive_contact.model.noise import DESCENT, SPEEDS
from adaptive_contact.robot import AngleFrame, Leg, Robot
from adaptive_contact.wire import (
    ContactEvent,
    LearnerStatus,
    LegState,
    ModelReport,
    Reject,
    ServoSample,
)

if TYPE_CHECKING:  # imports the fits
    from adaptive_contact.checks.leg_ids import Owner

# Confirmed rows learned per tick, at most (a valid leg learns one): a swing's dozen are spread over
# the stance that follows.
ROWS_PER_TICK: Final = 3
# Flags of a tick that make an event; few ticks have one.
EVENTS: Final = DECIDED | RELEASE_PENDING
# Flags that change nothing of what the next tick is judged by.
WAITING: Final = EVENTS | WEIGHED | TURNED


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


class JudgedTick(NamedTuple):
    """Holds how a tick was judged: as in a swing, before leverage."""

    residual: NDArray[np.float64]  # (J,) rad
    # (windows,) statistic over threshold, NaN where it reaches too far back
    scores: NDArray[np.float64]
    thresholds: NDArray[np.float64]  # (windows,) of the statistic, for the baseline's variance


class ContactLearner:
    """Learns one leg, and reports its contacts.

    Args:
        robot: the robot's description.
        leg: id of the leg.
        baseline: what is known of its free motion; without one it begins with what is known of any
            leg, and says ``learning``.
        mode: how it follows changes of the leg.
        refitter: does the sparse refits; in line where absent.
        conventions: watches whether the robot's angles are counted as described, together with its
            other legs; the leg by itself where absent.
        ids: watches whether the samples are this leg's, together with the other legs.
        standing: decides by all legs whether the robot stands; the leg's own load alone where
            absent.
        when_ambiguous: whether contacts are reported while the leg is ambiguous.

    Attributes:
        place: the leg's arrays.
        lifecycle: which model the leg has, and what follows it.
        report: what is said of it.
        answer: how the last sample connects to the stream, or why it was refused.

    Raises:
        ConfigurationError: the robot has no such leg.
        BaselineError: the baseline belongs to another robot.
    """

    def __init__(
        self,
        robot: Robot,
        leg: str,
        baseline: Baseline | None = None,
        *,
        mode: LearnerMode = LearnerMode.FULL,
        refitter: Refitter | None = None,
        conventions: Watch[ConventionFinding] | None = None,
        ids: Watch[Owner] | None = None,
        standing: Standing | None = None,
        when_ambiguous: WhenAmbiguous = WhenAmbiguous.WITHHOLD,
    ) -> None:
        if baseline is not None:
            baseline.check_fits(robot)
        self.robot = robot
        self.leg: Leg = robot.leg(leg)
        frame = AngleFrame(self.leg)
        self._frame = None if frame.same else frame
        self.lifecycle = Lifecycle(robot, self.leg, baseline, mode, refitter or InlineRefitter())
        self.place = LegPlace(self._batch())
        self._guard = StreamGuard(len(self.leg.joints))
        self._conventions = watch_angles(robot) if conventions is None else conventions
        self._track = self._conventions.track(self.leg, self.place)
        self._ids = None if ids is None else ids.track(self.leg, self.place)
        self._standing = standing
        if standing is not None:
            standing.track(self.place)
        self._misread = False  # the leg's angles are not counted as described
        self._faulty = False  # samples say nothing of the leg
        self._contested = False  # two publishers take turns
        self.answer: Accepted | Reject = NEXT  # to the last sample
        self._sample: ServoSample | None = None  # the last that was accepted
        self._swing = SwingJudge(self.leg, self.place)
        self._labels = SwingLabels(self.place, self._swing)
        self.report = LegReport(
            self.leg, self.place, self.lifecycle, self._guard, self._swing, self._labels,
            self._track, self._ids, WhenAmbiguous(when_ambiguous),
        )  # fmt: skip
        self._assessed = False  # this tick's lift or begin was assessed before its event
        self._begun = 0  # `Lifecycle.begun` of the adapter that the arrays are of
        self._begin()

    # -- public --------------------------------------------------------------------------------

    def update(self, sample: ServoSample) -> ContactEvent | None:
        """Take in the next sample of the wire.

        Args:
            sample: any sample; a bad one is counted in :attr:`status` and changes nothing.

        Returns:
            The change of contact that this sample decides, if it does.

        Raises:
            TypeError: it is no sample, such as the map of a payload.
        """
        check_sample(sample)
        place = self.place
        if len(place.batch.legs) > 1:  # of a group, whose other legs wait
            place.move(self._batch(), 0)
        if place.leg.unfinished:  # what it learned from raised
            self._end_tick()
        event = None
        place.leg.accepted = False
        if self.admit_sample(sample):
            flags = place.batch.evaluate_tick()
            if flags & EVENTS:
                event = self.event_of(flags)
            self._end_tick()
        self._conventions.poll()
        return event

    def reset_after_fault(self, fault: Exception) -> None:
        """Restore what was last saved of the leg after a fault in its learning, and report it."""
        self.report.counters.fault(fault)
        self.place.drop_tick()
        self._assessed = False
        self.lifecycle.restore_last_good()
        self._forget_swings()
        self.report.source.reset()
        self._begin()

    def count(self, reason: Reject, times: int = 1) -> None:
        """Count payloads that were refused before they became samples."""
        self.report.counters.rejects[reason] += times

    def request_release(self) -> None:
        """Request a release: another process may have reported that the leg touches."""
        self.place.leg.release_pending = True

    def withdraw(self) -> ContactEvent | None:
        """Withdraw the contact of a leg whose samples have stopped.

        Returns:
            The event that says so, of the last sample; None before the first.
        """
        sample = self._sample
        if sample is None:
            return None
        return msgspec.structs.replace(
            self._release(sample), status="silent", withheld=True, p=None
        )

    @property
    def last_sample(self) -> ServoSample | None:
        """Return the last accepted sample, in the description's angles."""
        return self._sample

    @property
    def older_runs(self) -> tuple[int | None, ...]:
        """Return the runs of superseded publishers, the oldest first."""
        return self._guard.older_runs

    @property
    def contact(self) -> bool:
        """Return whether the leg touches, by its last event."""
        return bool(self.place.leg.reported)

    @property
    def model(self) -> LegModel | None:
        """Return the model in force, or None while there is none."""
        return None if self._adapter is None else self._adapter.model

    def judged(self) -> JudgedTick | None:
        """Return the last tick's residual and scores; None where it could not be judged."""
        leg, recent = self.place.leg, self.lifecycle.noise_tracker
        usable = leg.usable
        if recent is None or not usable:
            return None
        unit = self.place.batch.unit[self.place.row]
        whiten = recent.whiten[leg.context] / np.sqrt(unit)
        found = statistic(self.place.residuals, self.place.increments, whiten, np.array(usable))
        thresholds = recent.thresholds[leg.context // SPEEDS]
        residual = self.place.residuals[0].copy()
        return JudgedTick(residual, found.value / thresholds, thresholds * float(unit.mean()))

    def drain_confirmed(self) -> list[int]:
        """Return the times of the ticks confirmed as free since the last call, ns."""
        if self._adapter is None:
            return []
        times = list(self._adapter.confirmed_ns)
        self._adapter.confirmed_ns.clear()
        return times

    @property
    def state(self) -> LegState:
        """Return whether the leg touches in its newest tick, stance included, and how probably."""
        return self.report.state

    @property
    def status(self) -> LearnerStatus:
        """Return the learner's status, as it is published."""
        return self.report.status

    @property
    def model_report(self) -> ModelReport | None:
        """Return the model in terms and equations, or None while there is none."""
        adapter, recent = self._adapter, self.lifecycle.noise_tracker
        if adapter is None or recent is None:
            return None
        threshold = float(recent.thresholds[DESCENT, 0])
        return report_of(self.leg, adapter.model, threshold, self.lifecycle.origin)

    def snapshot(self) -> dict[str, Any]:
        """Return what has been learned and counted, as a tree that msgpack can write."""
        self.report.collect_counts()
        limits = [of.tolist() for of in self.report.source.limits]
        stream = {
            "missed": self._guard.missed, "stream": self._guard.snapshot(), "limits": limits,
        }  # fmt: skip
        return {**self.lifecycle.snapshot(), **self.report.counters.snapshot(), **stream}

    def restore(self, saved: dict[str, Any]) -> str | None:
        """Take over a snapshot, whole or not at all.

        Returns:
            None when it is in force, else one line that says why it is not.
        """
        refused = self.lifecycle.restore(saved)
        if refused is not None:
            if self._begun != self.lifecycle.begun:  # what was refused has ended the model before
                self._begin()
            return refused
        self._begin()
        self.report.counters.restore(saved)
        self._guard.restore(saved.get("stream"), saved.get("missed"))
        limits = Limits.saved(saved.get("limits"), len(self.leg.joints))
        if limits is not None:
            self.report.source.set_limits(limits)
        return None

    # -- one tick, in the order of its calls ----------------------------------------------------

    def admit_sample(self, sample: ServoSample) -> bool:
        """Write a sample into the arrays of the next tick; False if it is refused."""
        if self._frame is not None:
            sample = self._frame.sample(sample)
        result = self.answer = self._guard.admit(sample)
        if self._guard.contested is not self._contested:
            self._contested = self._guard.contested
            self.report.publish_withholding()
        if result is not NEXT and isinstance(result, Reject):
            self.count(result)
            return False
        self._sample = sample
        track = self._track
        if track is not None and (self._misread or track.finding is not None):
            self._update_misread(grave=track.finding is not None and track.finding.grave)
        self.place.set_sample(sample, result.missed, result.restart)
        return True

    def event_of(self, flags: int) -> ContactEvent | None:
        """Make the event of a judged tick, if there is one."""
        leg, sample, event = self.place.leg, self._sample, None
        assert sample is not None
        if flags & (BEGAN | TOPPED):
            # A swing that begins, or a lift whose top is past, changes the status of the event.
            self._assess(flags)
            self.report.read_status()
        if flags & RELEASE_PENDING:
            event = self._release(sample)
        if flags & DECIDED:
            contact = leg.contact
            if contact or leg.reported:  # else the end of one that was withheld
                event = self.report.event(
                    sample, contact=contact, onset_ns=leg.onset_ns,
                    score=leg.score, residual=self.place.residuals[0].tolist(),
                )  # fmt: skip
        return event

    def learn_from_tick(self, flags: int) -> bool:
        """Pass the tick's labelled swings to the learning, and publish the new free motion.

        Returns:
            Whether another model is to be put in force (:meth:`adopt_model`).
        """
        lifecycle = self.lifecycle
        adapter = lifecycle.adapter
        # In most ticks a row was entered that only waits for its swing: nothing to assess.  While
        # the monitor watches a suspected lift, each tick may change the variance scale.
        assessed = flags & ~WAITING or (
            flags & WEIGHED and (adapter is None or adapter.monitor.watches)
        )
        if assessed:
            self._hand_over(flags)
            self._assessed = False
            if flags & SOURCE:
                self._faulty = self.report.source.cause is not None
        if flags & BEGAN and self._standing is not None:
            self._standing.end_stance()
        if flags & (BEGAN | TURNED | RESTARTED):
            predicted = None if adapter is None else adapter.monitor.predicts
            if self.report.source.check_source(flags, predicted=predicted):
                lifecycle.start()
                self._forget_swings()
                return True
        if self._misread or self._faulty or adapter is None or not adapter.learning:
            if assessed:
                self.report.read_status()
            return False
        moved = adapter.tick(ROWS_PER_TICK)
        if adapter.found is not None:
            lifecycle.adopt_refit(adapter.found)
            return True
        if assessed:
            # Of readings that may be copies, the model would be learned again.
            suspected = self.report.source.check.suspected
            # Taken up behind the tick: its command is then the first of the next model's past.
            if self.place.leg.ticks and not suspected and lifecycle.begin_again():
                self._let_go()
                return True
            self.report.publish_withholding()
        elif not moved:
            return False
        else:
            if adapter.version != self.report.version:
                self.report.read_status()
            if not self.place.leg.ticks:  # a stance is not judged: the swing that begins passes it
                return False
            if not adapter.active.inflated:
                self.place.predict_by(adapter.active.coefficients)
                return False
        self.place.set_free_motion(adapter.free_motion())
        return False

    def adopt_model(self) -> None:
        """Put the model of another adapter in force, from the next tick on."""
        self._begin()

    # -- private -------------------------------------------------------------------------------

    def _release(self, sample: ServoSample) -> ContactEvent:
        """End a contact that no touch or lift has ended."""
        leg = self.place.leg
        leg.release_pending = False
        return self.report.event(
            sample, contact=False, onset_ns=leg.at_ns, score=0.0,
            residual=[0.0] * len(self.leg.joints),
        )  # fmt: skip

    def _end_tick(self) -> None:
        """Finish a tick of this leg by itself: learning, then command and prediction."""
        batch = self.place.batch
        another = self.learn_from_tick(batch.flags[0])
        batch.predict_next_tick()
        if another:
            self.adopt_model()

    def _batch(self) -> LegBatch:
        robot, leg = self.robot, self.leg
        library = self.lifecycle.library
        return LegBatch(
            [leg], library, [robot.quantum(leg.id)], round(robot.period_s * 1e9),
            max_step=MAX_STEP_RAD_S * library.period_s, detector=robot.detector,
        )  # fmt: skip

    def _begin(self) -> None:
        """Begin with the model of the lifecycle: clear the arrays of the past under another."""
        self.report.collect_counts()
        lifecycle, place = self.lifecycle, self.place
        if lifecycle.library != place.batch.library:
            place.move(self._batch(), 0)
            place.drop_rows()  # of the swing: they are of other terms
        place.batch.forget_past(place.row)
        self._begun = lifecycle.begun
        self.report.read_status()
        adapter = lifecycle.adapter
        self._labels.begin(None if adapter is None else adapter.baseline)
        if adapter is None:
            place.end()
            return
        library = adapter.model.library
        assert isinstance(library, ChangeLibrary)
        place.begin(library, lifecycle.sigma, learning=adapter.learning)
        self.report.publish_withholding()
        place.set_free_motion(adapter.free_motion())

    def _hand_over(self, flags: int) -> None:
        """Label what this tick's flags say of the swing, and pass it to the adapter."""
        adapter = self.lifecycle.adapter
        if flags & RESTARTED:
            self._swing.restart()
            if adapter is not None:
                adapter.new_source()
        if not self._assessed:
            self._assess(flags)
        if flags & TOUCHED:
            self._learn(self._labels.alarm())
        if flags & BEGAN:
            self.report.begin_swing()
            if adapter is not None and self.report.source.cause is None:
                adapter.keep(self.place.leg.at_ns)
        if flags & RATE_OFF and adapter is not None:
            adapter.distrust(self.report.source.off_rate_since_ns)
        if flags & SOURCE and self.report.source.cause is not None:
            self._retract()

    def _assess(self, flags: int) -> None:
        """Label the swing that ended, one that begins, or a lift past its top; once per tick."""
        if flags & RESOLVED:
            self._learn(self._labels.resolve())
        self._learn(self._labels.assess(flags))
        self._assessed = True

    def _learn(self, parts: Sequence[LabelledSwing]) -> None:
        """Pass labelled parts of a swing to the adapter."""
        adapter = self.lifecycle.adapter
        if adapter is not None:
            for part in parts:
                adapter.learn(part)

    def _update_misread(self, *, grave: bool) -> None:
        """Stop judging a leg whose angles are not counted as described, or go on."""
        if grave and not self._misread:
            self._let_go()
        self._misread = grave
        self.place.leg.misread = self._misread

    def _let_go(self) -> None:
        """Reset the contact state to unknown."""
        leg = self.place.leg
        leg.release_pending |= leg.reported
        leg.contact, leg.loaded, leg.calm = False, True, 0

    def _forget_swings(self) -> None:
        """Forget the swings so far, and whether the leg carries."""
        self._let_go()
        self.place.restart_swing()
        self._swing.restart()

    def _retract(self) -> None:
        """Retract what was learned from a faulty source."""
        if self._adapter is not None:
            self._adapter.retract(self.report.source.since_ns)

    @property
    def _adapter(self) -> Adapter | None:
        return self.lifecycle.adapter
