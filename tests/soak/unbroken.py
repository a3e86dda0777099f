"""What a service that nobody broke would have told of a leg: the same learner, the same samples.

A learner misses a touch in some hundreds, fault or none.  Where that one is the first after a fault
the leg is right again late, and the fault is not why; only a learner without it can tell.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events, LegOutcome, LegStream, match
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import ContactEvent, ServoSample, decode, servo_key

from .arrival import SourceClock
from .conduct import Broken
from .recovery import heard_by_ns, whole_touches

__all__ = ["missed_anyway", "unbroken"]


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
