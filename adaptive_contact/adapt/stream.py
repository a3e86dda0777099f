"""Is this sample the next one of its leg's stream?  Bad samples are counted, never raised.

One :class:`StreamGuard` per leg follows ``run``, ``seq`` and ``t_ns`` and sorts samples into the
next one, the next one after a gap, the first one of a restart, and the rejected.  A
:class:`RateWatch` tells whether ticks are as far apart as the leg's model takes them to be.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.compiled import records
from adaptive_contact.detect.batch import LegPlace
from adaptive_contact.detect.clock import PAUSE, follow_one
from adaptive_contact.detect.layout import RING, new_legs
from adaptive_contact.wire import MAX_PREVIEW_TICKS, Reject, ServoSample

__all__ = ["Accepted", "RateWatch", "StreamGuard"]

# A joint reads within a few turns of zero; what is further out is not an angle of a leg.
MAX_ANGLE_RAD: Final = 8 * math.pi
MAX_TIME_NS: Final = 2**63 - 1
MIN_RUN: Final = -(2**63)
MAX_RUN: Final = 2**63 - 1
# A gap is believed up to a day of samples at 100 Hz; a number further ahead is wild, or counts
# anew from somewhere else.  It also keeps every count of losses far inside 64 bits.
LONGEST_GAP: Final = 10_000_000
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
# Deviations above this, root mean square in periods, are worth a line to a person.
NOTED_JITTER: Final = 0.15


class Accepted(NamedTuple):
    """A sample that is in order.

    Attributes:
        missed: samples lost between the last accepted one and this one.
        restart: the source started anew; what came before does not connect.
    """

    missed: int
    restart: bool


_NEXT: Final = Accepted(missed=0, restart=False)  # what nearly every sample is


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
        self._last: tuple[int, int] | None = None  # (t_ns, seq)
        self._late: tuple[int, int] | None = None
        self._late_count = 0
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
        if self._short_runs < SHORT_RUNS:
            return None
        return (
            "the source starts anew every few samples: nothing can be judged; `run` is to be one "
            "number from a start of the source to its end"
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
        now = (sample.t_ns, sample.seq)
        if sample.run != self.run and self._begun:
            # The run that was seen first is the older publisher; the newer start wins, also when
            # it comes back after a pause.
            if sample.run in self.older_runs and not self._speaks_alone(sample):
                return Reject.OTHER_PUBLISHER
            return self._restart(sample, now)
        if self._last is None:
            return self._restart(sample, now)
        self._other_count = 0
        missed = sample.seq - self._last[1] - 1
        if sample.t_ns <= self._last[0] and missed != -1:
            return self._refuse(sample, now, Reject.TIME_BACKWARDS)
        if missed < 0:
            return self._refuse(sample, now, Reject.DUPLICATE_SEQ)
        if missed > LONGEST_GAP:
            return self._refuse(sample, now, Reject.OUT_OF_RANGE)
        self.missed += missed
        self._last, self._late, self._late_count = now, None, 0
        self._since_start += 1
        if self._since_start == SHORT_RUN_SAMPLES:
            self._short_runs = 0
        return _NEXT if missed == 0 else Accepted(missed=missed, restart=False)

    def _speaks_alone(self, sample: ServoSample) -> bool:
        """Whether a superseded publisher has been the only one for long enough."""
        if self._other_count == 0 or self._other is None or self._other[0] != sample.run:
            self._other, self._other_count = (sample.run, sample.t_ns), 0
        self._other_count += 1
        long_enough = sample.t_ns - self._other[1] >= TAKE_BACK_NS
        return long_enough and self._other_count >= TAKE_BACK_SAMPLES

    def _restart(self, sample: ServoSample, now: tuple[int, int]) -> Accepted:
        # The first sample after a start of our own is no restart of the source's.
        self.restarts += self._last is not None or (self._begun and sample.run != self.run)
        self.run, self._last, self._begun = sample.run, now, True
        self._late, self._late_count, self._other_count = None, 0, 0
        if self.run not in self._runs:
            self._runs = [*self._runs, self.run][-MAX_OLD_RUNS - 1 :]
        self._short_runs = self._short_runs + 1 if self._since_start < SHORT_RUN_SAMPLES else 0
        self._since_start = 1
        return Accepted(missed=0, restart=True)

    def _refuse(self, sample: ServoSample, now: tuple[int, int], why: Reject) -> Accepted | Reject:
        """Refuse what does not follow the last sample, until it shows to be a stream itself."""
        late = self._late
        # A stream of its own is as close-knit as any: what jumps about at random is none.
        in_order = late is None or (now[0] > late[0] and 0 < now[1] - late[1] <= LONGEST_GAP)
        self._late_count = self._late_count + 1 if in_order else 1
        self._late = now
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
    """Reads what one leg's clock has shown: mean rate, jitter, whether ticks or stamps are late.

    Args:
        period_ns: what ticks should be apart.
        place: arrays of the leg, which its tick follows; own ones where absent, to be followed
            with :meth:`follow`.
    """

    def __init__(self, period_ns: int, place: LegPlace | None = None) -> None:
        self._place = place
        self._own = new_legs(1)
        self._own["period_ns"] = period_ns
        self._own_ring = np.zeros((1, RING, 3), dtype=np.int64)

    @classmethod
    def of(cls, place: LegPlace) -> RateWatch:
        """Of a leg in a batch."""
        return cls(int(place.leg["period_ns"]), place)

    @property
    def off(self) -> bool:
        """Whether the mean rate is another than described."""
        return bool(self._leg["rate_off"])

    @property
    def told_by(self) -> int:
        """Ticks by which the rate is judged."""
        return int(self._leg["told_by"])

    @property
    def found_ns(self) -> float | None:
        """Mean distance of ticks, None while that is unknown."""
        found = float(self._leg["found_ns"])
        return None if math.isnan(found) else found

    @property
    def at_ns(self) -> int:
        """Time of the newest tick, by the schedule that follows the stamps."""
        return int(self._leg["at_ns"])

    @property
    def late(self) -> bool | None:
        """Whether readings are as late as their stamps; None while that is not known."""
        return (None, False, True)[int(self._leg["late"]) + 1]

    @property
    def since_ns(self) -> int:
        """Scheduled time of the oldest tick by which the rate is judged."""
        count = int(self._leg["ring_n"])
        if not count:
            return 0
        return int(self._ring[(count - min(self.told_by, count, RING)) % RING, 2])

    @property
    def jitter(self) -> float:
        """Root mean square of recent deviations from the schedule, periods."""
        leg = self._leg
        return math.sqrt(max(float(leg["jitter_square"]) - float(leg["jitter_mean"]) ** 2, 0.0))

    @property
    def jitter_ms(self) -> float:
        """The same, ms."""
        return self.jitter * int(self._leg["period_ns"]) / 1e6

    @property
    def note(self) -> str | None:
        """One line for a person while the rate is off, or stamps are far off their schedule."""
        period_ms = int(self._leg["period_ns"]) / 1e6
        found_ns = self.found_ns
        if self.off and found_ns is not None:
            return (
                f"samples are {found_ns / 1e6:.1f} ms apart, robot.toml says "
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
        own, ring = records(self._own), self._own_ring
        missed = follow_one(own, ring, t_ns, seq, restart)  # type: ignore[no-untyped-call]
        return None if missed == PAUSE else int(missed)

    @property
    def _leg(self) -> Any:
        return self._own[0] if self._place is None else self._place.leg

    @property
    def _ring(self) -> NDArray[np.int64]:
        ring: NDArray[np.int64] = self._own_ring[0]
        return ring if self._place is None else np.asarray(self._place.batch.ring[self._place.row])


_CAUSES: Final[dict[bool | None, str]] = {
    None: "whether the readings are late, too, is not known yet",
    False: "the readings are on time, and ticks are counted by seq",
    True: "the readings are late, too, and are moved to their ticks",
}
