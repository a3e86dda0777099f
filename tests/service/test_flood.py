"""Publishers that invent legs, of the whole service under a walk."""

from __future__ import annotations

import math
import os
import threading
import time
from types import ModuleType
from typing import Any

import pytest

from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import MSGPACK, ServoSample, decode, encode, servo_key
from adaptive_contact.wire.received import Received
from programs import resident_mb

pytestmark = [pytest.mark.e2e, pytest.mark.slow]

NAMES_S = float(os.environ.get("NAMES_S", "16"))
SAMPLES = int(os.environ.get("SAMPLES", "5"))  # of each invented leg


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


def walk(seconds: float) -> list[dict[str, ServoSample]]:
    from adaptive_contact_sim import Simulation, SimulationSettings, TerrainSettings, WalkSettings

    settings = SimulationSettings(
        motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=3
    )
    return [dict(tick.samples) for tick in Simulation(settings).run(seconds)]


def payload(n: int, seq: int) -> bytes:
    """Of the n-th name: one in three would be used, the others have each another fault."""
    joints = 1 + n % 16
    good = [0.3 * math.sin(0.4 * seq + j) for j in range(joints)]
    if n % 6 == 0:
        return b"noise" * n
    measured = {1: [math.nan] * joints, 2: [*good, 0.0], 3: [99.0] * joints}.get(n % 6, good)
    phase = "swing" if seq % 4 else "stance"
    t_ns = 20_000_000 * seq
    return encode(ServoSample(t_ns=t_ns, seq=seq, measured=measured, desired=good, phase=phase))


@pytest.mark.parametrize(
    ("names", "described_only"),
    [(300, False), (2000, False), (300, True)],
)
def test_invented_names_cost_the_legs_that_are_described_nothing(
    program: Any, rig: ModuleType, names: int, described_only: bool
) -> None:
    """Lateness is from the sample that decides to its event, before the names came and after."""
    ticks = walk(NAMES_S)
    service = program(
        *("-m", "adaptive_contact", "serve", "--listen", "tcp/127.0.0.1:0", "--no-state"),
        *(["--described-only"] if described_only else []),
    )
    endpoint = service.wait_line("listening on ([^;]+);")[1]
    listener = rig.Listener(endpoint)
    statuses: list[ServiceStatus] = []

    def on_status(received: Received) -> None:
        status = decode(received.payload, ServiceStatus, received.encoding)
        assert isinstance(status, ServiceStatus)
        statuses.append(status)

    listener.link.subscribe(SERVICE_STATUS, on_status)
    with rig.closing(listener), Link.open(client_settings([endpoint], wait=False)) as link:
        listener.wait(lambda me: len(me.statuses) == 6)
        walker = Walker(link, ticks)
        walker.start()
        listener.wait(lambda me: me.statuses["lf"].ticks >= 50 * NAMES_S / 2)
        before_mb, began = resident_mb(service.process.pid), time.monotonic()
        with Link.open(client_settings([endpoint], wait=False)) as inventor:
            publishers = [inventor.publisher(servo_key(f"x{n}")) for n in range(names)]
            for seq in range(1, SAMPLES + 1):
                for n, publisher in enumerate(publishers):
                    publisher.put_raw(payload(n, seq), MSGPACK)
            flooded_s = time.monotonic() - began
            walker.join(60)
            lasts = {leg: sample.t_ns for leg, sample in ticks[-1].items()}
            listener.wait(lambda me: all(me.statuses[leg].t_ns == t for leg, t in lasts.items()))
            more_mb = resident_mb(service.process.pid) - before_mb
        for leg in lasts:
            status = listener.statuses[leg]
            assert (status.ticks, status.missed, status.rejects) == (len(ticks), 0, {}), leg
        quiet, loud = late(listener, walker, 0.0, began), late(listener, walker, began, math.inf)
        print(
            f"\n{names} names in {flooded_s:.1f} s, {len(statuses[-1].legs) - 6} learners: "
            f"{more_mb:+.0f} MB; events late by {shown(quiet)} ms without, {shown(loud)} ms with"
        )
        assert min(len(quiet), len(loud)) > 20
        # One event may meet what else the machine does; without what is tested here, all are late.
        assert quantile(loud, 0.9) < quantile(quiet, 0.9) + 0.1
        assert loud[-1] < quiet[-1] + 1.0
        assert more_mb < 150.0
        if described_only:
            assert len(statuses[-1].legs) == 6
            assert not statuses[-1].rejects
        else:
            assert len(statuses[-1].legs) > 6
            assert "no room for another leg" in (statuses[-1].note or "")
    assert service.stop() == 0


def late(listener: Any, walker: Walker, after: float, before: float) -> list[float]:
    """Seconds from the sending of the deciding sample to its event, in order of size."""
    return sorted(
        at - walker.sent_at[event.seq]
        for at, event in listener.events
        if event.leg in walker.publishers
        and event.status != "silent"
        and after < walker.sent_at[event.seq] <= before
    )


def quantile(values: list[float], share: float) -> float:
    return values[round(share * (len(values) - 1))]


def shown(values: list[float]) -> str:
    return " ".join(f"{1e3 * quantile(values, share):.1f}" for share in (0.5, 0.9, 1.0))
