"""The same contacts twice: as the simulator saw them, and as they came through bus and bridge.

A virtual robot with a scenario records its own samples and truth (``bridge virtual --record``);
``adaptive-contact record`` keeps what came out of the bridge and the service.  Both are of one
run, so every touch can be asked for in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from adaptive_contact.bank import LearnerBank
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Score, score_messages
from adaptive_contact.service.recording import Record, read_recording
from adaptive_contact.wire import (
    LEG_MESSAGES,
    MSGPACK,
    ContactEvent,
    ContactTruth,
    ServoSample,
    decode,
    encode,
    leg_of_key,
    servo_key,
    truth_key,
)

# Truth of touches this long before the first sample still matters to it.
_BEFORE_NS = 1_000_000_000


class Comparison(NamedTuple):
    """Scores of one run."""

    direct: Score  # the simulator's own samples, through learners here
    direct_no_phase: Score  # the same without the phase, which a bridge that observes cannot know
    bridged: Score  # samples of the bridge, through learners here
    # samples of the bridge, with the events that the service sent; None without any
    live: Score | None


# Each with its leg.
Samples = Sequence[tuple[str, ServoSample]]
Truth = Sequence[tuple[str, ContactTruth]]


def compare(
    direct: Path, bridged: Path, robot: Robot, baseline: Baseline, *, skip_s: float = 0.0
) -> Comparison:
    """Score both recordings of a run, over the time that the bridge saw.

    Args:
        direct: the virtual robot's own recording.
        bridged: what came over the wire.
        robot: its description.
        baseline: to start from, in all.
        skip_s: of the bridge's first seconds, while it looks for its place in the tick.

    Raises:
        RecordingError: a recording cannot be read, or holds nothing to be scored.
    """
    own, received = _read(direct), _read(bridged)
    first = min(sample.t_ns for _, sample in received.samples) + round(skip_s * 1e9)
    last = max(sample.t_ns for _, sample in received.samples)
    truth = [(leg, t) for leg, t in own.truth if first - _BEFORE_NS <= t.t_ns <= last]

    def within(samples: Samples) -> Samples:
        return [(leg, s) for leg, s in samples if first <= s.t_ns <= last]

    mine, theirs = within(own.samples), within(received.samples)
    no_phase = [(leg, msgspec.structs.replace(s, phase=None)) for leg, s in mine]
    live = None
    if received.events:
        events = [event for event in received.events if event.t_ns >= first]
        live = score_messages(_messages(theirs, truth), robot, events)
    return Comparison(
        direct=play(mine, truth, robot, baseline),
        direct_no_phase=play(no_phase, truth, robot, baseline),
        bridged=play(theirs, truth, robot, baseline),
        live=live,
    )


def play(samples: Samples, truth: Truth, robot: Robot, baseline: Baseline) -> Score:
    """Let learners follow samples in the order of their time, and score their events."""
    bank = LearnerBank(robot, baseline)
    events: list[ContactEvent] = []
    for leg, sample in samples:
        events += bank.update({leg: sample})
    return score_messages(_messages(samples, truth), robot, events)


class _Received(NamedTuple):
    samples: list[tuple[str, ServoSample]]
    truth: list[tuple[str, ContactTruth]]
    events: list[ContactEvent]


def _read(path: Path) -> _Received:
    received = _Received([], [], [])
    for record in read_recording(path):
        leg = leg_of_key(record.key)
        kind = LEG_MESSAGES.get(record.key.rpartition("/")[2])
        if leg is None or kind is None:
            continue
        message = decode(record.payload, kind, record.encoding)
        if isinstance(message, ServoSample):
            received.samples.append((leg, message))
        elif isinstance(message, ContactTruth):
            received.truth.append((leg, message))
        elif isinstance(message, ContactEvent):
            received.events.append(message)
    received.samples.sort(key=lambda pair: (pair[1].t_ns, pair[0]))
    return received


def _messages(samples: Samples, truth: Truth) -> list[Record]:
    keyed = [(servo_key(leg), s) for leg, s in samples] + [(truth_key(leg), t) for leg, t in truth]
    return [Record(key, encode(m), MSGPACK, m.t_ns, m.t_ns) for key, m in keyed]
