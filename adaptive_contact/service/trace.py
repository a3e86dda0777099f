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

from adaptive_contact.arrays import np
from adaptive_contact.robot import AngleFrame, Leg, Robot
from adaptive_contact.robot.gait_phase import PhaseTracker
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
    from adaptive_contact.leg_learner import ContactLearner

# Ticks are kept for so long after a question; a page asks ten times a second.
LEASE_S: Final = 3.0
# Of a leg: two seconds at 200 Hz.  Who asks less often misses ticks.
MOST_TICKS: Final = 400
# Samples in one answer, of all legs: samples that come meanwhile wait for less than a millisecond.
_MOST_ANSWERED: Final = 200


class Judged(NamedTuple):
    """How the learner judged its last tick."""

    residual: list[float]  # (J,) rad, measured minus predicted, in the description's angles
    test_ratio: float  # statistic over threshold, the largest of its windows


class _Tick(NamedTuple):
    number: int
    sample: ServoSample
    swing: bool | None
    judged: Judged | None
    p: float | None  # that the foot carries


class _Leg:
    """Ticks of one leg.

    Args:
        described: by ``robot.toml``; None for a leg that it lacks.
    """

    def __init__(self, described: Leg | None) -> None:
        self.ticks: deque[_Tick] = deque(maxlen=MOST_TICKS)
        self.frame = None if described is None else AngleFrame(described)
        self._described = described
        chain = None if described is None else described.chain
        self._tracker = PhaseTracker(size=1.0 if chain is None else chain.size)

    def swing(self, sample: ServoSample) -> bool | None:
        """Whether the sample, or else its command, says that the leg swings."""
        if sample.phase is not None:
            return sample.phase == "swing"
        leg = self._described
        if leg is None or leg.chain is None or len(sample.desired) != len(leg.joints):
            return None
        desired = sample.desired if self.frame is None else self.frame.angles(sample.desired)
        height = leg.chain.point(desired)[2]
        return self._tracker.update(height) == "swing"

    def predicted(self, sample: ServoSample, residual: list[float]) -> list[float]:
        """(J,) rad in the source's angles."""
        directions = (1,) * len(residual) if self.frame is None else self.frame.directions
        turned = zip(sample.measured, directions, residual, strict=True)
        return [measured - direction * off for measured, direction, off in turned]


class Tracer:
    """Keeps ticks while they are asked for; all calls from the worker."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._legs: dict[str, _Leg] = {}
        self._number = 0
        self._until_ns = 0

    def wanted(self, now_ns: int) -> bool:
        """Whether ticks are to be taken."""
        return now_ns < self._until_ns

    def take(
        self,
        samples: Iterable[tuple[str, ServoSample, Judged | None]],
        states: Mapping[str, LegState] | None = None,
    ) -> None:
        """Keep the samples of a tick, and the states that follow from them."""
        self._number += 1
        for name, sample, judged in samples:
            leg = self._legs.get(name)
            if leg is None:
                known = name in self._robot.leg_ids
                leg = self._legs[name] = _Leg(self._robot.leg(name) if known else None)
            state = (states or {}).get(name)
            p = None if state is None or state.seq != sample.seq else state.p
            leg.ticks.append(_Tick(self._number, sample, leg.swing(sample), judged, p))

    def answer(self, legs: Iterable[str], after: str | None, now_ns: int) -> list[LegTrace]:
        """What came after the number that is asked for, as much as one answer holds.

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
            for leg in asked.values()
            for tick in takewhile(lambda tick: fresh or tick.number > begin, reversed(leg.ticks))
        )
        last = self._number
        if len(numbers) > _MOST_ANSWERED and fresh:
            begin = numbers[-_MOST_ANSWERED] - 1
        elif len(numbers) > _MOST_ANSWERED:
            last = numbers[_MOST_ANSWERED - 1]
        elif fresh:
            begin = -1
        return [self._trace(name, leg, begin, last) for name, leg in asked.items()]

    def _trace(self, name: str, leg: _Leg, after: int, last: int) -> LegTrace:
        newest = takewhile(lambda tick: tick.number > after, reversed(leg.ticks))
        ticks = [tick for tick in newest if tick.number <= last]
        ticks.reverse()
        return LegTrace(
            leg=name,
            number=last,
            t_ns=[tick.sample.t_ns for tick in ticks],
            seq=[tick.sample.seq for tick in ticks],
            swing=[tick.swing for tick in ticks],
            measured=[tick.sample.measured for tick in ticks],
            desired=[tick.sample.desired for tick in ticks],
            predicted=[
                None
                if tick.judged is None or len(tick.judged.residual) != len(tick.sample.measured)
                else leg.predicted(tick.sample, tick.judged.residual)
                for tick in ticks
            ],
            test_ratio=[None if tick.judged is None else tick.judged.test_ratio for tick in ticks],
            p=[tick.p for tick in ticks],
        )


def judged_tick(learner: ContactLearner) -> Judged | None:
    """How a learner judged the tick that it has just finished; None where it could not."""
    tick = learner.judged()
    if tick is None:
        return None
    return Judged(tick.residual.tolist(), float(np.nanmax(tick.scores)))


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
