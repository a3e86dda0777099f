"""ServiceStatus: what is true of the service as a whole, beside the legs' own LearnerStatus.

Published once a second on ``robot/service/status`` and kept for late joiners, so that ``watch``
and ``doctor`` can say what belongs to no leg: payloads on unusable keys, and what the service
was told about the robot.
"""

from __future__ import annotations

from typing import Final

import msgspec

from adaptive_contact.service.meters import LatencyMs
from adaptive_contact.wire import Message

__all__ = ["SERVICE_STATUS", "LegFacts", "ServiceStatus"]

SERVICE_STATUS: Final = "robot/service/status"


class LegFacts(msgspec.Struct, frozen=True, kw_only=True):
    """What the service knows of a leg; ``described`` is False for one that is not in robot.toml."""

    joints: list[str]
    lengths: bool = False
    described: bool = True


class ServiceStatus(Message, frozen=True, kw_only=True):
    """How the service is, once a second.

    Attributes:
        version: of the package.
        robot, period_s: of its ``robot.toml``.
        baseline: where its models come from, None when it started without.
        legs: what it knows of each leg it follows.
        uptime_s: since its start.
        samples: payloads taken in, of all legs.
        events: contact events published.
        rejects: payloads that belong to no leg, by reason.
        callback_faults: exceptions in Zenoh callbacks; 0 unless the service has a bug.
        tick_latency: arrival of a sample to the end of its processing.
        event_latency: arrival of the deciding sample to its event being published.
    """

    version: str
    robot: str
    period_s: float
    baseline: str | None
    legs: dict[str, LegFacts]
    uptime_s: float
    samples: int = 0
    events: int = 0
    rejects: dict[str, int] = msgspec.field(default_factory=dict)
    callback_faults: int = 0
    tick_latency: LatencyMs | None = None
    event_latency: LatencyMs | None = None
