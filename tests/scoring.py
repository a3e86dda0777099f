"""What learners make of samples, by the rules of ``adaptive-contact score``."""

from __future__ import annotations

from collections.abc import Sequence

from adaptive_contact.core.bank import LearnerBank
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Score, score_messages
from adaptive_contact.service.recording import Record
from adaptive_contact.wire import (
    MSGPACK,
    ContactEvent,
    ContactTruth,
    ServoSample,
    encode,
    servo_key,
    truth_key,
)

# Each with its leg.
Samples = Sequence[tuple[str, ServoSample]]
Truth = Sequence[tuple[str, ContactTruth]]


def messages(samples: Samples, truth: Truth) -> list[Record]:
    """As a recording holds them."""
    keyed = [(servo_key(leg), s) for leg, s in samples] + [(truth_key(leg), t) for leg, t in truth]
    return [Record(key, encode(m), MSGPACK, m.t_ns, m.t_ns) for key, m in keyed]


def play(samples: Samples, truth: Truth, robot: Robot, baseline: Baseline) -> Score:
    """Let learners follow samples in the order of their time, and score their events."""
    bank = LearnerBank(robot, baseline)
    events: list[ContactEvent] = []
    for leg, sample in samples:
        events += bank.update({leg: sample})
    return score_messages(messages(samples, truth), robot, events)
