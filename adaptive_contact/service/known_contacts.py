"""Follows which contacts of a running service are known, for programs that show them.

A contact holds while samples of its leg come, and while the service says so.  The service itself
withdraws the contact of a leg that falls silent, by an event.  Where the service is gone, stands
still, or cannot be reached, no event comes: its heartbeats stop.  So there is one rule for all:

    a leg is known while its newest sample is at most half a second old,

by the ages in the heartbeats and the time since they arrived.  The contact of a leg that is not
known any more is withdrawn by an event that is made here, as the service would make it.
"""

from __future__ import annotations

from typing import Final

import msgspec

from adaptive_contact.service.settings import SILENT_AFTER_S
from adaptive_contact.wire import ContactEvent, Heartbeat, LegHeartbeat

_OLD_S: Final = 1e6  # in place of an age that is not known


class KnownContacts:
    """Takes heartbeats and events in, and gives the events to pass on; times are monotonic."""

    def __init__(self) -> None:
        self._beats: dict[str, tuple[int, LegHeartbeat]] = {}  # and when the newest sample came
        self._last: dict[str, ContactEvent] = {}  # as the service sent them
        self._withdrawn: set[str] = set()  # legs whose event is not what was passed on

    def age_s(self, leg: str, now_ns: int) -> float | None:
        """Return the age of a leg's newest sample, s; None where none was reported."""
        return (now_ns - self._beats[leg][0]) / 1e9 if leg in self._beats else None

    def is_known(self, leg: str, now_ns: int) -> bool:
        """Return whether a leg is known: its newest sample is at most 0.5 s old."""
        return leg in self._beats and now_ns - self._beats[leg][0] <= int(SILENT_AFTER_S * 1e9)

    def heartbeat(self, heartbeat: Heartbeat, arrival_ns: int) -> None:
        """Process a heartbeat; a leg that it lacks is not known."""
        self._beats = {}
        for leg, beat in heartbeat.legs.items():
            age_s = beat.age_s if 0.0 <= beat.age_s < _OLD_S else _OLD_S
            self._beats[leg] = (arrival_ns - int(1e9 * age_s), beat)

    def event(self, event: ContactEvent, now_ns: int) -> list[ContactEvent]:
        """Process an event; return what may be passed on."""
        self._last[event.leg] = event
        if not self.is_known(event.leg, now_ns):
            return self.poll_events(now_ns)
        self._withdrawn.discard(event.leg)
        return [event]

    def poll_events(self, now_ns: int) -> list[ContactEvent]:
        """Return events of legs whose state became unknown or known; call it ten times a second."""
        found = []
        for leg, last in self._last.items():
            known = self.is_known(leg, now_ns)
            if known is (leg not in self._withdrawn):
                continue
            if not known:
                self._withdrawn.add(leg)
                at_ns = self._beats[leg][1].t_ns if leg in self._beats else last.t_ns
                none = [0.0] * len(last.residual)
                found.append(
                    msgspec.structs.replace(
                        last,
                        t_ns=at_ns,
                        onset_ns=at_ns,
                        contact=False,
                        status="silent",
                        score=0.0,
                        residual=none,
                        withheld=True,
                    )
                )
                continue
            self._withdrawn.discard(leg)
            beat = self._beats[leg][1]
            if last.contact and beat.contact:  # it stands, and no event will say so
                found.append(msgspec.structs.replace(last, t_ns=max(beat.t_ns, last.t_ns)))
        return found
