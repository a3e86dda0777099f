"""When events were right again after a fault, and which legs were late.

An event that comes after the fault is no recovery by itself: it has to be true.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events, LegOutcome, LegStream, match
from adaptive_contact.score.contacts import TruthChanges
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import ContactEvent, ServoSample, decode, servo_key

from .arrival import SourceClock
from .conduct import RECOVERY_S, Broken, Take

Flags = NDArray[np.bool_]

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

    A leg that had nothing to tell for two seconds has until the first touch of a whole swing, of
    those that count.
    """
    last_s, late = 0.0, []
    by_leg = {one.leg: one for one in outcomes}
    for leg in legs:
        first_ns = first_right_ns(fault, right.get(leg, ()), clock)
        took_s = float("inf") if first_ns is None else (first_ns - fault.to_ns) / _NS
        last_s = max(last_s, took_s)
        limit_ns = fault.to_ns + int(RECOVERY_S * _NS)
        if leg in by_leg:
            asked = whole_touches(by_leg[leg], clock.of_wall(fault.to_ns))
            limit_ns = max(limit_ns, heard_by_ns(by_leg[leg], asked, clock) or 0)
        if first_ns is None or first_ns > limit_ns:
            late.append(leg)
    return last_s, late


def first_right_ns(
    fault: Broken, right: Iterable[tuple[int, ContactEvent]], clock: SourceClock
) -> int | None:
    """When a leg's first right event after a fault was heard, ns of the wall; None if never."""
    to_ns = clock.of_wall(fault.to_ns)
    heard = (at for at, event in right if at > fault.to_ns and event.t_ns > to_ns)
    return next(heard, None)


def whole_touches(outcome: LegOutcome, from_ns: int) -> Flags:
    """Touches that count, of swings that began after a time: (touches,)."""
    touches = outcome.touches
    return np.asarray((outcome.swings.start_ns[touches.swing] > from_ns) & touches.counted)


def heard_by_ns(outcome: LegOutcome, asked: Flags, clock: SourceClock) -> int | None:
    """By when the event of the first of some touches had to be heard, ns of the wall.

    Args:
        outcome: of a leg.
        asked: (touches,) which of its touches.
        clock: of the samples.

    Returns:
        None where none is asked for.
    """
    touches = outcome.touches
    which = np.flatnonzero(asked)
    if not len(which):
        return None
    latest = int(touches.onset_ns[which[0]] + touches.window_ns[which[0]])
    return latest + clock.lag_ns(latest) + _TRAVEL_NS


# -- What a service that nobody broke would have told of a leg: the same learner, the same sa


def unbroken(recording: Path, stream: LegStream, robot: Robot, until_ns: int) -> LegOutcome:
    """Take a new learner through a leg's samples.

    As the simulator sent them: what a service lost on the way is not lost here.  Its refits take
    effect where the service's do, unless the service's process was late.

    Args:
        recording: of the samples.
        stream: the leg, with its truth.
        robot: its description.
        until_ns: time of the last sample that is asked for.

    Returns:
        The touches, all that the stream holds; later ones are not found.
    """
    learner = ContactLearner(robot, stream.leg, shipped_baseline(robot.name))
    key = servo_key(stream.leg)
    told: list[ContactEvent] = []
    for record in read_recording(recording):
        if record.key != key:
            continue
        sample = decode(record.payload, ServoSample, record.encoding)
        if not isinstance(sample, ServoSample):
            continue
        if sample.t_ns > until_ns:
            break
        event = learner.update(sample)
        if event is not None:
            told.append(event)
    return match(stream, Events.of(told))


def missed_anyway(
    outcome: LegOutcome,
    without_fault: Callable[[int], LegOutcome],
    fault: Broken,
    first_right_ns: int | None,
    clock: SourceClock,
) -> bool:
    """Whether a leg that was late after a fault would have been as late without it.

    It has until the first touch that a learner without the fault finds, and no longer: what comes
    late, or never, is the fault's doing all the same.

    Args:
        outcome: of the leg's events, as they were heard.
        without_fault: the same stream, by a learner that was not broken, up to a samples' time.
        fault: which.
        first_right_ns: when the leg's first right event was heard, ns of the wall.
        clock: of the samples.
    """
    from_ns = clock.of_wall(fault.to_ns)
    asked = whole_touches(outcome, from_ns)
    found = np.flatnonzero(asked & outcome.touches.found)
    if first_right_ns is None or not len(found):
        return False  # never right again
    touches = outcome.touches
    until_ns = int(touches.onset_ns[found[0]] + touches.window_ns[found[0]])
    other = without_fault(until_ns)
    limit_ns = heard_by_ns(other, asked & other.touches.found, clock)
    return limit_ns is not None and first_right_ns <= limit_ns
