"""A control loop that is late, and its readings with it, through a real service and real Zenoh."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from adaptive_contact.robot import shipped_robot
from adaptive_contact.score.score import score_messages
from adaptive_contact.service.link import Link
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    MSGPACK,
    ContactEvent,
    LearnerStatus,
    Message,
    ServoSample,
    encode,
    servo_key,
    truth_key,
)
from adaptive_contact_sim.simulation import Simulation, SimulationSettings, Tick
from adaptive_contact_sim.terrain import TerrainSettings
from adaptive_contact_sim.walk import WalkSettings

pytestmark = [pytest.mark.e2e, pytest.mark.slow]

SECONDS = 20.0
# Faster than life, and well within what the service keeps up with.
SPEED = 3.0
LATEST = 0.25  # of a period


def walked() -> Iterator[Tick]:
    settings = SimulationSettings(
        motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=5, run=1
    )
    return Simulation(settings).run(SECONDS)


def late(
    now: ServoSample, then: ServoSample, share: float, period_ns: int, step_rad: float
) -> ServoSample:
    """What is read, and stamped, a share of a period after a tick was due."""
    way = np.array(then.measured) - np.array(now.measured)
    angles = np.rint((np.array(now.measured) + share * way) / step_rad) * step_rad
    return msgspec.structs.replace(
        now, measured=angles.tolist(), t_ns=now.t_ns + round(share * period_ns)
    )


def message(key: str, body: Message) -> Any:
    return SimpleNamespace(key=key, payload=encode(body), encoding=MSGPACK)


def test_touches_are_found_in_readings_that_are_late_with_their_loop(
    cli: Any, join: Callable[..., Link], inbox: Any
) -> None:
    robot, rng = shipped_robot(), np.random.default_rng(7)
    period_ns = round(robot.period_s * 1e9)
    serve = cli("serve", "--no-state", "--listen", "tcp/127.0.0.1:0")
    client = join(serve.wait_line("listening on ([^;]+);")[1])
    events, statuses = inbox(ContactEvent), inbox(LearnerStatus)
    client.subscribe(ALL_CONTACT, events)
    client.subscribe(ALL_LEARNER, statuses)
    out = {leg: client.publisher(servo_key(leg), reliable=True) for leg in robot.leg_ids}
    while not all(publisher.matched for publisher in out.values()):
        time.sleep(0.005)
    recorded: list[Any] = []
    due_ns: dict[tuple[str, int], int] = {}
    begun = time.monotonic()
    for now, then in itertools.pairwise(walked()):
        share = float(rng.uniform(0.0, LATEST))
        for leg, sample in now.samples.items():
            out[leg].put(late(sample, then.samples[leg], share, period_ns, robot.quantum_rad))
            recorded.append(message(servo_key(leg), sample))
            due_ns[leg, sample.seq] = sample.t_ns
        recorded += [message(truth_key(leg), body) for leg, body in now.truth]
        last = sample.seq
        time.sleep(max(0.0, begun + last * robot.period_s / SPEED - time.monotonic()))

    def all_taken(items: list[LearnerStatus]) -> bool:
        done = {status.leg for status in items if status.ticks + status.missed == last + 1}
        return done == set(robot.leg_ids)

    taken = {status.leg: status for status in statuses.wait(all_taken)}
    # Each event at the time that its tick was due, as the truth has it.
    found = [msgspec.structs.replace(one, t_ns=due_ns[one.leg, one.seq]) for one in events.items]
    score = score_messages(recorded, robot, found).total
    assert score.counted.touches >= 60
    assert score.counted.recall >= 0.95
    assert score.false_alarms <= 1
    assert {status.status for status in statuses.items} <= {"valid", "silent"}
    # The loop is named, by its root mean square, and each reading was moved to its tick: readings
    # taken for those of their ticks leave 7 mrad at the second joint.
    for status in taken.values():
        assert status.jitter_ms == pytest.approx(1e3 * robot.period_s * LATEST / 12**0.5, rel=0.4)
    assert np.mean([status.residual_rms[1] for status in taken.values()]) < 6e-3
