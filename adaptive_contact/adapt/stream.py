"""Is this sample the next one of its leg's stream?  Bad samples are counted, never raised.

One :class:`StreamGuard` per leg follows ``run``, ``seq`` and ``t_ns`` and sorts samples into the
next one, the next one after a gap, the first one of a restart, and the rejected.  A
:class:`RateWatch` tells whether ticks are as far apart as the leg's model takes them to be.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import msgspec

from adaptive_contact.wire import MAX_PREVIEW_TICKS, Reject, ServoSample

__all__ = ["Accepted", "RateWatch", "Seams", "StreamGuard"]

# A joint reads within a few turns of zero; what is further out is not an angle of a leg.
MAX_ANGLE_RAD: Final = 8 * math.pi
MAX_TIME_NS: Final = 2**63 - 1
MIN_RUN: Final = -(2**63)
MAX_RUN: Final = 2**63 - 1
# A gap is believed up to a day of samples at 100 Hz; a number further ahead is wild, or counts
# anew from somewhere else.  It also keeps every count of losses far inside 64 bits.
LONGEST_GAP: Final = 10_000_000
# A longer gap could be one sample of somebody who may write the key.  It is believed from the third
# sample of a stream of its own on; the source before it is used meanwhile.  Losses of up to a
# second at 50 Hz, as of a busy network, cost nothing.
SHORT_GAP: Final = 50
CONFIRM_SAMPLES: Final = 3
# A new `run` is believed at once, until one has taken over that did not last.  Then the next one
# needs three samples of its own that follow each other, and twice as many after each further one,
# up to 48.  So many samples of one source make up for one that did not last: a minute at 50 Hz.
MOST_DOUBTS: Final = 5
SETTLED_SAMPLES: Final = 3000
# Such a run speaks at least once in so many samples of the one in force.
PACE: Final = 5
# New runs that may be on their way to be believed; a bound on memory.
MAX_NEWCOMERS: Final = 8
# New runs that did not last are in the note for so many accepted samples (10 s at 50 Hz).
NOTED_SAMPLES: Final = 500
# So many samples in a row that do not follow the last one accepted, but are in order among
# themselves, mean that the source counts anew: its clock was set back, it was restarted without
# telling so by `run`, or one wild time or number was taken for true.
RESET_SAMPLES: Final = 10
# So many samples in a row from a superseded publisher over so long, by its own clock, with none
# from the newer one between them, mean that the newer one is gone.  One that floods sends as many
# between two samples of the newer.
TAKE_BACK_SAMPLES: Final = 25
TAKE_BACK_NS: Final = 450_000_000
# Publishers remembered as superseded; a bound on memory, not a tuning knob.
MAX_OLD_RUNS: Final = 32
# A source that starts anew so often has no start: its every sample says another `run`, or it is
# restarted in a loop.  A window needs a tenth of that to fill.
SHORT_RUN_SAMPLES: Final = 50
SHORT_RUNS: Final = 3
# Steps over which the rate of a steady source is judged: a rate that changes by 20 % shows in the
# fifth tick, before the ticks held back at the end of a swing are used up.
RATE_STEPS: Final = 8
# Where stamps are off, as many more as it takes until the mean is known to this many standard
# errors within the limit; two seconds at 50 Hz at most.
RATE_ERRORS: Final = 8.0
MOST_RATE_STEPS: Final = 100
# The latest tick that is no pause, 3 periods late, moves the mean of so many steps by MOST_OFF.
MEAN_STEPS: Final = 30
# A model's velocities are per tick: at a rate further off than this it predicts another leg.
MOST_OFF: Final = 0.10
STEADY_OFF: Final = 0.05
# A step longer than so many periods is a whole tick that came late, where ticks are known to.
LATE_PERIODS: Final = 1.6
# A step this many times too long is a pause of the source, counted by `seq` or not.
PAUSE_PERIODS: Final = 4.0
# Share of a stamp's deviation by which the schedule follows it.  Higher follows a loop that slips
# sooner, lower averages the jitter of more stamps.  Measured, the level of residuals is near its
# least at 0.2 for loops late against a fixed schedule and for ones that slip (decision 30).
SCHEDULE_GAIN: Final = 0.2
# Memory of the figures on jitter, in ticks.
JITTER_MEMORY: Final = 64
# A stamp off by less (in periods) is on schedule: the fastest joint of a leg goes a tenth of a step
# of its servo in that time.
ON_SCHEDULE: Final = 0.01
# Deviations above this, root mean square in periods, are worth a line to a person.
NOTED_JITTER: Final = 0.15
# Whether stamps or ticks are late is known after so many whole votes, each of a tick in which
# that makes a difference of far more than the residual's noise; what is forgotten in a few swings.
VOTES: Final = 3.0
VOTE_MEMORY: Final = 200
# Share of the deviations that readings show, above which they are taken for late, and below which
# no longer.
LATE_SHARE: Final = 0.6
ON_TIME_SHARE: Final = 0.4


class Accepted(NamedTuple):
    """A sample that is in order.

    Attributes:
        missed: samples lost between the last accepted one and this one.
        restart: the source started anew; what came before does not connect.
    """

    missed: int
    restart: bool


_NEXT: Final = Accepted(missed=0, restart=False)  # what nearly every sample is


class _Place(NamedTuple):
    """Where a stream is: the time and number of its newest sample."""

    t_ns: int
    seq: int

    def is_followed_by(self, now: _Place) -> bool:
        """Whether ``now`` may be the next sample of the same stream, few being lost between."""
        return now.t_ns > self.t_ns and 0 < now.seq - self.seq <= SHORT_GAP + 1


class _Newcomer(NamedTuple):
    """A run that is not believed yet.

    Attributes:
        place: of its newest sample.
        in_a_row: samples of it that follow each other.
        accepted: samples of others accepted by then.
    """

    place: _Place
    in_a_row: int
    accepted: int


class _Jump(NamedTuple):
    """A gap that was believed: where the stream was, what was missed by then, where it went on."""

    before: _Place
    missed: int
    to: _Place

    def goes_on_at(self, now: _Place) -> bool:
        """Whether a sample belongs to the stream as it was before the gap."""
        return now.t_ns > self.before.t_ns and self.before.seq < now.seq < self.to.seq


class StreamGuard:
    """Follows one leg's stream.

    Attributes:
        joints: J, what a sample must bring.
        run: of the publisher in force.
        missed: samples lost so far.
        restarts: times the source began anew, what it lost at them being nobody's to count.
    """

    def __init__(self, joints: int) -> None:
        self.joints = joints
        self.run: int | None = None
        self.missed = self.restarts = 0
        self._last: _Place | None = None
        self._late: _Place | None = None  # newest sample that does not follow the last one
        self._late_count = 0
        self._jump: _Jump | None = None
        self._since_jump = 0  # samples accepted
        self._newcomers: dict[int | None, _Newcomer] = {}
        self._accepted = 0
        self._doubts = 0  # runs that took over and did not last
        self._strays = 0  # new runs of late that are not believed
        self._stray_at = 0  # samples accepted when the newest came
        # Publishers in the order in which they were first heard, the one in force among them.
        self._runs: list[int | None] = []
        self._other_count = 0
        self._other: tuple[int | None, int] | None = None  # who it is, and since when, t_ns
        self._begun = False  # a publisher is in force, if only by a snapshot's word
        self._since_start = SHORT_RUN_SAMPLES  # samples accepted
        self._short_runs = 0  # in a row

    @property
    def older_runs(self) -> tuple[int | None, ...]:
        """Of publishers that the one in force has superseded, the oldest first."""
        return tuple(self._runs[: self._runs.index(self.run)]) if self._begun else ()

    @property
    def note(self) -> str | None:
        """One line for a person while the source starts anew again and again."""
        if self._short_runs >= SHORT_RUNS:
            return (
                "the source starts anew every few samples: nothing can be judged; `run` is to be "
                "one number from a start of the source to its end"
            )
        if self._strays < SHORT_RUNS or self._accepted - self._stray_at > NOTED_SAMPLES:
            return None
        return (
            f"{self._strays} new runs came and did not last: another program publishes this leg, "
            "or the source changes `run`, which is to be one number from its start to its end"
        )

    def snapshot(self) -> dict[str, Any]:
        """Who publishes, and who did before, for :meth:`restore`."""
        runs = {"run": self.run, "old_runs": list(self.older_runs)}
        return {"begun": self._begun, "restarts": self.restarts, **runs}

    def restore(self, saved: object) -> None:
        """Take over who published, so that the newer still wins; what is none is left."""
        if not isinstance(saved, dict) or saved.get("begun") is not True:
            return
        if _is_count(saved.get("restarts")):
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
            later samples are judged by, but for the detection of a source that counts anew.
        """
        fault = self._form(sample)
        if fault is not None:
            return fault
        now = _Place(sample.t_ns, sample.seq)
        if sample.run != self.run and self._begun:
            # The run that was seen first is the older publisher; the newer start wins, also when
            # it comes back after a pause.
            older = sample.run in self.older_runs
            if not (self._speaks_alone(sample) if older else self._confirmed(sample.run, now)):
                return Reject.OTHER_PUBLISHER
            return self._restart(sample, now)
        if self._last is None:
            return self._restart(sample, now)
        self._other_count = 0
        missed = now.seq - self._last.seq - 1
        if now.t_ns <= self._last.t_ns and missed != -1:
            return self._refuse(sample, now, Reject.TIME_BACKWARDS)
        if missed < 0:
            return self._refuse(sample, now, Reject.DUPLICATE_SEQ)
        if missed > LONGEST_GAP:
            return self._refuse(sample, now, Reject.OUT_OF_RANGE)
        if missed > SHORT_GAP:
            return self._refuse(sample, now, Reject.SEQ_JUMP)
        return self._accept(now, missed)

    def _accept(self, now: _Place, missed: int) -> Accepted:
        self.missed += missed
        self._last, self._late, self._late_count = now, None, 0
        self._accepted += 1
        self._since_jump += 1
        self._since_start += 1
        if self._since_start == SHORT_RUN_SAMPLES:
            self._short_runs = 0
        if self._since_start % SETTLED_SAMPLES == 0:
            self._doubts = max(0, self._doubts - 1)
        return _NEXT if missed == 0 else Accepted(missed=missed, restart=False)

    def _confirmed(self, run: int | None, now: _Place) -> bool:
        """Whether a run that is not older shows to be a stream of its own."""
        known = self._newcomers.pop(run, None)
        in_a_row = 1
        if known is None:
            if self._accepted - self._stray_at > NOTED_SAMPLES:
                self._strays = 0
            self._strays += 1
            self._stray_at = self._accepted
        elif known.place.is_followed_by(now) and self._accepted - known.accepted <= PACE:
            in_a_row = known.in_a_row + 1
        if self._doubts == 0 or in_a_row >= CONFIRM_SAMPLES << (self._doubts - 1):
            self._strays = max(0, self._strays - 1)
            return True
        self._newcomers[run] = _Newcomer(now, in_a_row, self._accepted)
        if len(self._newcomers) > MAX_NEWCOMERS:
            del self._newcomers[next(iter(self._newcomers))]
        return False

    def _speaks_alone(self, sample: ServoSample) -> bool:
        """Whether a superseded publisher has been the only one for long enough."""
        if self._other_count == 0 or self._other is None or self._other[0] != sample.run:
            self._other, self._other_count = (sample.run, sample.t_ns), 0
        self._other_count += 1
        long_enough = sample.t_ns - self._other[1] >= TAKE_BACK_NS
        return long_enough and self._other_count >= TAKE_BACK_SAMPLES

    def _restart(self, sample: ServoSample, now: _Place) -> Accepted:
        jump = self._jump if sample.run == self.run and self._since_jump < SETTLED_SAMPLES else None
        if jump is not None and jump.goes_on_at(now):
            # Somebody else's samples were taken for a gap; the source itself never began anew.
            self.missed = jump.missed + now.seq - jump.before.seq - 1
        else:
            # The first sample after a start of our own is no restart of the source's.
            self.restarts += self._last is not None or (self._begun and sample.run != self.run)
        self._jump = None
        self.run, self._last, self._begun = sample.run, now, True
        self._late, self._late_count, self._other_count = None, 0, 0
        if self.run not in self._runs:
            self._runs = [*self._runs, self.run][-MAX_OLD_RUNS - 1 :]
        short = self._since_start < SHORT_RUN_SAMPLES
        self._short_runs = self._short_runs + 1 if short else 0
        self._doubts = min(self._doubts + short, MOST_DOUBTS)
        self._since_start = 1
        self._accepted += 1
        return Accepted(missed=0, restart=True)

    def _refuse(self, sample: ServoSample, now: _Place, why: Reject) -> Accepted | Reject:
        """Refuse what does not follow the last sample, until it shows to be a stream itself."""
        last, late = self._last, self._late
        # A stream of its own is as close-knit as any: what jumps about at random is none.
        in_order = late is None or late.is_followed_by(now)
        self._late_count = self._late_count + 1 if in_order else 1
        self._late = now
        if why is Reject.SEQ_JUMP and self._late_count >= CONFIRM_SAMPLES and last is not None:
            if self._jump is None or self._since_jump >= SETTLED_SAMPLES:
                self._jump = _Jump(last, self.missed, now)
            self._since_jump = 0
            return self._accept(now, now.seq - last.seq - 1)
        if self._late_count >= RESET_SAMPLES:
            return self._restart(sample, now)
        return why

    def _form(self, sample: ServoSample) -> Reject | None:
        j = self.joints
        if len(sample.measured) != j or len(sample.desired) != j:
            return Reject.WRONG_JOINTS
        if sample.valid is not None and len(sample.valid) != j:
            return Reject.WRONG_JOINTS
        preview = sample.preview or ()
        if len(preview) > MAX_PREVIEW_TICKS:
            return Reject.OUT_OF_RANGE
        values = sample.measured + sample.desired
        for row in preview:
            if len(row) != j:
                return Reject.WRONG_JOINTS
            values += row
        for value in values:
            if not -MAX_ANGLE_RAD <= value <= MAX_ANGLE_RAD:  # false for NaN, too
                return Reject.OUT_OF_RANGE if math.isfinite(value) else Reject.NOT_FINITE
        if not (0 <= sample.t_ns <= MAX_TIME_NS and 0 <= sample.seq <= MAX_TIME_NS):
            return Reject.OUT_OF_RANGE
        # JSON holds integers of any size; what is kept on disk holds 64 bits.
        if sample.run is not None and not _is_run(sample.run):
            return Reject.OUT_OF_RANGE
        return None


def _is_count(value: object) -> bool:
    return isinstance(value, int) and 0 <= value <= MAX_TIME_NS


def _is_run(value: object) -> bool:
    return isinstance(value, int) and MIN_RUN <= value <= MAX_RUN


class RateWatch:
    """Follows one leg's ticks in time: their mean rate, their schedule, and what is off it.

    ``seq`` alone says which ticks were lost.  A stamp off the schedule has two causes: the stamp is
    wrong and its reading is on time, or the loop was late and its reading with it.  Which one is
    judged by what readings show (:meth:`vote`); until then :attr:`late` is None.

    Args:
        period_ns: what ticks should be apart.

    Attributes:
        off: the mean rate is another; judged again from the first few ticks after a restart.
        found_ns: mean distance of ticks, None while that is unknown.
        told_by: ticks by which the rate is judged.
        at_ns: time of the newest tick, by the schedule that follows the stamps.
        lateness: of its stamp against that schedule, periods.
        stretch: by which the step to it was longer than the mean, periods; 0 where it was on
            schedule, or ticks between were lost.
        late: readings are as late as their stamps; None while that is not known.
    """

    def __init__(self, period_ns: int) -> None:
        self.off = False
        self.found_ns: float | None = None
        self.told_by = RATE_STEPS + 1
        self.at_ns = 0
        self.lateness = self.stretch = 0.0
        self.late: bool | None = None
        self._period_ns = period_ns
        self._tolerance_ns = math.floor(ON_SCHEDULE * period_ns)
        self._due_ns = 0  # the tick to come, by the schedule
        self._ticks: deque[_Tick] = deque(maxlen=MOST_RATE_STEPS + 1)
        self._mean = self._square = 0.0  # of deviations from the schedule, periods
        self._spread = 0.0  # mean square of steps around their mean, periods²
        self._votes = self._shown = 0.0  # weights, and weighted shares that readings showed

    @property
    def since_ns(self) -> int:
        """Scheduled time of the oldest tick by which the rate is judged."""
        ticks = self._ticks
        return ticks[-min(self.told_by, len(ticks))].at_ns if ticks else 0

    @property
    def jitter(self) -> float:
        """Root mean square of recent deviations from the schedule, periods."""
        return math.sqrt(max(self._square - self._mean**2, 0.0))

    @property
    def note(self) -> str | None:
        """One line for a person while the rate is off, or stamps are far off their schedule."""
        period_ms = self._period_ns / 1e6
        if self.off and self.found_ns is not None:
            return (
                f"samples are {self.found_ns / 1e6:.1f} ms apart, robot.toml says "
                f"{period_ms:.1f} ms: nothing is judged or learned until they agree"
            )
        jitter = self.jitter
        if jitter <= NOTED_JITTER:
            return None
        return (
            f"t_ns jitters: {jitter * period_ms:.1f} ms (rms) off an even grid of "
            f"{period_ms:.1f} ms; {_CAUSES[self.late]}"
        )

    def follow(self, t_ns: int, seq: int, *, restart: bool) -> int | None:
        """Take in the time and number of an accepted sample.

        Returns:
            Ticks that nobody read since the last one, by its number, and where readings are known
            to be late by its time; None where the source has paused: what came before does not
            connect.
        """
        ticks = self._ticks
        if restart:
            ticks.clear()
            self.off, self.found_ns = False, None
        if not ticks:
            self._anchor(t_ns, seq)
            return 0
        last = ticks[-1]
        steps = seq - last.seq
        missed = steps - 1
        due_ns = self._due_ns + missed * self._period_ns
        if abs(t_ns - due_ns) <= self._tolerance_ns:  # as nearly every tick is
            self._anchor(t_ns, seq)
            if self._square:
                self._jitter(0.0)
        else:
            periods = (t_ns - last.t_ns) / self._period_ns
            if periods > PAUSE_PERIODS * steps:
                ticks.clear()
                self._anchor(t_ns, seq)
                return None
            if self.late and periods > LATE_PERIODS:
                missed = max(int(periods + 2.0 - LATE_PERIODS) - 1, missed)
            self._off_schedule(t_ns, seq, missed, periods / steps)
        if len(ticks) > RATE_STEPS:
            self._judge_rate()
        return missed

    def vote(
        self, residual: Sequence[float], moved: Sequence[float], sigma: Sequence[float]
    ) -> None:
        """Take in what a free tick off the schedule shows: did the leg move by the longer step?

        Args:
            residual: (J,) rad, of the reading as it came.
            moved: (J,) rad, the predicted movement of a whole tick.
            sigma: (J,) rad, deviation of residuals.
        """
        shown = power = 0.0
        for off, step, deviation in zip(residual, moved, sigma, strict=True):
            by = self.stretch * step / deviation
            shown += off / deviation * by
            power += by * by
        if power <= 0.0:
            return
        weight = power / (1.0 + power)
        share = min(max(shown / power, -1.0), 2.0)
        kept = 1.0 - weight / VOTE_MEMORY
        self._votes = kept * self._votes + weight
        self._shown = kept * self._shown + weight * share
        if self._votes >= VOTES:
            limit = ON_TIME_SHARE if self.late else LATE_SHARE
            self.late = self._shown > limit * self._votes

    def _anchor(self, t_ns: int, seq: int) -> None:
        """The tick is on schedule, or begins one."""
        self.at_ns, self._due_ns = t_ns, t_ns + self._period_ns
        self.lateness = self.stretch = 0.0
        self._ticks.append(_Tick(t_ns, seq, t_ns))

    def _off_schedule(self, t_ns: int, seq: int, missed: int, periods: float) -> None:
        """Follow a stamp that is off the schedule, its step so many periods a tick."""
        ticks, period_ns = self._ticks, self._period_ns
        due_ns = self._due_ns + missed * period_ns
        by_ns = t_ns - due_ns
        self.at_ns = due_ns + round(SCHEDULE_GAIN * by_ns)
        self._due_ns = self.at_ns + period_ns
        self.lateness = (t_ns - self.at_ns) / period_ns
        self._jitter(by_ns / period_ns)
        found_ns = self.found_ns
        if found_ns is None:  # by the few ticks there are
            found_ns = (t_ns - ticks[0].t_ns) / (seq - ticks[0].seq)
        spread = (periods - found_ns / period_ns) ** 2
        self._spread += (spread - self._spread) / min(len(ticks), JITTER_MEMORY)
        self.stretch = 0.0
        if not missed:
            first, last = ticks[0], ticks[-1]
            if last.seq - first.seq >= JITTER_MEMORY:
                mean = (last.t_ns - first.t_ns) / (last.seq - first.seq) / period_ns
            else:
                mean = 1.0
            stretch = periods - mean
            self.stretch = stretch if abs(stretch) > ON_SCHEDULE else 0.0
        ticks.append(_Tick(t_ns, seq, self.at_ns))

    def _jitter(self, by: float) -> None:
        """Take in a deviation from the schedule, periods."""
        self._mean += (by - self._mean) / JITTER_MEMORY
        self._square += (by * by - self._square) / JITTER_MEMORY
        if not by:
            self._spread -= self._spread / JITTER_MEMORY
            if self._square < ON_SCHEDULE**2:
                self._mean = self._square = self._spread = 0.0

    def _judge_rate(self) -> None:
        """Compare the mean of as many steps as their spread asks for with the period."""
        ticks = self._ticks
        steps = RATE_STEPS
        if self._spread:
            wanted = RATE_ERRORS * math.sqrt(self._spread) / MOST_OFF
            steps = max(RATE_STEPS, min(math.ceil(wanted), MOST_RATE_STEPS))
        self.told_by = steps + 1
        if len(ticks) <= steps:
            return
        first, last = ticks[-1 - steps], ticks[-1]
        found_ns = self.found_ns = (last.t_ns - first.t_ns) / (last.seq - first.seq)
        limit = STEADY_OFF if self.off else MOST_OFF
        by = found_ns / self._period_ns - 1.0
        # One tick that came late is no other rate; over many steps it cannot look like one.
        self.off = abs(by) > limit and (
            steps >= MEAN_STEPS or self._most_off(math.copysign(limit / 2.0, by), steps)
        )

    def _most_off(self, limit: float, steps: int) -> bool:
        """Whether half of the last steps and more are off by a limit, on its side."""
        recent = list(self._ticks)[-1 - steps :]
        off = [
            ((after.t_ns - before.t_ns) / (after.seq - before.seq) / self._period_ns - 1.0) / limit
            > 1.0
            for before, after in pairwise(recent)
        ]
        return 2 * sum(off) >= len(off)


class Seams:
    """Takes the seam of an encoder out of one leg's angles.

    A joint whose travel crosses the seam reads, and is commanded, a turn further on its other
    side.  Commands go on from the last command, readings lie within half a turn of the command.
    """

    def __init__(self) -> None:
        self._last: list[float] | None = None  # (J,) rad, the command before

    def unwrap(self, sample: ServoSample, *, restart: bool) -> ServoSample:
        """The sample with its angles in one turn; itself where they are, as nearly always."""
        last = None if restart else self._last
        measured, desired = sample.measured, sample.desired
        if last is not None:
            desired = _near(desired, last)
        self._last = desired
        measured = _near(measured, desired)
        if measured is sample.measured and desired is sample.desired:
            return sample
        preview = sample.preview
        if preview is not None and desired is not sample.desired:
            before, rows = desired, []
            for row in preview:
                before = _near(row, before)
                rows.append(before)
            preview = rows
        return msgspec.structs.replace(sample, measured=measured, desired=desired, preview=preview)


def _near(angles: list[float], origin: list[float]) -> list[float]:
    """Angles in the turn nearest to others; themselves where each is within half a turn."""
    for angle, at in zip(angles, origin, strict=True):
        if abs(angle - at) > math.pi:
            return [
                angle - 2.0 * math.pi * round((angle - at) / (2.0 * math.pi))
                for angle, at in zip(angles, origin, strict=True)
            ]
    return angles


class _Tick(NamedTuple):
    """A sample's stamp and number, and the time of its tick by the schedule."""

    t_ns: int
    seq: int
    at_ns: int


_CAUSES: Final[dict[bool | None, str]] = {
    None: "whether the readings are late, too, is not known yet",
    False: "the readings are on time, and ticks are counted by seq",
    True: "the readings are late, too, and are moved to their ticks",
}
