"""A service without a network: learners follow messages, `doctor` listens to the last seconds."""

from __future__ import annotations

import msgpack

from adaptive_contact import LearnerBank
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.service.doctor import Diagnosis, Examination, diagnose
from adaptive_contact.status import SERVICE_STATUS, LegFacts, ServiceStatus
from adaptive_contact.wire import (
    MSGPACK,
    Rejected,
    ServoSample,
    decode,
    encode,
    learner_key,
    leg_of_key,
)
from adaptive_contact.wire.received import Received

from .mistakes import Messages


def status_of(robot: Robot, baseline: Baseline | None) -> ServiceStatus:
    facts = {leg: LegFacts.from_robot(robot, leg) for leg in robot.leg_ids}
    return ServiceStatus(
        version="1",
        robot=robot.name,
        period_s=robot.period_s,
        baseline=None if baseline is None else "baseline.json",
        legs=facts,
        uptime_s=60.0,
    )


def listen(
    messages: Messages, robot: Robot, baseline: Baseline | None, *, seconds: float = 3.0
) -> Diagnosis:
    """What `doctor` finds in the last seconds of these messages.

    Learners take in all of them, each leg's in the order in which they come.
    """
    bank = LearnerBank(robot, baseline)
    heard = Examination()
    begins_ns = messages[-1].at_ns - round(seconds * 1e9)

    def take(key: str, payload: bytes) -> None:
        heard.process_message(Received(key, payload, MSGPACK, 0, None))

    def tell(leg: str) -> None:
        learner = bank.learner(leg)
        take(learner_key(leg), encode(learner.status))

    take(SERVICE_STATUS, encode(status_of(robot, baseline)))
    listening = False
    tick: dict[str, ServoSample] = {}
    for sent in messages:
        if not listening and sent.at_ns >= begins_ns:
            listening = True
            bank.update(tick)
            tick = {}
            for leg in robot.leg_ids:
                tell(leg)
        payload = msgpack.packb(sent.body)
        if listening:
            take(sent.key, payload)
        leg = leg_of_key(sent.key)
        if leg is None or not sent.is_sample:
            continue
        sample = decode(payload, ServoSample, MSGPACK)
        learner = bank.learner(leg, len(sent.body["measured"]))
        if isinstance(sample, Rejected):
            learner.count(sample.reason)
            continue
        if leg in tick:
            bank.update(tick)
            tick = {}
        tick[leg] = sample
    bank.update(tick)
    for leg in bank.legs:
        tell(leg)
    take(SERVICE_STATUS, encode(status_of(robot, baseline)))
    return diagnose(heard, seconds, alive=True)


def alone(messages: Messages) -> Diagnosis:
    """What `doctor` finds in these messages where no service runs."""
    heard = Examination()
    for sent in messages:
        heard.process_message(Received(sent.key, msgpack.packb(sent.body), MSGPACK, 0, None))
    return diagnose(heard, 3.0, alive=False)


def causes(diagnosis: Diagnosis, *, notes: bool = False) -> list[str]:
    """Of all findings that are more than a note."""
    return [f.cause for f in diagnosis.findings if notes or f.level != "note"]
