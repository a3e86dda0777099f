"""The simulator on the wire: against a fake link, and in a process of its own over Zenoh."""

from __future__ import annotations

import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import (
    ALL_TRUTH,
    MSGPACK,
    SIM_DRIFT,
    ContactEvent,
    Drift,
    DriftReply,
    Message,
    ServoSample,
    contact_key,
    decode,
    encode,
    servo_key,
)
from adaptive_contact.wire.received import Received
from adaptive_contact_sim import TerrainSettings, WalkSettings
from adaptive_contact_sim.live import Pace, run_live
from adaptive_contact_sim.simulation import Simulation, SimulationSettings, Tick


@dataclass
class FakeRequest:
    payload: bytes
    encoding: str = MSGPACK
    replies: list[DriftReply] = field(default_factory=list)
    closed: bool = False

    def reply(self, message: DriftReply, key: str) -> None:
        assert key == SIM_DRIFT
        self.replies.append(message)

    def close(self) -> None:
        self.closed = True


class FakeLink:
    """Keeps what is published; lets a test ask and tell."""

    def __init__(self) -> None:
        self.published: list[tuple[str, Message]] = []
        self.sinks: dict[str, Callable] = {}

    def publisher(self, key: str, **_: object) -> SimpleNamespace:
        return SimpleNamespace(put=lambda message: self.published.append((key, message)))

    def queryable(self, key: str, sink: Callable) -> SimpleNamespace:
        self.sinks[key] = sink
        return SimpleNamespace(close=lambda: self.sinks.pop(key))

    subscribe = queryable


def run_fake(
    sim: Simulation, seconds: float, on_tick: Callable[[FakeLink, Tick], None]
) -> FakeLink:
    link = FakeLink()
    pace = Pace(0.0)
    run_live(
        sim,
        link,
        seconds=seconds,
        pace=pace,
        stop=threading.Event(),
        on_tick=lambda tick: on_tick(link, tick),
    )
    assert pace.ticks == sim.ticks == round(seconds / 0.02)
    assert link.sinks == {}  # all withdrawn at the end
    return link


def test_everything_a_tick_gives_is_published_in_order() -> None:
    settings = SimulationSettings(motion=WalkSettings(), seed=1)
    link = run_fake(Simulation(settings), 2.0, lambda *_: None)
    published = iter(link.published)
    for tick in Simulation(settings).run(2.0):
        for leg, sample in tick.samples.items():
            assert next(published) == (f"robot/leg/{leg}/servo", sample)
        for truth in tick.truth:
            assert next(published) == (f"robot/leg/{truth.leg}/truth", truth.message)


ONE_JOINT = encode(Drift(kind="friction", value=4.0, leg="rf", joint="femur"))
HOLDS = {"friction": {"rf": {"femur": 4.0}}}
# What is asked one after the other: whether it is done, what holds then, and why not.
ASKED = [
    (b"", True, {}, ""),
    (ONE_JOINT, True, HOLDS, ""),
    (ONE_JOINT, True, HOLDS, ""),
    (encode(Drift(kind="friction", value=400.0)), False, HOLDS, "expected 0.1 to 10"),
    (b"\xc1rubbish", False, HOLDS, "not a drift"),
    (encode(Drift(kind="friction", value=1.0)), True, {}, ""),
]


def test_drifts_are_answered_with_what_holds() -> None:
    requests = [FakeRequest(payload) for payload, *_ in ASKED]
    waiting = deque(requests)

    def ask(link: FakeLink, _: Tick) -> None:
        if waiting:
            link.sinks[SIM_DRIFT](waiting.popleft())

    run_fake(Simulation(SimulationSettings()), 0.4, ask)
    for request, (_, ok, holds, why) in zip(requests, ASKED, strict=True):
        (reply,) = request.replies
        assert (request.closed, reply.ok, reply.holds) == (True, ok, holds)
        assert why in str(reply.error)


def test_contact_events_stop_legs_and_bad_ones_do_not() -> None:
    settings = SimulationSettings(
        motion=WalkSettings(stop_on="service"), terrain=TerrainSettings(kind="flat"), seed=3
    )

    def tell(link: FakeLink, tick: Tick) -> None:
        listen = link.sinks["robot/leg/*/contact"]
        for truth in tick.truth:
            event = ContactEvent(
                leg=truth.leg,
                t_ns=truth.message.t_ns,
                seq=0,
                onset_ns=truth.message.t_ns,
                contact=truth.message.contact,
                status="valid",
                score=2.0,
                residual=[0.0] * 3,
                model_version=1,
            )
            listen(Received(contact_key(truth.leg), encode(event), MSGPACK, 0, None))
        listen(Received("robot/leg/rf/contact", b"\xc1", MSGPACK, 0, None))
        listen(Received("robot/leg/**/contact", b"\xc1", MSGPACK, 0, None))

    deaf = run_fake(Simulation(settings), 6.0, lambda *_: None)
    told = run_fake(Simulation(settings), 6.0, tell)
    swings = [
        sum(isinstance(m, ServoSample) and m.phase == "swing" for _, m in link.published)
        for link in (deaf, told)
    ]
    assert swings[1] < 0.9 * swings[0]


class Clock:
    """A clock and an event whose waiting moves it."""

    def __init__(self) -> None:
        self.now = 0.0
        self.waits: list[float] = []

    def __call__(self) -> float:
        return self.now

    def is_set(self) -> bool:
        return False

    def wait(self, seconds: float) -> bool:
        self.waits.append(seconds)
        self.now += seconds + 0.0003  # sleeps oversleep
        return False


def test_pace_does_not_drift() -> None:
    clock = Clock()
    pace = Pace(0.02, clock)
    for _ in range(5000):
        clock.now += 0.004  # the tick's own work
        assert pace.wait(clock)
    assert clock.now == pytest.approx(100.0, abs=0.001)
    assert pace.late == 0


@pytest.mark.e2e
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_in_a_process_of_its_own(router: Link, program: Callable, number: int) -> None:
    (address,) = router.endpoints
    heard: list[Received] = []
    truths: Counter[str] = Counter()
    enough = threading.Event()

    def take(received: Received) -> None:
        heard.append(received)
        if len(heard) >= 100:
            enough.set()

    router.subscribe(servo_key("rf"), take)
    router.subscribe(ALL_TRUTH, lambda r: truths.update([r.key]))
    sim = ("-m", "adaptive_contact", "sim")
    walk = program(*sim, "walk", "--terrain", "flat", "--connect", address, "--seed", "1")
    assert enough.wait(60.0)
    with Link.open(client_settings([address])) as asker:
        (answer,) = asker.query(SIM_DRIFT, Drift(kind="friction", value=3.0, leg="lm"))
    inject = program(*sim, "inject", "supply", "--value", "10", "--connect", address)
    assert inject.wait() == 0
    began = time.monotonic()
    assert walk.stop(number) == 0, walk.lines
    assert time.monotonic() - began < 10.0
    assert not [line for line in walk.lines if "Traceback" in line]
    walk.wait_line("x real time")
    reply = decode(answer.payload, DriftReply, answer.encoding)
    holds = {"friction": {"lm": dict.fromkeys(("coxa", "femur", "tibia"), 3.0)}}
    assert (reply.ok, reply.holds) == (True, holds)
    for line in ("friction    lm  coxa 3", "supply", r"in force at \d\d:\d\d:\d\d:"):
        inject.wait_line(line)
    assert len(truths) == 6
    # Paced by the wall clock, and stamped with it; a busy machine makes single ticks late, and
    # Zenoh drops what does not wait.
    samples = [decode(of.payload, ServoSample, of.encoding) for of in heard]
    lags = [(of.arrival_ns - s.t_ns) / 1e9 for of, s in zip(heard, samples, strict=True)]
    half = len(lags) // 2
    assert min(lags[half:]) == pytest.approx(min(lags[:half]), abs=0.5)
    seqs = [s.seq for s in samples]
    assert seqs == sorted(set(seqs))
    assert abs(samples[-1].t_ns / 1e9 - time.time()) < 60.0
    assert samples[0].run is not None
