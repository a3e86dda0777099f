"""What a service that nobody broke would have told of a leg: the same learner, the same samples.

A learner misses a touch in some hundreds, fault or none.  Where that one is the first after a fault
the leg is right again late, and the fault is not why; only a learner without it can tell.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adaptive_contact.adapt import ContactLearner, shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events, LegOutcome, LegStream, match
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import ServoSample, decode, servo_key

__all__ = ["missed_anyway", "unbroken"]


def unbroken(recording: Path, stream: LegStream, robot: Robot, until_ns: int) -> LegOutcome:
    """Take a new learner through a leg's samples.

    Its refits are the service's, of the same rows; when each of them came is not, by a tick or so.

    Args:
        recording: of the samples.
        stream: the leg, with its truth.
        robot: its description.
        until_ns: time of the last sample that is asked for.

    Returns:
        The touches, all that the stream holds; later ones are not found.
    """
    learner = ContactLearner(robot, stream.leg, shipped_baseline(robot.name))
    key, told = servo_key(stream.leg), []
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
            told.append((event.t_ns, event.contact, event.onset_ns))
    t_ns, contact, onset_ns = zip(*told, strict=True) if told else ((), (), ())
    events = Events(
        np.array(t_ns, dtype=np.int64),
        np.array(contact, dtype=np.bool_),
        np.array(onset_ns, dtype=np.int64),
    )
    return match(stream, events)


def missed_anyway(outcome: LegOutcome, without_fault: LegOutcome, from_ns: int) -> bool:
    """Whether what made a leg late after a fault would have been missed without it, too.

    Args:
        outcome: of the leg's events, as they were heard.
        without_fault: of the same stream, by a learner that was not broken.
        from_ns: samples' time of the end of the fault's cause.

    Returns:
        True if in the whole swings from there to the first touch that was found there were touches
        that count, and the other learner found none of them, either.
    """
    touches = outcome.touches
    whole = (outcome.swings.start_ns[touches.swing] > from_ns) & touches.counted
    found = np.flatnonzero(whole & touches.found)
    if not len(found):
        return False  # never right again
    until = whole & (touches.onset_ns < touches.onset_ns[found[0]])
    return bool(until.any()) and not bool(without_fault.touches.found[until].any())
