"""The learner of one leg: samples in, contact events out.

:class:`ContactLearner` composes the stream guard, the phase, the window, the statistic and the
state machine; a :class:`~adaptive_contact.adapt.team.Team` takes several one tick further, so that
six cost little more than one.  Recursive updates and refits come after the event.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np

from adaptive_contact.adapt.baseline import Baseline
from adaptive_contact.adapt.conventions import ConventionWatch
from adaptive_contact.adapt.detector import LegDetector, Verdict
from adaptive_contact.adapt.follower import Follower
from adaptive_contact.adapt.knowledge import Knowledge
from adaptive_contact.adapt.legids import IdWatch
from adaptive_contact.adapt.mode import LearnerMode, WhenAmbiguous
from adaptive_contact.adapt.monitor import UNFIT_LEVEL
from adaptive_contact.adapt.quarantine import Quarantine
from adaptive_contact.adapt.refit import InlineRefitter, Refitter
from adaptive_contact.adapt.report import report_of
from adaptive_contact.adapt.sources import SourceWatch
from adaptive_contact.adapt.stream import Accepted, RateWatch, Seams, StreamGuard
from adaptive_contact.adapt.swing import Landings, SwingWatch
from adaptive_contact.adapt.tally import Tally
from adaptive_contact.adapt.team import Team, check_sample
from adaptive_contact.adapt.tracker import UNSURE_TICKS, Tracker
from adaptive_contact.detect import ContactState, Decision
from adaptive_contact.identify import LegModel
from adaptive_contact.robot import AngleFrame, Leg, Robot
from adaptive_contact.wire import (
    BufferCounts,
    ContactEvent,
    Doubt,
    DriftLevel,
    LearnerStatus,
    ModelReport,
    RefitCounts,
    Reject,
    ServoSample,
    Status,
)

__all__ = ["ContactLearner"]

# Confirmed rows learned per tick: a swing's dozen are spread over the stance that follows.
ROWS_PER_TICK: Final = 3


class ContactLearner:
    """Learns one leg, and reports its contacts.

    Args:
        robot: the robot's description.
        leg: id of the leg.
        baseline: what is known of its free motion; without one the learner says ``learning``.
        mode: how it follows changes of the leg.
        refitter: does the sparse refits; in line where absent.
        conventions: watches whether the robot's angles are counted as described, together with its
            other legs; the leg by itself where absent.
        ids: watches whether the samples are this leg's, together with the other legs.
        when_ambiguous: whether contacts are reported while the leg is ambiguous.

    Attributes:
        frame: turns the wire's angles into the description's; None where they are the same.
        owes_release: whoever listens may hold the leg to touch, and no tick will decide that it
            has let go; to be told with the next sample.

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
        conventions: ConventionWatch | None = None,
        ids: IdWatch | None = None,
        when_ambiguous: WhenAmbiguous = WhenAmbiguous.WITHHOLD,
    ) -> None:
        if baseline is not None:
            baseline.check_fits(robot)
        self.robot = robot
        self.leg: Leg = robot.leg(leg)
        frame = AngleFrame(self.leg)
        self.frame = None if frame.same else frame
        self._knowledge = Knowledge(robot, self.leg, baseline, mode, refitter or InlineRefitter())
        self._guard = StreamGuard(len(self.leg.joints))
        self._seams = Seams()
        self._swing = SwingWatch(self.leg)
        self._landings = Landings()
        self._state = ContactState()
        self._reported = False  # the state by the last event; differs while one is withheld
        self._when_ambiguous = WhenAmbiguous(when_ambiguous)
        self.owes_release = False
        self._tally = Tally(len(self.leg.joints))
        self._t_ns = 0
        self._command = self._command_before = [0.0] * len(self.leg.joints)  # in force, and before
        self._period_ns = round(robot.period_s * 1e9)
        self._rate = RateWatch(self._period_ns)
        self._unsure = (0.0, 0)  # share of a period, and for how many ticks
        self._alone: Team | None = None
        self._conventions = ConventionWatch(robot) if conventions is None else conventions
        self._track = self._conventions.track(self.leg)
        self._ids = None if ids is None else ids.track(self.leg)
        self._misread = False  # the leg's angles are not counted as described
        self._source = SourceWatch(self.leg, robot.quantum(leg))
        # The last swings: when they began, ns, and how many samples had been accepted.
        self._swings_began = deque([(0, 0)], maxlen=2)
        self._quarantine = Quarantine(self._swing, self._knowledge)

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
        if self._alone is None:
            self._alone = Team([self])
        event = self._alone.advance([sample])[0]
        self._conventions.look()
        return event

    def begin_anew(self, fault: Exception) -> None:
        """After a fault in its learning: go back to what was last saved of it, and say so."""
        self._tally.fault(fault)
        self._knowledge.fall_back()
        self._let_go()
        self._swing.restart()
        self._quarantine.restart()

    def count(self, reason: Reject, times: int = 1) -> None:
        """Count payloads that were refused before they became samples."""
        self._tally.rejects[reason] += times

    def owe_release(self) -> None:
        """Whoever listens may have heard from another process that the leg touches."""
        self.owes_release = True

    @property
    def contact(self) -> bool:
        """Whether the leg touches, by its last event."""
        return self._reported

    @property
    def detector(self) -> LegDetector | None:
        """Judges its ticks; None while there is no model."""
        return self._knowledge.detector

    @property
    def model(self) -> LegModel | None:
        """The model in force, or None while there is none."""
        return None if self._follower is None else self._follower.model

    @property
    def tracker(self) -> Tracker | None:
        """The leg's recent past, or None while there is no model."""
        detector = self._knowledge.detector
        return None if detector is None else detector.tracker

    def drain_confirmed(self) -> list[int]:
        """Times of the ticks confirmed as free since the last call, ns."""
        if self._follower is None:
            return []
        times = list(self._follower.confirmed_ns)
        self._follower.confirmed_ns.clear()
        return times

    @property
    def status(self) -> LearnerStatus:
        """How the learner is."""
        follower = self._follower
        return LearnerStatus(
            leg=self.leg.id,
            t_ns=self._t_ns,
            status=self._status,
            model_version=self._version,
            residual_rms=self._tally.residual_rms,
            noise_floor=self._knowledge.noise_floor,
            buffer=BufferCounts() if follower is None else follower.buffer.counts,
            drift=DriftLevel() if follower is None else follower.monitor.drift,
            refits=RefitCounts() if follower is None else follower.refits,
            ticks=self._tally.counts["ticks"],
            rejects={str(reason): n for reason, n in sorted(self._tally.rejects.items())},
            missed=self._guard.missed,
            restarts=self._guard.restarts,
            contact=self._reported,
            contacts=self._tally.counts["contacts"],
            withheld=self._tally.counts["withheld"],
            doubt=self._doubt,
            jitter_ms=self._rate.jitter * self._period_ns / 1e6,
            untouched=self._landings.untouched,
            untouched_ns=self._landings.untouched_ns,
            note=self._ailment(),
        )

    @property
    def model_report(self) -> ModelReport | None:
        """The model in terms and equations, or None while there is none."""
        follower, detector = self._follower, self.detector
        if follower is None or detector is None:
            return None
        threshold = float(detector.thresholds[0])
        return report_of(self.leg, follower.model, threshold, self._knowledge.origin)

    def snapshot(self) -> dict[str, Any]:
        """What has been learned and counted, as a tree that msgpack can write."""
        stream = {"missed": self._guard.missed, "stream": self._guard.snapshot()}
        return {**self._knowledge.snapshot(), **self._tally.snapshot(), **stream}

    def restore(self, saved: dict[str, Any]) -> str | None:
        """Take over a snapshot, whole or not at all.

        Returns:
            None when it is in force, else one line that says why it is not.
        """
        refused = self._knowledge.restore(saved)
        if refused is not None:
            return refused
        self._tally.restore(saved)
        if isinstance(saved.get("missed"), int):
            self._guard.missed = saved["missed"]
        self._guard.restore(saved.get("stream"))
        return None

    # -- one tick, in the order `Team` calls it -------------------------------------------------

    def admit(self, sample: ServoSample) -> ServoSample | None:
        """Check a sample; as it is to be judged and learned from, or None."""
        result = self._guard.admit(sample)
        if isinstance(result, Reject):
            self.count(result)
            return None
        sample = self._seams.unwrap(sample, restart=result.restart)
        self._tally.counts["ticks"] += 1
        self._t_ns = sample.t_ns
        rate = self._rate
        missed = rate.follow(sample.t_ns, sample.seq, restart=result.restart)
        if self.tracker is not None:
            self.tracker.lateness = rate.lateness if rate.late else 0.0
        broken = result.restart or missed != 0
        if broken:
            self._connect(result, sample, missed)
            self._source.connect(restart=result.restart)
        self._source.follow(sample)
        self._follow_phase(sample)
        if self._source.look(sample, self._swing.ticks):
            self._follow_source()
        if self._ids is not None:
            if result.restart:
                self._ids.restart()
            self._ids.take(sample)
        if self._track is not None:
            self._follow_convention(sample, restart=result.restart)
        if self._reported and self._withholds:
            self.owes_release = True
        if self._void:
            return sample
        if self._knowledge.cold is not None:
            swing = self._swing.ticks > 0
            off = rate.told_by - 1 if rate.off else 0
            self._knowledge.collect(sample, swing=swing, broken=broken, off=off)
        return sample

    def released(self, sample: ServoSample) -> ContactEvent:
        """The end of a contact that was cut short by a restart, told with the next sample."""
        self.owes_release = False
        cut_short = Decision(contact=False, onset_ns=self._rate.at_ns, score=0.0)
        return self._event(cut_short, sample, [0.0] * len(self.leg.joints))

    def watch(self, sample: ServoSample) -> None:
        """A tick of a leg without a model: its commands are followed, a cold start goes on."""
        self.command(sample)
        self.learn()

    def observe(self, sample: ServoSample) -> bool:
        """The tracker has taken the reading in; True if its residual can be judged."""
        detector = self.detector
        assert detector is not None
        tracker = detector.tracker
        judged = tracker.judge()
        if tracker.refused:
            self.count(Reject.IMPLAUSIBLE, tracker.refused)
            tracker.refused = 0
        self._swing.observe(tracker.measured[0].tolist())  # as repaired: -π is no place of a foot
        if self._rate.off:  # the model speaks of ticks of another length
            tracker.restart()
            self._quarantine.break_off()
            if self._follower is not None:
                self._follower.distrust(self._rate.since_ns)
            return False
        if self._void:
            self._quarantine.break_off()
            return False
        if not judged:
            self._quarantine.hole()
            return False
        if self._swing.ticks < 2:
            return False
        # The commands that caused this tick's motion are those before `sample.desired`.
        detector.place(self._command, self._command_before, self._swing.direction)
        if self._swing.after:
            detector.await_touch(self._swing.height_gradient)
        if self._follower is not None and tracker.theta is not None:
            detector.unit = self._follower.variance(tracker.theta) * tracker.inflation
            if self._unsure[1] or self._rate.stretch:
                self._allow_for_clock(detector)
        return True

    def decide(self, verdict: Verdict, sample: ServoSample) -> ContactEvent | None:
        """Turn the statistic of a tick that can be judged into an event, or into none."""
        detector = self.detector
        assert detector is not None
        tracker = detector.tracker
        loaded = self._state.loaded
        now_ns = self._rate.at_ns
        score, onset_ns = verdict.score, now_ns
        after = self._swing.after
        if after:
            follower = self._follower
            sure = follower is not None and follower.status == "valid" and not follower.changed
            self._landings.look(score, sure=sure and not tracker.substituted)
        if score > 1.0 and self._quarantine.lift_first:
            score = 1.0
        elif score > 1.0 and not loaded:
            score, width = detector.known_score(verdict)
            onset_ns = detector.onset_ns(now_ns, width)
        decision = self._state.swing_tick(
            score,
            detector.distance(verdict),
            now_ns,
            onset_ns,
            descending=self._quarantine.lift_over,
        )
        if loaded and not self._state.loaded:
            tracker.begin_swing()  # what was loaded must not enter a window of the free leg
        elif not (loaded or self._state.contact or self._swing.after):
            self._tally.free(verdict.residual)
        self._quarantine.enter(
            tracker.thetas[0],
            verdict,
            detector,
            t_ns=now_ns,
            at=sample.desired,
            free=not (loaded or self._state.contact),
            copied=self._source.suspected,
        )
        if decision is None:
            return None
        if decision.contact:
            self._quarantine.alarm(decision.onset_ns, now_ns, self._period_ns, detector)
            self._landings.touched(after - (now_ns - decision.onset_ns) // self._period_ns)
        elif not self._reported:  # the end of one that was withheld
            return None
        return self._event(decision, sample, tracker.residuals[0].tolist())

    def command(self, sample: ServoSample) -> bool:
        """Take in the command written after the reading; True if a prediction is to be made.

        The tracker's window takes it in with those of the other legs.
        """
        self._quarantine.hand_over()  # of this tick, while the tracker still has it
        self._command_before, self._command = self._command, sample.desired
        self._swing.command()
        tracker = self.tracker
        if tracker is None:
            return False
        preview = None if sample.preview is None else np.array(sample.preview)
        ready = tracker.commanded(preview)
        self._tally.preview(lacking=not ready and tracker.full)
        # Between swings nothing is judged; who needs a prediction there asks the tracker.
        return ready and self._swing.ticks > 0

    def learn(self) -> None:
        """The tick's share of learning: rows that wait, and refits that are due."""
        if self._void:
            return
        if self._knowledge.cold is not None:
            self._knowledge.try_cold()
        follower, tracker = self._follower, self.tracker
        if follower is None or tracker is None or not follower.learning:
            return
        follower.tick(ROWS_PER_TICK)
        if self._swing.ticks == 0:  # nothing is predicted, and no lift is heard
            return
        tracker.model = follower.model
        if follower.monitor.unfit:
            self._knowledge.forget()
            self._let_go()

    # -- private -------------------------------------------------------------------------------

    def _connect(self, result: Accepted, sample: ServoSample, missed: int | None) -> None:
        """Bridge what was missed, at least one tick; None where what was before is no past."""
        tracker = self.tracker
        if result.restart:
            self._let_go()
            self._swing.restart()
            self._quarantine.restart()
            self._command = self._command_before = sample.desired
            self._swings_began.clear()
            self._swings_began.append((self._rate.at_ns, self._tally.counts["ticks"]))
            if tracker is not None:
                tracker.restart()
            if self._follower is not None:
                self._follower.new_source()
        elif tracker is not None:
            if missed is not None and missed < tracker.model.library.window.length:
                self._quarantine.hole()
                # While a tick was late, the command before it stayed in force.
                tracker.bridge(np.array(sample.desired if result.missed else self._command), missed)
            else:
                tracker.restart()
                self._quarantine.break_off()
                self._state.begin_swing()  # it may be another one, and the foot on the ground

    def _allow_for_clock(self, detector: LegDetector) -> None:
        """Widen a tick's variance while nobody knows whether it or its stamp is late.

        A reading that was late by a share of a period errs by that share of the movement, and so
        do the velocities of the ticks that look back on it.
        """
        rate, tracker = self._rate, detector.tracker
        if rate.stretch:
            self._unsure = (abs(rate.stretch), UNSURE_TICKS + 1)
        most, left = self._unsure
        self._unsure = (most, left - 1)
        moved = tracker.increments[0]
        in_air = not (self._state.loaded or self._state.contact)
        if rate.stretch and in_air and not self._swing.after:
            residual = tracker.residuals[0]
            if rate.late:  # as the reading came
                residual = residual + (rate.stretch * moved)
            rate.vote(residual.tolist(), moved.tolist(), detector.sigma)
        if rate.late is None:
            detector.unit = detector.unit + np.square(most * moved / detector.sigma)

    def _follow_convention(self, sample: ServoSample, *, restart: bool) -> None:
        """Keep the sample for a judgement of the leg's angles, and follow the last one."""
        assert self._track is not None
        if restart:
            self._track.restart()
        self._track.take(sample)
        if self._track.spoils and not self._misread:
            self._let_go()
        self._misread = self._track.spoils

    def _follow_source(self) -> None:
        """The source has begun to send what says nothing of the leg, or has stopped to."""
        follower, tracker = self._follower, self.tracker
        self._quarantine.break_off()
        if self._source.cause is None:
            if tracker is not None:
                tracker.restart()
            self._state.begin_swing()
            return
        self._let_go()
        # It may have begun in the swing before, too late in it to be found.
        since_ns, ticks = self._swings_began[0]
        if follower is not None:
            follower.retract(since_ns)
        if self._knowledge.cold is not None:
            self._knowledge.cold.drop_newest(self._tally.counts["ticks"] - ticks)

    def _let_go(self) -> None:
        """Forget whether the leg touches: nobody can tell any more."""
        self.owes_release |= self._reported
        self._state.reset()

    def _follow_phase(self, sample: ServoSample) -> None:
        # A foot that has come off the ground and has not touched may do so after the turn.
        in_air = not (self._state.loaded or self._state.contact)
        awaited = in_air and self.detector is not None
        self._swing.follow(sample, awaited, self._quarantine.resolve)
        if self._swing.ticks == 0:
            self._quarantine.resolve()
            self._landings.end(sample.t_ns, expired=self._swing.expired)
        elif self._swing.ticks == 1:
            self._swings_began.append((self._rate.at_ns, self._tally.counts["ticks"]))
            self._quarantine.begin()
            self._state.begin_swing()
            if self.tracker is not None:
                self.tracker.begin_swing()

    def _event(
        self, decision: Decision, sample: ServoSample, residual: list[float]
    ) -> ContactEvent:
        doubt, withheld = self._doubt, self._withholds
        self._reported = decision.contact and not withheld
        if decision.contact:
            self._tally.counts["withheld" if withheld else "contacts"] += 1
        return ContactEvent(
            leg=self.leg.id,
            t_ns=sample.t_ns,
            seq=sample.seq,
            # In the stamps' own time, of which the schedule is a smoothed one.
            onset_ns=sample.t_ns - max(self._rate.at_ns - decision.onset_ns, 0),
            contact=self._reported,
            status=self._status,
            score=decision.score,
            residual=residual,
            model_version=self._version,
            withheld=withheld,
            doubt=doubt,
        )

    @property
    def _withholds(self) -> bool:
        """Whether contacts are not reported, as the leg is ambiguous."""
        if self._void:
            return True
        if self._when_ambiguous is WhenAmbiguous.PUBLISH:
            return False
        doubt = self._doubt
        if doubt is None or self._when_ambiguous is WhenAmbiguous.STRICT:
            return doubt is not None
        # A foot that comes short of its command in lifts that fit the model is slow, not held.
        fits = doubt == "held" and self._quarantine.lift_level <= UNFIT_LEVEL
        return not fits and doubt != "unsettled"

    @property
    def _follower(self) -> Follower | None:
        return self._knowledge.follower

    @property
    def _void(self) -> bool:
        """Whether samples say nothing of the leg: what is high and low, or where it is, is lost."""
        return self._misread or self._source.cause is not None

    @property
    def _status(self) -> Status:
        if self._void:
            return "ambiguous"
        return "learning" if self._follower is None else self._follower.status

    @property
    def _doubt(self) -> Doubt | None:
        """Why the leg is ambiguous; None where it is not."""
        if self._source.cause is not None:
            return self._source.cause
        if self._misread:
            return "angles"
        return None if self._follower is None else self._follower.doubt

    @property
    def _version(self) -> int:
        return 0 if self._follower is None else self._follower.model.version

    @property
    def _convention_note(self) -> str | None:
        """One line for a person when the leg's angles are not counted as described."""
        found = None if self._track is None else self._track.finding
        if found is None:
            return None
        until = "; no contacts are reported until then" if self._misread else ""
        return found.line(self.leg) + until

    def _ailment(self) -> str | None:
        """What stops this leg from being judged, for a person; the gravest."""
        follower = self._follower
        notes = (
            self._tally.fault_note,
            self._guard.note,
            self._rate.note,
            self._source.note,
            None if self._ids is None else self._ids.note,
            self._convention_note,
            self._swing.blind_note,
            self._knowledge.note_now,
            None if follower is None else follower.note,
            self._quarantine.deaf_note,
            self._landings.note,
            self._tally.preview_note,
        )
        return next((note for note in notes if note is not None), None)
