"""Which samples of a leg are used, told one by one, and over a restart of the service.

A learner counts what it refuses; to read that takes a whole status (70 µs), too much for every
sample.  So a guard like the learner's own judges here first (2 µs): given the same samples, and
taken over from the same state, it gives the same answers.
"""

from __future__ import annotations

from adaptive_contact.detect.stream import CONFIRM_SAMPLES, LONGEST_GAP, SHORT_GAP, StreamGuard
from adaptive_contact.service.state.keeper import Position
from adaptive_contact.wire import Reject, ServoSample

__all__ = ["Admission"]


class Admission:
    """Judges the samples of one leg as its learner will.

    Args:
        joints: J, what a sample must bring.
        resumes: where the leg's source was when the service was last here.

    Attributes:
        position: of the last sample that was used.
        missed_down: samples that passed while the service was down.
    """

    def __init__(self, joints: int, resumes: Position | None = None) -> None:
        self.position = resumes
        self.missed_down = 0 if resumes is None else resumes.missed_down
        # Until it is known how many samples passed meanwhile.
        self._resumes = resumes
        self._first_seq = self._in_order = 0  # number of the stream's first sample, its samples
        self._guard = StreamGuard(joints)
        if resumes is not None:
            runs = {"run": resumes.run, "old_runs": list(resumes.superseded)}
            self._guard.restore({"begun": True, **runs})

    @property
    def resuming(self) -> bool:
        """Whether it is not known yet how many samples passed while the service was down."""
        return self._resumes is not None

    def judge(self, sample: ServoSample) -> Reject | None:
        """Why the next sample is refused, None if it is used; all have to come by here in order."""
        answer = self._guard.admit(sample)
        if isinstance(answer, Reject):
            return answer
        self._count_missed_down(sample, restart=answer.restart)
        if self._resumes is None:
            older = self._guard.older_runs
            self.position = Position(sample.run, sample.seq, self.missed_down, older)
        return None

    def _count_missed_down(self, sample: ServoSample, *, restart: bool) -> None:
        """Count what passed while the service was down; a long gap, once a stream confirms it."""
        before = self._resumes
        if before is None:
            return
        if sample.run != before.run:  # another start of the source: no number tells
            self._resumes = None
            return
        if restart:
            self._first_seq, self._in_order = sample.seq, 0
        self._in_order += 1
        gap = self._first_seq - before.seq - 1
        if gap <= SHORT_GAP or self._in_order >= CONFIRM_SAMPLES:
            self.missed_down += gap if 0 < gap < LONGEST_GAP else 0
            self._resumes = None
