"""When events were right again after a fault, and which legs were late.

An event that comes after the fault is no recovery by itself: it has to be true.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact.score import LegOutcome
from adaptive_contact.score.contacts import TruthChanges
from adaptive_contact.wire import ContactEvent
from adaptive_contact_sim.soak.arrival import SourceClock
from adaptive_contact_sim.soak.conduct import Broken, Take
from adaptive_contact_sim.soak.plan import RECOVERY_S

__all__ = ["recovery_of", "right_events"]

# What an event takes to get here, on top of what the detector may take.
_TRAVEL_NS: Final = 250_000_000
_NS: Final = 1_000_000_000


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
    legs: Sequence[str],
    right: Mapping[str, Sequence[tuple[int, ContactEvent]]],
    outcomes: Sequence[LegOutcome],
    clock: SourceClock,
) -> tuple[float, list[str]]:
    """Seconds from the end of a fault to the last leg's first right event, and who was late.

    A leg that had nothing to tell for two seconds has until the first touch of a whole swing.
    """
    last_s, late = 0.0, []
    by_leg = {one.leg: one for one in outcomes}
    to_ns = clock.of_wall(fault.to_ns)
    for leg in legs:
        first_ns = next(
            (
                arrived_ns
                for arrived_ns, event in right.get(leg, ())
                if arrived_ns > fault.to_ns and event.t_ns > to_ns
            ),
            None,
        )
        took_s = float("inf") if first_ns is None else (first_ns - fault.to_ns) / _NS
        last_s = max(last_s, took_s)
        limit_ns = fault.to_ns + int(RECOVERY_S * _NS)
        if leg in by_leg:
            touches, swings = by_leg[leg].touches, by_leg[leg].swings
            whole = swings.start_ns[touches.swing] > to_ns
            latest_ns = (touches.onset_ns + touches.window_ns)[whole]
            if len(latest_ns):
                latest = int(latest_ns[0])
                limit_ns = max(limit_ns, latest + clock.lag_ns(latest) + _TRAVEL_NS)
        if first_ns is None or first_ns > limit_ns:
            late.append(leg)
    return last_s, late
