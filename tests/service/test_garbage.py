"""Garbage is collected between ticks, and not by Python."""

from __future__ import annotations

import gc
import itertools
import threading
import weakref
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import pytest

from adaptive_contact.robot import Robot
from adaptive_contact.service.link import Link
from adaptive_contact.service.server import Service, Sweeper
from adaptive_contact.wire import ServoSample, servo_key

S = 1_000_000_000


class Knot:
    """Refers to itself, so that only a collection ends it."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def sweeper() -> Iterator[Sweeper]:
    made = Sweeper(most_objects=5000)
    made.start(0)
    yield made
    gc.enable()
    gc.unfreeze()


def knot() -> weakref.ref[Knot]:
    return weakref.ref(Knot())


def test_nothing_is_collected_until_it_is_time_and_there_is_a_pause(sweeper: Sweeper) -> None:
    tied = knot()
    [[] for _ in range(4000)]
    sweeper.sweep(59 * S, pause=True)
    sweeper.sweep(61 * S, pause=False)
    assert tied() is not None, "no time, no pause"
    sweeper.sweep(61 * S, pause=True)
    assert tied() is None
    later = knot()
    sweeper.sweep(120 * S, pause=True)
    assert later() is not None, "a minute from the last"
    sweeper.sweep(122 * S, pause=True)
    assert later() is None


def test_what_piles_up_waits_for_no_pause(sweeper: Sweeper) -> None:
    tied = knot()
    kept: list[list[int]] = [[] for _ in range(6000)]
    sweeper.sweep(1, pause=False)
    assert tied() is None
    assert len(kept) == 6000
    again = knot()
    sweeper.sweep(2, pause=False)
    assert again() is not None, "what was kept is not counted twice"


def test_python_collects_nothing_by_itself(sweeper: Sweeper) -> None:
    tied = knot()
    kept = [[] for _ in range(100_000)]
    assert tied() is not None
    assert kept


def test_garbage_is_collected_after_a_tick(
    router: Link, join: Callable[..., Link], inbox: Any, fake: ModuleType, robot: Robot,
    sample: Callable[..., ServoSample],
) -> None:  # fmt: skip
    pauses = inbox()

    class Recorder(Sweeper):
        def sweep(self, now_ns: int, *, pause: bool) -> None:
            pauses(pause)

    service = Service(
        router, fake.FakeBank(robot), robot, baseline=None, now_ns=0, sweeper=Recorder()
    )
    stop = threading.Event()
    worker = threading.Thread(target=service.run, args=(stop,))
    worker.start()
    try:
        assert not any(pauses.wait(3)), "without a sample it is no pause between two"
        publisher = join(router.endpoints[0]).publisher(servo_key("lf"))
        for seq in itertools.count(1):
            publisher.put(sample(seq))
            if any(pauses.wait(len(pauses.items) + 1)):
                break
    finally:
        stop.set()
        worker.join(10)
    assert not worker.is_alive()
