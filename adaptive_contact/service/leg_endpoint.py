"""Keeps one leg's place in the service: samples in use, publishers, token, silence.

A leg is ``silent`` when no usable sample came for half a second, or none in which a servo answered;
that is the service's word, not the learner's, for a learner that gets no samples knows of no time
passing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec
import structlog

from adaptive_contact.core.detect.stream import CONFIRM_SAMPLES, LONGEST_GAP, SHORT_GAP
from adaptive_contact.service.link import Declared, Link
from adaptive_contact.service.logs import LogThrottle
from adaptive_contact.service.settings import SILENT_AFTER_S, leg_token
from adaptive_contact.service.state.format import Position
from adaptive_contact.wire import (
    ContactEvent,
    LearnerStatus,
    LegHeartbeat,
    ModelReport,
    Reject,
    Rejected,
    ServoSample,
    Status,
    contact_key,
    learner_key,
    state_key,
)

if TYPE_CHECKING:
    from adaptive_contact.core.leg_learner import ContactLearner

T = TypeVar("T")

_log = structlog.get_logger()


class Downtime:
    """Counts the samples of a leg that passed while the service was down.

    Args:
        before: where the leg's source was when the service was last here.
    """

    def __init__(self, before: Position | None = None) -> None:
        self.missed = 0 if before is None else before.missed_down
        # None once it is known how many samples passed meanwhile.
        self.before = before
        self._first_seq = self._in_order = 0  # number of the stream's first sample, its samples

    def update(self, sample: ServoSample, *, restart: bool) -> None:
        """Update by an accepted sample; a long gap counts once a stream confirms it."""
        before = self.before
        if before is None:
            return
        if sample.run != before.run:  # another start of the source: no number shows losses
            self.before = None
            return
        if restart:
            self._first_seq, self._in_order = sample.seq, 0
        self._in_order += 1
        gap = self._first_seq - before.seq - 1
        if gap <= SHORT_GAP or self._in_order >= CONFIRM_SAMPLES:
            self.missed += gap if 0 < gap < LONGEST_GAP else 0
            self.before = None

    def position(self, learner: ContactLearner) -> Position | None:
        """Return where the leg's source is, by the last sample that was used."""
        last = learner.last_sample
        if last is None or self.before is not None:
            return self.before
        return Position(last.run, last.seq, self.missed, learner.older_runs)


class JointAvailability:
    """Follows ``valid`` of one leg's samples."""

    def __init__(self, joints: int) -> None:
        self._joints = joints
        self._mute_since_ns: dict[int, int] = {}  # by number of the joint, from 1

    def update(self, valid: list[bool] | None, now_ns: int) -> bool:
        """Update from the validity of a sample's readings, (J,); return whether any is valid."""
        mute = [joint for joint, good in enumerate(valid or (), start=1) if not good]
        self._mute_since_ns = {joint: self._mute_since_ns.get(joint, now_ns) for joint in mute}
        return len(mute) < self._joints

    def note(self, now_ns: int) -> str | None:
        """Describe in one line the joints that have not answered for half a second; else None."""
        mute = {
            joint: (now_ns - since_ns) / 1e9
            for joint, since_ns in self._mute_since_ns.items()
            if now_ns - since_ns > 500_000_000
        }
        if not mute:
            return None
        for_s = f"{min(mute.values()):.1f} s"
        if len(mute) == self._joints:
            return f"no servo has answered for {for_s}"
        which = ", ".join(map(str, mute))
        joints = f"joint {which} has" if len(mute) == 1 else f"joints {which} have"
        return f"{joints} not answered for {for_s}: judged by the others"


_SILENT_AFTER_NS: Final = int(SILENT_AFTER_S * 1e9)
_STATUS_PERIOD_NS: Final = int(1.0 * 1e9)


class LegEndpoint:
    """Connects one leg's learner to the link; all calls come from the worker."""

    def __init__(
        self,
        link: Link,
        leg: str,
        learner: ContactLearner,
        joints: int,
        now_ns: int,
        resumes: Position | None = None,
    ) -> None:
        self.leg = leg
        self.learner = learner
        self._reported = learner.status  # as of the last look; changes since are reported
        self.model_version = self._reported.model_version  # as the last look found it
        self.received_samples = 0  # readable samples so far, used or not
        self._downtime = Downtime(resumes)
        self._answers = JointAvailability(joints)
        self._link = link
        self.contact = link.publisher(contact_key(leg), reliable=True, history=1)
        self._status = link.publisher(learner_key(leg))
        self.state = link.publisher(state_key(leg))
        self._token: Declared | None = None
        self._withdrawn = False  # its contact, as it is silent
        self._since_ns = now_ns
        self._seen_ns: int | None = None  # when a sample came that was used and had a reading
        self._seen_t_ns = 0  # its time
        self._used_ns = now_ns  # when a sample came that was used
        self._unused: Reject | None = None
        self._unused_ns = 0
        self._refused: Rejected | None = None
        self._refused_ns = 0
        self._published: Status | None = None
        self._published_ns = now_ns
        self._throttle = LogThrottle()
        self._faults = LogThrottle(60.0)

    def count_sample(self, sample: ServoSample, now_ns: int) -> Reject | None:
        """Count a readable sample that the learner has just been given.

        Returns:
            Why it has refused it; None if it has used it.
        """
        self.received_samples += 1
        answer = self.learner.answer
        if isinstance(answer, Reject):
            self._unused, self._unused_ns = answer, now_ns
            return answer
        self._downtime.update(sample, restart=answer.restart)
        self._used_ns = now_ns
        if not self._answers.update(sample.valid, now_ns):
            return None
        self._seen_ns, self._seen_t_ns = now_ns, sample.t_ns
        if self._token is None:
            self._token = self._link.token(leg_token(self.leg))
        return None

    @property
    def position(self) -> Position | None:
        """Return where the source is, by the last sample that was used; None before the first."""
        return self._downtime.position(self.learner)

    def refused(self, why: Rejected, now_ns: int) -> None:
        """Count a payload that could not be read."""
        self.learner.count(why.reason)
        self._refused = why
        self._refused_ns = now_ns

    def silent(self, now_ns: int) -> bool:
        """Return whether no usable sample, or no servo's answer, has come for too long."""
        return self._seen_ns is None or now_ns - self._seen_ns > _SILENT_AFTER_NS

    def heartbeat(self, now_ns: int) -> LegHeartbeat | None:
        """Return time, age and contact of the leg's newest sample; None before the first."""
        if self._seen_ns is None:
            return None
        return LegHeartbeat(
            t_ns=self._seen_t_ns,
            age_s=(now_ns - self._seen_ns) / 1e9,
            contact=self.learner.contact,
        )

    def withdraw(self, now_ns: int, *, ending: bool = False) -> ContactEvent | None:
        """Return the event of a leg that has fallen silent since the last call, otherwise None.

        Args:
            now_ns: monotonic.
            ending: the service ends, which is the same for who reads its contacts.
        """
        before, self._withdrawn = self._withdrawn, ending or self.silent(now_ns)
        return self.learner.withdraw() if self._withdrawn and not before else None

    def publish_status(self, now_ns: int, *, anyway: bool = False) -> Status | None:
        """Send the status if a second has passed, it has changed, or it is wanted anyway.

        Returns:
            The new status where it has changed, otherwise None.
        """
        status = self.status(now_ns)
        self._report_news(self._reported, status, now_ns)
        self._reported = status
        self.model_version = status.model_version
        changed = status.status != self._published
        due = changed or now_ns - self._published_ns >= _STATUS_PERIOD_NS
        if self._downtime.before is not None:
            # The first samples show what passed while the service was down: until then, counts
            # would not add up.  Only a leg without any is reported.
            due = self.silent(now_ns) and now_ns - self._published_ns >= _STATUS_PERIOD_NS
        if not (due or anyway):
            return None
        self._status.put(status)
        if self._token is not None and status.status == "silent":
            self._token.close()
            self._token = None
        self._published = status.status
        self._published_ns = now_ns
        return status.status if changed else None

    def status(self, now_ns: int) -> LearnerStatus:
        """Return the learner's status, with silence and refused payloads added."""
        status = self._call_learner(lambda: self.learner.status)
        missed_down = self._downtime.missed
        if missed_down:
            status = msgspec.structs.replace(status, missed=status.missed + missed_down)
        notes = [] if status.note is None else [status.note]
        if self._refused is not None and now_ns - self._refused_ns < 5_000_000_000:
            why = ": ".join(filter(None, (self._refused.reason, self._refused.detail.strip(" :"))))
            notes.insert(0, f"payload refused: {why}")
        quiet = self.silent(now_ns)
        gone = now_ns - self._used_ns > _SILENT_AFTER_NS
        mute = None if gone else self._answers.note(now_ns)
        if quiet:
            notes.insert(0, self._silence(now_ns) if mute is None else mute)
        elif mute is not None:
            notes.insert(0, mute)
        if not quiet and len(notes) == (status.note is not None):
            return status
        return msgspec.structs.replace(
            status, status="silent" if quiet else status.status, note="; ".join(notes)
        )

    def _report_news(self, before: LearnerStatus, now: LearnerStatus, now_ns: int) -> None:
        """Log what became of refits, what the leg changed in, and that the source restarted."""
        for name in ("promoted", "refused", "rolled_back"):
            if getattr(now.refits, name) > getattr(before.refits, name):
                # Most are refused, each minute of a leg that has not changed.
                say = _log.debug if name == "refused" else _log.info
                why, version = now.refits.last_reason, now.model_version
                say("refit", leg=self.leg, outcome=name, why=why, model_version=version)
        kind = now.drift.kind
        news = kind is not None and kind != before.drift.kind
        if news and self._throttle.passes(("kind", kind), now_ns) is not None:
            _log.info("leg changed", leg=self.leg, kind=kind, level=round(now.drift.level, 2))
        restarts = now.restarts - before.restarts
        stands_for = self._throttle.passes("restart", now_ns, restarts) if restarts > 0 else None
        if stands_for is not None:
            _log.info("source restarted", leg=self.leg, times=stands_for)

    def report(self) -> ModelReport | None:
        """Return the leg's model; None before there is one."""
        return self._call_learner(lambda: self.learner.model_report)

    def _call_learner(self, question: Callable[[], T]) -> T:
        """Call the learner; one that raises is reset, and called again."""
        try:
            return question()
        except Exception as fault:  # of one leg, which must not end the others' service
            self.learner.reset_after_fault(fault)
            self._faults.fault(self.leg, fault)
            return question()

    def _silence(self, now_ns: int) -> str:
        """Describe why a leg is silent: it sends no samples, or only refused ones."""
        seen = self._seen_ns
        since_s = (now_ns - (self._since_ns if seen is None else seen)) / 1e9
        how_long = f"{'yet, after' if seen is None else 'for'} {since_s:.1f} s"
        if self._downtime.before is not None:
            how_long += ", and `missed` lacks what passed while the service was down"
        if self._unused is None or now_ns - self._unused_ns > _SILENT_AFTER_NS:
            return f"no sample {how_long}"
        return f"no usable sample {how_long}: {self._unused}"
