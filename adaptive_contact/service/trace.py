"""Keeps the last ticks of every leg as they were judged, for programs that show them.

A page that draws command, reading, prediction and test ratio needs every tick, and a controller
needs none of them.  So nothing is published: a program asks ``robot/leg/*/trace`` some ten times a
second, and gets the ticks since it asked before.  Ticks are kept only while a program asks, and
taken after the events of a tick are on their way: no contact waits for a page.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container
from itertools import takewhile
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from adaptive_contact.arrays import np
from adaptive_contact.robot import AngleFrame, Leg
from adaptive_contact.service.link import Link
from adaptive_contact.wire import (
    LegTrace,
    Rejected,
    ServoSample,
    decode,
    leg_of_key,
    trace_key,
)

if TYPE_CHECKING:
    from adaptive_contact.core.leg_learner import ContactLearner

# Ticks are kept for so long after a question; a page asks ten times a second.
LEASE_S: Final = 3.0
# Two seconds of ten legs at 200 Hz.  Who asks less often misses ticks.
MOST_TICKS: Final = 4000
# Samples in one answer, of all legs: samples that come meanwhile wait for less than a millisecond.
_MOST_ANSWERED: Final = 200


class Judged(NamedTuple):
    """Holds how the learner judged its last tick."""

    predicted: list[float]  # (J,) rad, what was expected to be measured, in the source's angles
    test_ratio: float  # statistic over threshold, the largest of its windows


class _Tick(NamedTuple):
    number: int
    leg: str
    sample: ServoSample
    swing: bool | None
    judged: Judged | None
    p: float | None  # that the foot carries


class Tracer:
    """Keeps ticks while they are asked for; all calls from the worker."""

    def __init__(self) -> None:
        self._ticks: deque[_Tick] = deque(maxlen=MOST_TICKS)
        self._number = 0
        self._until_ns = 0

    def wanted(self, now_ns: int) -> bool:
        """Return whether ticks are to be recorded."""
        return now_ns < self._until_ns

    def record(self, leg: str, sample: ServoSample, learner: ContactLearner | None) -> None:
        """Store a sample; with its learner, if it is that one's last, how it was judged."""
        judged, swing, p = None, None, None
        if learner is not None:
            judged, state = judged_tick(learner, sample), learner.state
            if state.seq == sample.seq:
                p = state.p
                swing = bool(learner.place.leg.swing_phase) if learner.leg.chain else None
        if sample.phase is not None:
            swing = sample.phase == "swing"
        self._number += 1
        self._ticks.append(_Tick(self._number, leg, sample, swing, judged, p))

    def answer(self, legs: Container[str], after: str | None, now_ns: int) -> list[LegTrace]:
        """Return the ticks after a given number, as many as one answer holds.

        What is left comes with the next question; without a number the newest comes.

        Args:
            legs: that are asked for.
            after: number of an earlier answer, as the question has it.
            now_ns: monotonic.
        """
        if not self.wanted(now_ns):
            self._ticks.clear()  # of an earlier question
        self._until_ns = now_ns + int(LEASE_S * 1e9)
        known = after is not None and after.isascii() and after.isdigit() and len(after) < 20
        begin = int(after) if known and after is not None else -1
        fresh = not 0 <= begin <= self._number  # or of another start of the service
        newer = takewhile(lambda tick: fresh or tick.number > begin, reversed(self._ticks))
        asked = [tick for tick in newer if tick.leg in legs][::-1]
        taken = asked[-_MOST_ANSWERED:] if fresh else asked[:_MOST_ANSWERED]
        last = self._number if len(taken) == len(asked) or fresh else taken[-1].number
        return [_trace(leg, taken, last) for leg in dict.fromkeys(tick.leg for tick in taken)]


def _trace(leg: str, taken: list[_Tick], last: int) -> LegTrace:
    ticks = [tick for tick in taken if tick.leg == leg]
    return LegTrace(
        leg=leg,
        number=last,
        t_ns=[tick.sample.t_ns for tick in ticks],
        seq=[tick.sample.seq for tick in ticks],
        swing=[tick.swing for tick in ticks],
        measured=[tick.sample.measured for tick in ticks],
        desired=[tick.sample.desired for tick in ticks],
        predicted=[None if tick.judged is None else tick.judged.predicted for tick in ticks],
        test_ratio=[None if tick.judged is None else tick.judged.test_ratio for tick in ticks],
        p=[tick.p for tick in ticks],
    )


def placed(trace: LegTrace, leg: Leg) -> LegTrace:
    """Add where the leg's joints and foot are at the newest tick of a trace."""
    if not trace.measured:
        return trace
    places = leg.outline(AngleFrame(leg).angles(trace.measured[-1]))
    return msgspec.structs.replace(trace, places_m=places)


def judged_tick(learner: ContactLearner, sample: ServoSample) -> Judged | None:
    """Return how a learner judged its last sample; None where it could not."""
    tick = learner.judged()
    if tick is None:
        return None
    off = np.multiply(AngleFrame(learner.leg).directions, tick.residual)
    return Judged(np.subtract(sample.measured, off).tolist(), float(np.fmax.reduce(tick.scores)))


class TraceReader:
    """Asks a service for the ticks since the question before."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._number = -1  # of the newest tick

    def query_new(self) -> list[LegTrace]:
        """Query what is new of each leg; empty where no service answers.

        Raises:
            LinkError: the link is closed.
        """
        after = self._number
        asked = trace_key("*") if after < 0 else f"{trace_key('*')}?after={after}"
        traces = []
        # A question waits no longer for its answer.
        for reply in self._link.query(asked, timeout_s=0.5):
            leg = leg_of_key(reply.key)
            if reply.error is not None or leg is None:
                continue
            trace = decode(reply.payload, LegTrace, reply.encoding)
            if isinstance(trace, Rejected) or trace.leg != leg:
                continue
            if trace.number < after:  # the service has begun again
                self._number = -1
            self._number = max(self._number, trace.number)
            traces.append(trace)
        return traces
