"""One leg's place in the service: its publishers, its token, and when it last spoke.

A leg is ``silent`` when no usable sample came for half a second, or none in which a servo answered;
that is the service's word, not the learner's, for a learner that gets no samples knows of no time
passing.
"""

from __future__ import annotations

from typing import Final

import msgspec
import structlog

from adaptive_contact.service.admission import Admission
from adaptive_contact.service.answers import Answers
from adaptive_contact.service.faults import FaultLog
from adaptive_contact.service.link import Declared, Link
from adaptive_contact.service.meters import Brake
from adaptive_contact.service.outbox import Outbox
from adaptive_contact.service.ports import Learner
from adaptive_contact.service.settings import leg_token
from adaptive_contact.service.state.keeper import Position
from adaptive_contact.wire import (
    ContactEvent,
    LearnerStatus,
    ModelReport,
    Reject,
    Rejected,
    ServoSample,
    Status,
    contact_key,
    learner_key,
)

__all__ = ["SILENT_AFTER_S", "STATUS_PERIOD_S", "Desk"]

_log = structlog.get_logger()

SILENT_AFTER_S: Final = 0.5
STATUS_PERIOD_S: Final = 1.0

_SILENT_AFTER_NS: Final = int(SILENT_AFTER_S * 1e9)
_STATUS_PERIOD_NS: Final = int(STATUS_PERIOD_S * 1e9)
_REFUSAL_SHOWN_NS: Final = 5_000_000_000


class Desk:
    """What the service keeps per leg; all calls from the worker.

    Args:
        link: where to publish.
        leg: its id.
        learner: the leg's.
        joints: how many its samples bring.
        now_ns: monotonic.
        resumes: where the leg's source was when the service was last here.

    Attributes:
        model_version: as the last look found it.
        heard_samples: readable samples so far, used or not.
        position: of the last one that was used.
    """

    def __init__(
        self,
        link: Link,
        leg: str,
        learner: Learner,
        joints: int,
        now_ns: int,
        resumes: Position | None = None,
    ) -> None:
        self.leg = leg
        self.learner = learner
        self._told_of = learner.status  # as of the last look, to tell what is new since
        self.model_version = self._told_of.model_version
        self.heard_samples = 0
        self.position = resumes
        self._admission = Admission(joints, resumes)
        self._answers = Answers(joints)
        self._link = link
        self._contact = link.publisher(contact_key(leg), reliable=True, history=1)
        self._status = link.publisher(learner_key(leg))
        self._token: Declared | None = None
        self._since_ns = now_ns
        self._seen_ns: int | None = None  # when a sample came that was used and told something
        self._used_ns = now_ns  # when a sample came that was used
        self._unused: Reject | None = None
        self._unused_ns = 0
        self._refused: Rejected | None = None
        self._refused_ns = 0
        self._published: Status | None = None
        self._published_ns = now_ns
        self._brake = Brake()
        self._faults = FaultLog()

    def heard(self, sample: ServoSample, now_ns: int) -> Reject | None:
        """Note a readable sample.

        Returns:
            Why the learner will refuse it, and count it; None if it will use it.
        """
        self.heard_samples += 1
        refused = self._admission.judge(sample)
        if refused is not None:
            self._unused, self._unused_ns = refused, now_ns
            return refused
        self.position = self._admission.position
        self._used_ns = now_ns
        if not self._answers.follow(sample.valid, now_ns):
            return None
        self._seen_ns = now_ns
        if self._token is None:
            self._token = self._link.token(leg_token(self.leg))
        return None

    def refused(self, why: Rejected, now_ns: int) -> None:
        """Count a payload that could not be read."""
        self.learner.count(why.reason)
        self._refused = why
        self._refused_ns = now_ns

    @property
    def ever_heard(self) -> bool:
        """Whether any readable sample has come."""
        return self.heard_samples > 0

    def silent(self, now_ns: int) -> bool:
        """Tell whether nothing that could be used, or no servo's answer, has come for too long."""
        return self._seen_ns is None or now_ns - self._seen_ns > _SILENT_AFTER_NS

    def publish_event(self, event: ContactEvent, arrival_ns: int, outbox: Outbox) -> None:
        """Send a change of contact; ``arrival_ns`` is monotonic, of the deciding sample."""
        outbox.post(self._contact, event, arrival_ns)

    def publish_status(self, now_ns: int, *, anyway: bool = False) -> Status | None:
        """Send the status if a second has passed, it has changed, or it is wanted anyway.

        Returns:
            The new status where it has changed, otherwise None.
        """
        status = self.status(now_ns)
        self._tell_news(self._told_of, status, now_ns)
        self._told_of = status
        self.model_version = status.model_version
        # Until it is known what passed while the service was down, counts would not add up.
        changed = status.status != self._published and not self._admission.resuming
        if not (changed or anyway) and now_ns - self._published_ns < _STATUS_PERIOD_NS:
            return None
        self._status.put(status)
        if self._token is not None and status.status == "silent":
            self._token.close()
            self._token = None
        self._published = status.status
        self._published_ns = now_ns
        return status.status if changed else None

    def status(self, now_ns: int) -> LearnerStatus:
        """The learner's status, with what only the service can know put in."""
        status = self._told()
        missed_down = self._admission.missed_down
        if missed_down:
            status = msgspec.structs.replace(status, missed=status.missed + missed_down)
        notes = [] if status.note is None else [status.note]
        if self._refused is not None and now_ns - self._refused_ns < _REFUSAL_SHOWN_NS:
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

    def _tell_news(self, before: LearnerStatus, now: LearnerStatus, now_ns: int) -> None:
        """Log what became of refits, what the leg changed in, and that the source restarted."""
        for name in ("promoted", "refused", "rolled_back"):
            if getattr(now.refits, name) > getattr(before.refits, name):
                # Most are refused, each minute of a leg that has not changed.
                say = _log.debug if name == "refused" else _log.info
                why, version = now.refits.last_reason, now.model_version
                say("refit", leg=self.leg, outcome=name, why=why, model_version=version)
        kind = now.drift.kind
        news = kind is not None and kind != before.drift.kind
        if news and self._brake.passes(("kind", kind), now_ns) is not None:
            _log.info("leg changed", leg=self.leg, kind=kind, level=round(now.drift.level, 2))
        restarts = now.restarts - before.restarts
        stands_for = self._brake.passes("restart", now_ns, restarts) if restarts > 0 else None
        if stands_for is not None:
            _log.info("source restarted", leg=self.leg, times=stands_for)

    def report(self) -> ModelReport | None:
        """The leg's model, None before there is one."""
        try:
            return self.learner.model_report
        except Exception as fault:  # of one leg, which must not end the others' service
            self._restart_leg(fault)
            return self.learner.model_report

    def _told(self) -> LearnerStatus:
        try:
            return self.learner.status
        except Exception as fault:  # of one leg, as in `report`
            self._restart_leg(fault)
            return self.learner.status

    def _restart_leg(self, fault: Exception) -> None:
        self.learner.reset_after_fault(fault)
        self._faults(self.leg, fault)

    def _silence(self, now_ns: int) -> str:
        """One line on a silent leg: samples that are all refused are another fault than none."""
        seen = self._seen_ns
        since = _seconds(now_ns - (self._since_ns if seen is None else seen))
        how_long = f"{'yet, after' if seen is None else 'for'} {since}"
        if self._unused is None or now_ns - self._unused_ns > _SILENT_AFTER_NS:
            return f"no sample {how_long}"
        return f"no usable sample {how_long}: {self._unused}"


def _seconds(duration_ns: int) -> str:
    return f"{duration_ns / 1e9:.1f} s"
