"""Keeps the last ticks of every leg as they were judged, for programs that show them.

A page that draws command, reading, prediction and test ratio needs every tick, and a controller
needs none of them.  So nothing is published: a program asks ``robot/leg/*/trace`` some ten times a
second, and gets the ticks since it asked before.  Ticks are kept only while a program asks, and
taken after the events of a tick are on their way: no contact waits for a page.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from itertools import takewhile
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from adaptive_contact.arrays import np
from adaptive_contact.robot import AngleFrame, Leg
from adaptive_contact.service.link import Link
from adaptive_contact.wire import (
    LegState,
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
# Of a leg: two seconds at 200 Hz.  Who asks less often misses ticks.
MOST_TICKS: Final = 400
# Samples in one answer, of all legs: samples that come meanwhile wait for less than a millisecond.
_MOST_ANSWERED: Final = 200


class Judged(NamedTuple):
    """Holds how the learner judged its last tick."""

    predicted: list[float]  # (J,) rad, what was expected to be measured, in the source's angles
    test_ratio: float  # statistic over threshold, the largest of its windows


class _Tick(NamedTuple):
    number: int
    sample: ServoSample
    swing: bool | None
    judged: Judged | None
    p: float | None  # that the foot carries


class Tracer:
    """Keeps ticks while they are asked for; all calls from the worker."""

    def __init__(self) -> None:
        self._legs: dict[str, deque[_Tick]] = {}
        self._number = 0
        self._until_ns = 0

    def wanted(self, now_ns: int) -> bool:
        """Return whether ticks are to be recorded."""
        return now_ns < self._until_ns

    def record(
        self,
        samples: Iterable[tuple[str, ServoSample, Judged | None]],
        states: Mapping[str, LegState] | None = None,
        swings: Mapping[str, bool] | None = None,
    ) -> None:
        """Store the samples of a tick, with the states that follow from them.

        Args:
            samples: with how they were judged.
            states: of legs, by their newest samples.
            swings: whether the legs' newest commands show a swing, where that is known.
        """
        self._number += 1
        for name, sample, judged in samples:
            state = (states or {}).get(name)
            newest = state is not None and state.seq == sample.seq
            p = state.p if state is not None and newest else None
            swing = (swings or {}).get(name) if newest else None
            if sample.phase is not None:
                swing = sample.phase == "swing"
            ticks = self._legs.setdefault(name, deque(maxlen=MOST_TICKS))
            ticks.append(_Tick(self._number, sample, swing, judged, p))

    def answer(self, legs: Iterable[str], after: str | None, now_ns: int) -> list[LegTrace]:
        """Return the ticks after a given number, as many as one answer holds.

        What is left comes with the next question; without a number the newest comes.

        Args:
            legs: that are asked for.
            after: number of an earlier answer, as the question has it.
            now_ns: monotonic.
        """
        if not self.wanted(now_ns):
            self._legs.clear()  # of an earlier question
        self._until_ns = now_ns + int(LEASE_S * 1e9)
        known = after is not None and after.isascii() and after.isdigit() and len(after) < 20
        begin = int(after) if known and after is not None else -1
        fresh = begin < 0 or begin > self._number  # or of another start of the service
        asked = {leg: self._legs[leg] for leg in legs if leg in self._legs}
        numbers = sorted(
            tick.number
            for ticks in asked.values()
            for tick in takewhile(lambda tick: fresh or tick.number > begin, reversed(ticks))
        )
        last = self._number
        if len(numbers) > _MOST_ANSWERED and fresh:
            begin = numbers[-_MOST_ANSWERED] - 1
        elif len(numbers) > _MOST_ANSWERED:
            last = numbers[_MOST_ANSWERED - 1]
        elif fresh:
            begin = -1
        return [_trace(name, ticks, begin, last) for name, ticks in asked.items()]


def _trace(leg: str, kept: deque[_Tick], after: int, last: int) -> LegTrace:
    newest = takewhile(lambda tick: tick.number > after, reversed(kept))
    ticks = [tick for tick in newest if tick.number <= last]
    ticks.reverse()
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

    def ask(self) -> list[LegTrace]:
        """Return what is new of each leg; empty where no service answers.

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
