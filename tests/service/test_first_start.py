"""What a service that still compiles says on the wire, and what becomes of samples meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from adaptive_contact.cli import _compiling
from adaptive_contact.robot import Robot
from adaptive_contact.service.link import Link
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.service.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import ServoSample, servo_key
from waiting import matched


def test_who_looks_sees_that_it_compiles_and_how_many_samples_came(
    router: Link,
    join: Callable[..., Link],
    inbox: Any,
    robot: Robot,
    sample: Callable[..., ServoSample],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop, compiled = threading.Event(), threading.Event()
    monkeypatch.setattr(_compiling, "compile_tick", lambda _: compiled.wait())
    line = "compiling: about 40 s"
    given = (line, router, robot, "x", stop)
    compiles = threading.Thread(target=_compiling.compile_in_view, args=given)
    compiles.start()
    try:
        client = join(router.endpoints[0])
        statuses = inbox(ServiceStatus)
        client.subscribe(SERVICE_STATUS, statuses)
        servo = matched(client.publisher(servo_key("rf"), reliable=True))
        for seq in range(3):
            servo.put(sample(seq))
        last = statuses.wait(lambda said: said[-1].samples == 3)[-1]
        assert last.note.startswith(f"{line}; wait: ")
        assert last.note.endswith(" 3 samples not judged")
        assert list(last.legs) == ["lf", "rf"]
        assert client.alive(SERVICE_TOKEN)
        assert compiles.is_alive()
    finally:
        compiled.set()
        compiles.join(60.0)
    monkeypatch.setattr(_compiling, "compile_tick", lambda _: 1 // 0)
    with pytest.raises(ZeroDivisionError):  # what goes wrong in it ends the service
        _compiling.compile_in_view(*given)
