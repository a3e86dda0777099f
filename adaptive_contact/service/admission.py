"""Which samples of a leg are used, told one by one, and over a restart of the service.

A learner counts what it refuses; to read that takes a whole status (70 µs), too much for every
sample.  So a guard like the learner's own judges here first (2 µs): given the same samples, and
taken over from the same state, it gives the same answers.
"""

from __future__ import annotations

from typing import Final

from adaptive_contact.adapt.stream import StreamGuard
from adaptive_contact.service.state.keeper import Position
from adaptive_contact.wire import Reject, ServoSample

__all__ = ["Admission"]

# A gap over a restart of the service is believed up to a day of samples at 100 Hz.
_LONGEST_GAP: Final = 10_000_000


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
        self._began = False
        self._guard = StreamGuard(joints)
        if resumes is not None:
            runs = {"run": resumes.run, "old_runs": list(resumes.superseded)}
            self._guard.restore({"begun": True, **runs})

    def judge(self, sample: ServoSample) -> Reject | None:
        """Why the next sample is refused, None if it is used; all have to come by here in order."""
        answer = self._guard.admit(sample)
        if isinstance(answer, Reject):
            return answer
        self._follow(sample)
        return None

    def _follow(self, sample: ServoSample) -> None:
        before = self.position
        if before is not None and sample.run == before.run and not self._began:
            gap = sample.seq - before.seq - 1
            if 0 < gap < _LONGEST_GAP:
                self.missed_down += gap
        self._began = True
        self.position = Position(sample.run, sample.seq, self.missed_down, self._guard.older_runs)
