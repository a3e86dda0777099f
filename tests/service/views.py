"""Messages that `watch` receives."""

from __future__ import annotations

from typing import Any

from adaptive_contact.status import LegFacts, ServiceStatus
from adaptive_contact.wire import ContactEvent, ContactTruth, Heartbeat, LearnerStatus, LegHeartbeat

S = 1_000_000_000
MS = 1_000_000


def event(t_ms: float, *, contact: bool = True, leg: str = "rf") -> ContactEvent:
    t_ns = int(t_ms * MS)
    return ContactEvent(
        leg=leg,
        t_ns=t_ns,
        seq=1,
        onset_ns=t_ns,
        contact=contact,
        status="valid",
        score=2.0,
        residual=[0.1],
        model_version=1,
    )


def status(ticks: int = 0, **fields: Any) -> LearnerStatus:
    return LearnerStatus(
        **{
            "leg": "rf",
            "t_ns": 0,
            "status": "valid",
            "model_version": 4,
            "residual_rms": [0.004, 0.006],
            "noise_floor": [0.004, 0.003],
            "ticks": ticks,
            **fields,
        }
    )


def heartbeat(*legs: str, age_s: float = 0.0) -> Heartbeat:
    beat = LegHeartbeat(t_ns=0, age_s=age_s, contact=False)
    return Heartbeat(legs=dict.fromkeys(legs, beat))


def truth(t_ms: float, contact: bool) -> ContactTruth:
    return ContactTruth(t_ns=int(t_ms * MS), contact=contact, force=2.0 if contact else 0.0)


def service(**fields: Any) -> ServiceStatus:
    return ServiceStatus(
        **{
            "version": "1",
            "robot": "mini",
            "period_s": 0.02,
            "baseline": None,
            "legs": {"rf": LegFacts(joints=["a"]), "lf": LegFacts(joints=["a"])},
            "uptime_s": 75.0,
            "instance": "ab",
            **fields,
        }
    )
