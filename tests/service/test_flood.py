"""A publisher that floods one leg of the whole service, its own learners at work on a walk."""

from __future__ import annotations

import subprocess
import threading
import time
from types import ModuleType
from typing import Any

import pytest

from adaptive_contact.bank import LearnerBank
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import MSGPACK, ServoSample, encode, servo_key

pytest.importorskip("mujoco")
pytestmark = [pytest.mark.e2e, pytest.mark.slow]

FLOODED = "lf"
WALK_S = 14.0
FLOOD_S = (4.0, 7.0)
RECOVERY_S = 2.0


class Walker(threading.Thread):
    """Publishes a recorded walk at 50 Hz, once."""

    def __init__(self, link: Link, ticks: list[dict[str, ServoSample]]) -> None:
        super().__init__(daemon=True)
        self.ticks = ticks
        self.seq = 0
        self.sent_at: dict[int, float] = {}
        self.publishers = {leg: link.publisher(servo_key(leg)) for leg in ticks[0]}

    def run(self) -> None:
        due = time.monotonic()
        for tick in self.ticks:
            for leg, sample in tick.items():
                self.sent_at[sample.seq] = time.monotonic()
                self.publishers[leg].put(sample)
                self.seq = sample.seq
            due += 0.02
            time.sleep(max(0.0, due - time.monotonic()))


def walk() -> list[dict[str, ServoSample]]:
    from adaptive_contact_sim import Simulation, SimulationSettings, TerrainSettings, WalkSettings

    settings = SimulationSettings(
        motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=3
    )
    return [dict(tick.samples) for tick in Simulation(settings).run(WALK_S)]


def test_a_flood_of_one_leg_hurts_no_other_and_is_over_with_its_end(
    command: Any, rig: ModuleType
) -> None:
    ticks = walk()
    robot = shipped_robot()
    bank = LearnerBank(robot, shipped_baseline(robot.name))
    expected = {
        (event.leg, event.seq, event.contact) for tick in ticks for event in bank.update(tick)
    }
    process = command(
        *("-m", "adaptive_contact", "serve", "--listen", "tcp/127.0.0.1:0", "--no-state"),
        stdout=subprocess.PIPE,
    )
    endpoint = process.stdout.readline().split("listening on ")[1].split(";")[0]
    listener = rig.Listener(endpoint)
    stop, started = threading.Event(), threading.Event()
    flood = listener.link.publisher(servo_key(FLOODED))

    def pour() -> None:
        began, count = time.monotonic(), 0
        while not stop.is_set():
            for _ in range(50):  # 5,000 a second: 100 times the rate
                sample = ServoSample(
                    t_ns=10**15 + count * 20_000_000,
                    seq=count,
                    measured=[0.1, 0.2, 0.3],
                    desired=[0.1, 0.2, 0.3],
                    run=2**50,
                )
                flood.put_raw(encode(sample), MSGPACK)
                count += 1
            started.set()
            stop.wait(max(0.0, began + count / 5000 - time.monotonic()))

    with rig.closing(listener), Link.open(client_settings([endpoint], wait=False)) as link:
        listener.wait(lambda me: len(me.statuses) == 6)
        walker = Walker(link, ticks)
        walker.start()
        first = ticks[0][FLOODED].seq
        while walker.seq - first < FLOOD_S[0] * 50:
            time.sleep(0.02)
        pouring = threading.Thread(target=pour)
        pouring.start()
        while walker.seq - first < FLOOD_S[1] * 50:
            time.sleep(0.02)
        stop.set()
        pouring.join(5)
        ended = time.monotonic()
        # The leg's own robot is heard again: its clock is what the status tells.
        flood_ns, end_ns = ticks[int(FLOOD_S[1] * 50)][FLOODED].t_ns, ticks[-1][FLOODED].t_ns
        listener.wait(lambda me: flood_ns < me.statuses[FLOODED].t_ns <= end_ns)
        assert time.monotonic() - ended < RECOVERY_S
        shown = rig.watched(listener.link, "overflow")
        assert "other_publisher" in shown
        walker.join(30)
        last = ticks[-1]["rf"].seq
        listener.wait(
            lambda me: all(s.t_ns == ticks[-1][leg].t_ns for leg, s in me.statuses.items())
        )
        for leg, status in listener.statuses.items():
            if leg != FLOODED:
                assert (status.missed, status.rejects) == (0, {}), leg
        told = {  # when the walk is over all legs are silent
            (event.leg, event.seq, event.contact)
            for _, event in listener.events
            if event.status != "silent"
        }
        # A service that has just started says of each leg with its first sample that it is free.
        begun = {(leg, sample.seq, False) for leg, sample in ticks[0].items()}
        others = {one for one in expected | begun if one[0] != FLOODED}
        assert {one for one in told if one[0] != FLOODED} == others
        after = next(
            seq for seq in sorted(walker.sent_at) if walker.sent_at[seq] > ended + RECOVERY_S
        )
        own = {one for one in expected if one[0] == FLOODED and after <= one[1] <= last}
        again = {one for one in told if one[0] == FLOODED and after <= one[1] <= last}
        assert len(own) >= 4
        assert again == own
    process.terminate()
    assert process.wait(60) == 0
