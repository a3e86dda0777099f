"""When events were right again after a fault, and which legs were late.

An event that comes after the fault is no recovery by itself: it has to be true.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact import ContactEvent
from adaptive_contact.score import LegOutcome, TruthChanges
from adaptive_contact.wire import NS_PER_S

from .arrival import SourceClock
from .conduct import RECOVERY_S, Broken, Take

# What an event takes to get here, on top of what the detector may take.
_TRAVEL_NS: Final = 250_000_000


def right_events(
    take: Take, outcomes: Sequence[LegOutcome], truth: Mapping[str, TruthChanges]
) -> dict[str, list[tuple[int, ContactEvent]]]:
    """Per leg the events that are true, with the wall clock of their arrival, in that order.

    A contact is right if it has found a touch, a release if the leg is in the air.
    """
    found_ns = {
        one.leg: set((one.touches.onset_ns + one.touches.latency_ns)[one.touches.found].tolist())
        for one in outcomes
    }
    right: dict[str, list[tuple[int, ContactEvent]]] = {leg: [] for leg in truth}
    for arrived_ns, event in sorted(take.heard.events, key=lambda pair: pair[0]):
        if event.leg not in truth:
            continue
        if event.contact:
            sound = event.t_ns in found_ns.get(event.leg, ())
        else:
            changes = truth[event.leg]
            at = int(np.searchsorted(changes.t_ns, event.t_ns, side="right")) - 1
            # One that only ends what a restart has cut short says nothing about detection.
            sound = event.score > 0.0 and (at < 0 or not changes.contact[at])
        if sound:
            right[event.leg].append((arrived_ns, event))
    return right


def recovery_of(
    fault: Broken,
    right: Mapping[str, Sequence[tuple[int, ContactEvent]]],
    outcomes: Sequence[LegOutcome],
    clock: SourceClock,
) -> tuple[float, list[str]]:
    """Seconds from the end of a fault to the last leg's first right event, and who was late.

    A leg that had nothing to report for two seconds has until the first touch of a whole swing, of
    those that count.
    """
    last_s, late, to_ns = 0.0, [], clock.of_wall(fault.to_ns)
    touched_ns = {one.leg: heard_by_ns(one, to_ns, clock) for one in outcomes}
    for leg, events in right.items():
        heard = (at for at, event in events if at > fault.to_ns and event.t_ns > to_ns)
        first_ns = next(heard, math.inf)
        last_s = max(last_s, (first_ns - fault.to_ns) / NS_PER_S)
        if first_ns > max(fault.to_ns + RECOVERY_S * NS_PER_S, touched_ns.get(leg, 0)):
            late.append(leg)
    return last_s, late


def heard_by_ns(outcome: LegOutcome, to_ns: int, clock: SourceClock) -> int:
    """By when the first touch that counts of a swing after a fault had to be heard; 0 for none."""
    touches = outcome.touches
    begun = outcome.swings.start_ns[touches.swing] > to_ns
    which = np.flatnonzero(begun & touches.counted)
    if not len(which):
        return 0
    latest = int(touches.onset_ns[which[0]] + touches.window_ns[which[0]])
    return latest + clock.lag_ns(latest) + _TRAVEL_NS
