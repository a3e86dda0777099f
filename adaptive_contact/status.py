"""Defines ServiceStatus: the state of the service, beside the legs' own LearnerStatus.

Published once a second on ``robot/service/status``, and within 0.1 s when a complaint of its note
comes or goes; kept for late joiners, so that ``watch`` and ``doctor`` can say what belongs to no
leg: payloads on unusable keys, and what the service knows about the robot.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import msgspec

from adaptive_contact.robot import AngleFrame, Robot
from adaptive_contact.wire import HEARTBEAT, LEG_MESSAGES, Heartbeat, Message, Rejected, decode
from adaptive_contact.wire.received import Received

_NS_PER_MS: Final = 1e6


class LatencyMs(msgspec.Struct, frozen=True, kw_only=True):
    """Holds quantiles of the newest values, ms, and how many there ever were."""

    p50: float
    p99: float
    max: float
    count: int


class Latency:
    """Keeps the newest latencies and gives their quantiles."""

    # p99 of as many is good to about 40 values beyond it.
    def __init__(self, kept: int = 4096) -> None:
        self._values: deque[int] = deque(maxlen=kept)
        self._count = 0

    def add(self, latency_ns: int) -> None:
        """Add a latency, ns."""
        self._values.append(latency_ns)
        self._count += 1

    def quantiles(self) -> LatencyMs | None:
        """Return quantiles of the newest values, by nearest rank; None before the first."""
        if not self._values:
            return None
        ordered = sorted(self._values)
        last = len(ordered) - 1
        return LatencyMs(
            p50=ordered[round(0.50 * last)] / _NS_PER_MS,
            p99=ordered[round(0.99 * last)] / _NS_PER_MS,
            max=ordered[-1] / _NS_PER_MS,
            count=self._count,
        )


class StateFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Reports how saving of learned state goes, for people."""

    folder: str  # where
    restored: list[str]  # legs that went on from a saved state
    # one line for each state that was not used; of many, the first and how many more
    refused: list[str]
    saved: int  # states written
    failed: int  # states that could not be written
    # why the last one could not, or what the one under way waits for; None when all is well
    error: str | None
    exposed: str | None = None  # what other users may write to, None when there is no such thing


SERVICE_STATUS: Final = "robot/service/status"


class LegFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Holds what the service knows of a leg."""

    joints: list[str]
    lengths: bool = False  # whether robot.toml has its `lengths_m`
    described: bool = True  # whether robot.toml has the leg
    # position step of its servos by robot.toml, None where it does not say
    quantum_rad: float | None = None
    # lower and upper one of each joint by robot.toml, in the angles of the samples
    limits_rad: list[list[float]] | None = None

    @classmethod
    def from_robot(cls, robot: Robot, leg: str) -> LegFacts:
        """Make the facts of a leg from its robot's description."""
        described = robot.leg(leg)
        limits, frame = described.limits, AngleFrame(described)
        ends = () if limits is None else (limits.lower_rad, limits.upper_rad)
        wire = zip(*(frame.wire(list(end)) for end in ends), strict=True)
        return cls(
            joints=list(described.joints),
            lengths=described.chain is not None,
            quantum_rad=robot.quantum(leg) if robot.knows_step(leg) else None,
            limits_rad=[[min(pair), max(pair)] for pair in wire] or None,
        )


class ServiceStatus(Message, frozen=True, kw_only=True):
    """Reports the state of the service, once a second."""

    version: str  # of the package
    # robot, period_s: of its `robot.toml`
    robot: str
    period_s: float
    baseline: str | None  # where its models come from, None when it started without
    legs: dict[str, LegFacts]  # what it knows of each leg it follows
    uptime_s: float  # since its start
    samples: int = 0  # payloads taken in, of all legs
    events: int = 0  # contact events published
    # payloads that belong to no leg, by reason
    rejects: dict[str, int] = msgspec.field(default_factory=dict)
    # of this start of the service, random; another one beside it is a second service; empty while
    # it compiles, and judges nothing
    instance: str = ""
    # one line for the operator when something is wrong with the service, None when all is well
    note: str | None = None
    events_lost: int = 0  # events dropped because they were held up for too long, or not put
    slow_puts: int = 0  # events that took longer than 0.1 s to send
    late_puts: int = 0  # of these, the ones that no link held up: the computer had no core for them
    # links dropped because their subscribers took no events: they hang, or were cut
    cut_off: int = 0
    stalls: int = 0  # times that the worker, or the process, stood still for a second or more
    state: StateFacts | None = None  # how keeping the learners' state goes, None where none is kept
    # keys of samples without a reader, each with a question to the person who chose it; looked for
    # while a leg has no samples
    strays: dict[str, str] = msgspec.field(default_factory=dict)
    callback_faults: int = 0  # exceptions in Zenoh callbacks; 0 unless the service has a bug
    # arrival of a sample to the end of its processing, learning included
    tick_latency: LatencyMs | None = None
    # arrival of the deciding sample to its event being published
    event_latency: LatencyMs | None = None


_OF_SERVICE: Final[dict[str, type[Message]]] = {SERVICE_STATUS: ServiceStatus, HEARTBEAT: Heartbeat}


def message_of(received: Received) -> Message | Rejected:
    """Decode what came on a key of the service or of a leg."""
    name = received.key.rpartition("/")[2]
    kind = _OF_SERVICE.get(received.key) or LEG_MESSAGES[name]
    return decode(received.payload, kind, received.encoding)
