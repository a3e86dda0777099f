"""Which samples of a leg are used, told one by one, and over a restart of the service.

A learner counts what it refuses; to read that takes a whole status (70 µs), too much for every
sample.  So a guard like the learner's own judges here first (2 µs): given the same samples it
gives the same answers.

What a learner's guard cannot know is which publishers were superseded before the service was
restarted: to it the first one is the older one, whoever that is.  Those are kept from it here, by
the same rule: until so many samples in a row come from them that the newer one must be gone.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from adaptive_contact.adapt.stream import MAX_OLD_RUNS, TAKE_BACK_SAMPLES, StreamGuard
from adaptive_contact.service.state.keeper import Position
from adaptive_contact.wire import Reject, ServoSample

__all__ = ["Admission", "Verdict"]

# A gap over a restart of the service is believed up to a day of samples at 100 Hz.
_LONGEST_GAP: Final = 10_000_000


class Verdict(NamedTuple):
    """What becomes of a sample.

    Attributes:
        refused: why it is not used, None where it is.
        withheld: the learner must not see it; whoever asked counts it.
    """

    refused: Reject | None
    withheld: bool = False


class Admission:
    """Judges the samples of one leg before its learner does.

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
        self._joints = joints
        self._guard = StreamGuard(joints)
        self._began = False
        # Superseded publishers that the learner has not heard, so that it cannot know.
        self._withheld = set(() if resumes is None else resumes.superseded)
        self._withheld_count = 0

    def judge(self, sample: ServoSample) -> Verdict:
        """Tell whether the next sample is used; all of them have to come by here, in order."""
        if sample.run in self._withheld:
            refused = self._withhold(sample)
            if refused is not None:
                return Verdict(refused, withheld=True)
        answer = self._guard.admit(sample)
        if isinstance(answer, Reject):
            return Verdict(answer)
        self._withheld_count = 0
        self._follow(sample)
        return Verdict(None)

    def _withhold(self, sample: ServoSample) -> Reject | None:
        # A guard that has heard nothing judges the form alone.
        fault = StreamGuard(self._joints).admit(sample)
        if isinstance(fault, Reject):
            return fault
        self._withheld_count += 1
        if self._withheld_count < TAKE_BACK_SAMPLES:
            return Reject.OTHER_PUBLISHER
        self._withheld.remove(sample.run)
        return None

    def _follow(self, sample: ServoSample) -> None:
        before = self.position
        superseded = () if before is None else before.superseded
        if before is not None and sample.run != before.run:
            others = (run for run in superseded if run != sample.run)
            superseded = (*others, before.run)[-MAX_OLD_RUNS:]
            if not self._began:
                self._withheld.add(before.run)
        elif before is not None and not self._began:
            gap = sample.seq - before.seq - 1
            if 0 < gap < _LONGEST_GAP:
                self.missed_down += gap
        self._began = True
        self.position = Position(sample.run, sample.seq, self.missed_down, superseded)
