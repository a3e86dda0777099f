"""Checks whether a sample is the next one of its stream.  Bad ones are counted, never raised.

One :class:`StreamGuard` per leg follows ``run``, ``seq`` and ``t_ns`` and sorts samples into the
next one, the next one after a gap, the first one of a restart, and the rejected.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Final, NamedTuple

from adaptive_contact.model.bounds import is_count
from adaptive_contact.wire import MAX_ANGLE_RAD, MAX_PREVIEW_TICKS, Reject, ServoSample

MAX_TIME_NS: Final = 2**63 - 1
MIN_RUN: Final = -(2**63)
MAX_RUN: Final = 2**63 - 1
# A gap is accepted up to a day of samples at 100 Hz; a number further ahead is wild, or counts
# from somewhere else.  It also keeps every count of losses far inside 64 bits.
LONGEST_GAP: Final = 10_000_000
# A longer gap could be one sample of another writer of the key.  It is accepted from the third
# sample of a stream of its own on; the source before it is used meanwhile.  Losses of up to a
# second at 50 Hz, as of a busy network, cost nothing.
SHORT_GAP: Final = 50
CONFIRM_SAMPLES: Final = 3
# A new `run` is accepted at once, until one has taken over that did not last.  Then the next one
# needs three samples of its own that follow each other, and twice as many after each further one,
# up to 48.  So many samples of one source make up for one that did not last: a minute at 50 Hz.
MOST_SHORT_LIVED: Final = 5
SETTLED_SAMPLES: Final = 3000
# Such a run sends at least once in so many samples of the one in force.
PACE: Final = 5
# New runs that may yet be accepted; a bound on memory.
MAX_NEWCOMERS: Final = 8
# New runs that did not last are in the note for so many accepted samples (10 s at 50 Hz).
NOTED_SAMPLES: Final = 500
# So many samples in a row that do not follow the last one accepted, but are in order among
# themselves, mean that the source counts again: its clock was set back, it was restarted without
# a new `run`, or one wild time or number was taken for true.
RESET_SAMPLES: Final = 10
# Where counters of 8, 16 and 32 bits begin again; others show by the second time.
COUNTERS: Final = (2**8, 2**16, 2**32)
# So many samples in a row from a superseded publisher over so long, by its own clock, with none
# from the newer one between them, mean that the newer one is gone.  One that floods sends as many
# between two samples of the newer.
TAKE_BACK_SAMPLES: Final = 25
TAKE_BACK_NS: Final = 450_000_000
# Publishers remembered as superseded; a bound on memory, not a tuning knob.
MAX_OLD_RUNS: Final = 32
# Two publishers take turns where a refused stream goes on so often after samples of the one in
# force: once may be what a link still held of a source that started again.  It holds for so many
# more accepted samples (1 s at 50 Hz), so that bursts of up to a second are turns, too.
TURNS: Final = 2
CONTESTED_SAMPLES: Final = 50
# Refused streams that may yet take turns, and accepted samples remembered; bounds on memory.
MAX_RIVALS: Final = 4
MAX_RECENT: Final = 64
# A source that restarts so often has no start: its every sample has another `run`, or it is
# restarted in a loop.  A window needs a tenth of that to fill.
SHORT_RUN_SAMPLES: Final = 50
SHORT_RUNS: Final = 3


class Accepted(NamedTuple):
    """Holds how an accepted sample connects to its stream."""

    missed: int  # samples lost between the last accepted one and this one
    restart: bool  # the source has restarted; what came before does not connect


NEXT: Final = Accepted(missed=0, restart=False)  # what nearly every sample is


class _Newcomer(NamedTuple):
    """Holds a run that is not accepted yet."""

    newest: ServoSample  # sample of it
    in_a_row: int  # samples of it that follow each other
    accepted: int  # samples of others accepted by then


class _Rival(NamedTuple):
    """Holds a stream that is not in force."""

    newest: ServoSample  # sample of it
    accepted: int  # samples of others accepted by then
    turns: int  # times that it went on after those


class _Jump(NamedTuple):
    """Holds an accepted gap: the sample before it, what was missed, the sample after it."""

    before: ServoSample
    missed: int
    to: ServoSample

    def goes_on_at(self, now: ServoSample) -> bool:
        """Whether a sample belongs to the stream as it was before the gap."""
        return now.t_ns > self.before.t_ns and self.before.seq < now.seq < self.to.seq


class StreamGuard:
    """Admits or rejects the samples of one leg's stream.

    Attributes:
        joints: J, what a sample must bring.
        run: of the publisher in force.
        missed: samples lost so far.
        restarts: of the source; what is lost at them is not counted.
    """

    def __init__(self, joints: int) -> None:
        self.joints = joints
        self.run: int | None = None
        self.missed = self.restarts = 0
        self._last: ServoSample | None = None
        self._late: ServoSample | None = None  # newest that does not follow the last one
        self._late_count = 0
        self._jump: _Jump | None = None
        self._jump_at = 0  # samples accepted when it was
        self._newcomers: dict[int | None, _Newcomer] = {}
        self._accepted = 0
        self._short_lived = 0  # runs that took over and did not last
        self._strays = 0  # recent new runs that are not accepted
        self._stray_at = 0  # samples accepted when the newest came
        # Publishers in the order in which they were first received, the one in force among them.
        self._runs: list[int | None] = []
        self._other_count = 0
        self._other: tuple[int | None, int] | None = None  # who it is, and since when, t_ns
        self._recent: deque[ServoSample] = deque(maxlen=MAX_RECENT)  # accepted
        self._rivals: list[_Rival] = []
        self._contested_until = -1  # samples accepted
        self._begun = False  # a publisher is in force, if only by a snapshot's word
        self._wraps_at = 0  # what `seq` would wrap at by the last restart without a new `run`
        self._wrapped_at = -NOTED_SAMPLES - 1  # samples accepted when it last did
        self._start_at = -SHORT_RUN_SAMPLES  # samples accepted when the source started
        self._short_runs = 0  # in a row

    @property
    def older_runs(self) -> tuple[int | None, ...]:
        """Of publishers that the one in force has superseded, the oldest first."""
        return tuple(self._runs[: self._runs.index(self.run)]) if self._begun else ()

    @property
    def contested(self) -> bool:
        """Whether two publishers alternate: the samples may be of another leg."""
        return self._accepted <= self._contested_until

    @property
    def note(self) -> str | None:
        """One line for the operator while two publish, or the source restarts repeatedly."""
        if self.contested and self._rivals and self._last is not None:
            used, other = self._last, max(self._rivals, key=lambda rival: rival.turns).newest
            who = f"{_named(used)} (used) and {_named(other)}"
            if used.run == other.run:
                who = f"both {_named(used)}, at seq {used.seq} (used) and {other.seq}"
            return f"two programs publish this leg, {who}: contacts are withheld; stop one of them"
        if self._accepted - self._wrapped_at <= NOTED_SAMPLES:
            return (
                f"seq wraps at {self._wraps_at}: samples count as repeated until the leg starts "
                "again; count seq in 64 bits"
            )
        if self._short_runs >= SHORT_RUNS:
            return (
                "the source restarts every few samples: nothing can be judged; `run` is to be "
                "one number from a start of the source to its end"
            )
        if self._strays < SHORT_RUNS or self._accepted - self._stray_at > NOTED_SAMPLES:
            return None
        return (
            f"{self._strays} new runs came and did not last: another program publishes this leg, "
            "or the source changes `run`, which is to be one number from its start to its end"
        )

    def snapshot(self) -> dict[str, Any]:
        """Return who publishes, and who did before, for :meth:`restore`."""
        runs = {"run": self.run, "old_runs": list(self.older_runs)}
        return {"begun": self._begun, "restarts": self.restarts, **runs}

    def restore(self, saved: object, missed: object = None) -> None:
        """Take over who published, so that the newer still wins, and how many samples were missed.

        What is not usable is left.
        """
        if is_count(missed):
            self.missed = missed
        if not isinstance(saved, dict) or saved.get("begun") is not True:
            return
        if is_count(saved.get("restarts")):
            self.restarts = saved["restarts"]
        old_runs = saved.get("old_runs")
        runs = [saved.get("run"), *(old_runs if isinstance(old_runs, list) else [])]
        if all(run is None or _is_run(run) for run in runs):
            self._begun, self.run = True, runs[0]
            older = dict.fromkeys(run for run in runs[1:] if run != self.run)
            self._runs = [*older, self.run][-MAX_OLD_RUNS - 1 :]

    def admit(self, sample: ServoSample) -> Accepted | Reject:
        """Check a sample against its form and against the stream so far.

        Returns:
            How it connects to the stream, or why it is refused; a refusal changes nothing that
            later samples are judged by, but for the detection of a source that counts again.
        """
        fault = fault_of(sample, self.joints)
        if fault is not None:
            return fault
        before = self._last
        answer = self._connect(sample)
        if answer is NEXT:
            return answer
        if isinstance(answer, Reject):
            self._track_rival(sample, sample)
        elif before is not None and (answer.restart or answer.missed > SHORT_GAP):
            self._track_rival(sample, before)
        return answer

    def _connect(self, sample: ServoSample) -> Accepted | Reject:
        last = self._last
        if sample.run != self.run and self._begun:
            # The run that was seen first is the older publisher; the newer start wins, also when
            # it comes back after a pause.
            older = sample.run in self.older_runs
            if not (self._is_alone(sample) if older else self._confirmed(sample)):
                return Reject.OTHER_PUBLISHER
            return self._restart(sample)
        if last is None:
            return self._restart(sample)
        missed = sample.seq - last.seq - 1
        if missed == 0 and sample.t_ns > last.t_ns:  # what nearly every sample is
            return self._accept(sample, 0)
        if sample.t_ns <= last.t_ns and missed != -1:
            return self._refuse(sample, Reject.TIME_BACKWARDS)
        if missed < 0:
            return self._refuse(sample, Reject.DUPLICATE_SEQ)
        if missed > LONGEST_GAP:
            return self._refuse(sample, Reject.OUT_OF_RANGE)
        if missed > SHORT_GAP:
            return self._refuse(sample, Reject.SEQ_JUMP)
        return self._accept(sample, missed)

    def _accept(self, sample: ServoSample, missed: int) -> Accepted:
        self._last, self._late, self._late_count = sample, None, 0
        self._recent.append(sample)
        self._accepted += 1
        self._other_count = 0
        since_start = self._accepted - self._start_at
        if since_start == SHORT_RUN_SAMPLES:
            self._short_runs = 0
        if since_start % SETTLED_SAMPLES == 0:
            self._short_lived = max(0, self._short_lived - 1)
        if missed == 0:
            return NEXT
        self.missed += missed
        return Accepted(missed=missed, restart=False)

    def _confirmed(self, sample: ServoSample) -> bool:
        """Whether a run that is not older shows to be a stream of its own."""
        run = sample.run
        known = self._newcomers.pop(run, None)
        in_a_row = 1
        if known is None:
            if self._accepted - self._stray_at > NOTED_SAMPLES:
                self._strays = 0
            self._strays += 1
            self._stray_at = self._accepted
        elif _follows(sample, known.newest) and self._accepted - known.accepted <= PACE:
            in_a_row = known.in_a_row + 1
        if self._short_lived == 0 or in_a_row >= CONFIRM_SAMPLES << (self._short_lived - 1):
            self._strays = max(0, self._strays - 1)
            return True
        self._newcomers[run] = _Newcomer(sample, in_a_row, self._accepted)
        if len(self._newcomers) > MAX_NEWCOMERS:
            del self._newcomers[next(iter(self._newcomers))]
        return False

    def _is_alone(self, sample: ServoSample) -> bool:
        """Whether a superseded publisher has been the only one for long enough."""
        if self._other_count == 0 or self._other is None or self._other[0] != sample.run:
            self._other, self._other_count = (sample.run, sample.t_ns), 0
        self._other_count += 1
        long_enough = sample.t_ns - self._other[1] >= TAKE_BACK_NS
        return long_enough and self._other_count >= TAKE_BACK_SAMPLES

    def _restart(self, sample: ServoSample) -> Accepted:
        jump = self._jump if sample.run == self.run and not self._settled_since_jump else None
        if jump is not None and jump.goes_on_at(sample):
            # Another writer's samples were taken for a gap; the source itself never restarted.
            self.missed = jump.missed + sample.seq - jump.before.seq - 1
        else:
            # The first sample after a start of our own is no restart of the source's.
            self.restarts += self._last is not None or (self._begun and sample.run != self.run)
        self._jump = None
        self.run, self._last, self._begun = sample.run, sample, True
        self._late, self._late_count, self._other_count = None, 0, 0
        if self.run not in self._runs:
            self._runs = [*self._runs, self.run][-MAX_OLD_RUNS - 1 :]
        short = self._accepted - self._start_at < SHORT_RUN_SAMPLES
        self._short_runs = self._short_runs + 1 if short else 0
        self._short_lived = min(self._short_lived + short, MOST_SHORT_LIVED)
        self._start_at = self._accepted
        self._recent.clear()
        self._recent.append(sample)
        self._accepted += 1
        return Accepted(missed=0, restart=True)

    def _track_rival(self, sample: ServoSample, left: ServoSample) -> None:
        """Track the streams that are not in force.

        Args:
            sample: refused, or the first of another stream that is accepted.
            left: the newest of a stream that is not in force: the refused one, or the one before.
        """
        if left is sample and self._was_there(sample):
            return
        known = next((r for r in self._rivals if _goes_on(sample, r.newest)), None)
        turns = 0
        if known is not None:
            self._rivals.remove(known)
            since = self._accepted - known.accepted
            turns = known.turns + (since > 0) if since <= CONTESTED_SAMPLES else 0
        self._rivals = [*self._rivals, _Rival(left, self._accepted, turns)][-MAX_RIVALS:]
        if turns >= TURNS:
            self._contested_until = self._accepted + CONTESTED_SAMPLES

    def _was_there(self, sample: ServoSample) -> bool:
        """Whether a refused sample is a copy of an accepted one, or only came too late."""
        if not self._recent:  # a restored one
            return False
        first, last = self._recent[0], self._recent[-1]
        if sample.run != last.run or not first.seq <= sample.seq <= last.seq:
            return False
        same = next((one for one in self._recent if one.seq == sample.seq), None)
        return first.t_ns < sample.t_ns < last.t_ns if same is None else sample == same

    @property
    def _settled_since_jump(self) -> bool:
        return self._accepted - self._jump_at >= SETTLED_SAMPLES

    def _refuse(self, sample: ServoSample, why: Reject) -> Accepted | Reject:
        """Refuse what does not follow the last sample, until it shows to be a stream itself."""
        last, late = self._last, self._late
        # A stream of its own is as close-knit as any: what jumps about at random is none.
        in_order = late is None or _follows(sample, late)
        self._late_count = self._late_count + 1 if in_order else 1
        self._late = sample
        if why is Reject.SEQ_JUMP and self._late_count >= CONFIRM_SAMPLES and last is not None:
            if self._jump is None or self._settled_since_jump:
                self._jump = _Jump(last, self.missed, sample)
            self._jump_at = self._accepted
            return self._accept(sample, sample.seq - last.seq - 1)
        if self._late_count < RESET_SAMPLES:
            return why
        if why is Reject.DUPLICATE_SEQ and last is not None:
            # Ticks went on: a counter of few bits is more likely than a start at this very number.
            before, self._wraps_at = self._wraps_at, last.seq + RESET_SAMPLES - sample.seq
            if self._wraps_at in (before, *COUNTERS):
                self._wrapped_at = self._accepted
        return self._restart(sample)


def fault_of(sample: ServoSample, joints: int) -> Reject | None:
    """Return what is wrong with a sample by itself, of a leg of so many joints."""
    measured, desired = sample.measured, sample.desired
    if len(measured) != joints or len(desired) != joints:
        return Reject.WRONG_JOINTS
    if sample.valid is not None and len(sample.valid) != joints:
        return Reject.WRONG_JOINTS
    values = measured + desired
    if sample.preview is not None:
        if len(sample.preview) > MAX_PREVIEW_TICKS:
            return Reject.OUT_OF_RANGE
        for row in sample.preview:
            if len(row) != joints:
                return Reject.WRONG_JOINTS
            values += row
    if not math.hypot(*values) <= MAX_ANGLE_RAD:  # false for NaN, too; else each is in range
        for value in values:
            if not -MAX_ANGLE_RAD <= value <= MAX_ANGLE_RAD:
                return Reject.OUT_OF_RANGE if math.isfinite(value) else Reject.NOT_FINITE
    if not (0 <= sample.t_ns <= MAX_TIME_NS and 0 <= sample.seq <= MAX_TIME_NS):
        return Reject.OUT_OF_RANGE
    # JSON holds integers of any size; what is kept on disk holds 64 bits.
    if sample.run is not None and not _is_run(sample.run):
        return Reject.OUT_OF_RANGE
    return None


def _goes_on(sample: ServoSample, last: ServoSample) -> bool:
    """Whether a sample is the next one of the same publisher's stream."""
    return sample.run == last.run and _follows(sample, last)


def _named(sample: ServoSample) -> str:
    return "without run" if sample.run is None else f"with run {sample.run}"


def _follows(sample: ServoSample, last: ServoSample) -> bool:
    """Whether a sample may be the next one of the same stream, few being lost between."""
    return sample.t_ns > last.t_ns and 0 < sample.seq - last.seq <= SHORT_GAP + 1


def _is_run(value: object) -> bool:
    return isinstance(value, int) and MIN_RUN <= value <= MAX_RUN
