"""A virtual bus: pseudo-terminals whose Dynamixel or Feetech servos are a simulated robot.

Any software for such servos can open them, ours or others'.  Bytes and control tables are those of
:mod:`adaptive_contact.bridge`; nothing of the makers' SDKs is used on this side.
"""

from __future__ import annotations

from adaptive_contact_sim.virtual.assembly import VirtualServer
from adaptive_contact_sim.virtual.backend import Backend
from adaptive_contact_sim.virtual.faults import FaultSchedule, FaultSpec, parse_fault
from adaptive_contact_sim.virtual.port import VirtualPort
from adaptive_contact_sim.virtual.servo import VirtualServo

__all__ = [
    "Backend",
    "FaultSchedule",
    "FaultSpec",
    "VirtualPort",
    "VirtualServer",
    "VirtualServo",
    "parse_fault",
]
