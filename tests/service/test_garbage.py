"""Garbage is collected between ticks, and not by Python."""

from __future__ import annotations

import gc
import itertools
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import pytest
from rig import at_work

from adaptive_contact.robot import Robot
from adaptive_contact.service.link import Link
from adaptive_contact.service.server import Service, Sweeper
from adaptive_contact.wire import ServoSample, servo_key


@pytest.fixture
def sweeper() -> Iterator[Sweeper]:
    made = Sweeper(most_objects=5000)
    made.start(0)
    yield made
    gc.enable()
    gc.unfreeze()


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
    with at_work(service):
        assert not any(pauses.wait(3)), "without a sample it is no pause between two"
        publisher = join(router.endpoints[0]).publisher(servo_key("lf"))
        for seq in itertools.count(1):
            publisher.put(sample(seq))
            if any(pauses.wait(len(pauses.items) + 1)):
                break
