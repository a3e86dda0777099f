"""`serve` as a process of its own, with a fake learner behind the real everything else."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rig
from adaptive_contact.cli import _compiling
from adaptive_contact.robot import Robot
from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import (
    ALL_CONTACT,
    ContactEvent,
    ServoSample,
    servo_key,
)
from waiting import free_address, matched, until

Join = Callable[..., Link]
Sample = Callable[..., ServoSample]


@pytest.mark.e2e
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_says_when_it_is_ready_and_ends_cleanly_and_soon(
    serve: Any, join: Join, sample: Sample, number: int
) -> None:
    served = serve("--log-json")
    assert (
        "robot mini, legs lf rf; baseline none (`adaptive-contact fit` makes one)" in served.ready
    )
    client = join(served.endpoint)
    matched(client.publisher(servo_key("lf"))).put(sample(1))
    until(lambda: "leg status" in served.log.read_text())
    began = time.monotonic()
    assert served.stop(number) == 0
    assert time.monotonic() - began < 10.0
    lines = [json.loads(line) for line in served.log.read_text().splitlines()]
    assert not [line for line in lines if "Traceback" in str(line)]


@pytest.mark.e2e
def test_a_router_that_joins_another_says_only_what_it_knows(serve: Any, join: Join) -> None:
    address = f"tcp/{free_address()}"
    served = serve("--listen", "127.0.0.1:0", "--connect", address)
    assert f" and joining {address}; robot mini" in served.ready
    own = join(served.endpoint.split(" and ")[0])
    assert f"no router joined at {address}; trying on" in rig.watched(own, "no router joined")

    def logged(line: str) -> None:
        until(lambda: line in served.log.read_text(), lambda: served.log.read_text())

    def well() -> None:
        until(lambda: "no router joined" not in rig.watched(own))

    logged("router not joined yet, trying on")
    assert f"unreachable: nobody listens on {address}" in served.log.read_text()
    other = Link.open(router_settings([address]))
    logged("router joined")
    well()
    other.close()
    logged("router lost, reconnecting")
    rig.watched(own, "no router joined")
    with Link.open(router_settings([address])) as again:
        logged("router is back")
        well()
        assert again.is_connected(), "who joins nobody is always there"
    assert served.stop() == 0


def named(task: Path) -> str:
    with contextlib.suppress(OSError):
        return (task / "comm").read_text().strip()
    return "ended"


@pytest.mark.e2e
def test_in_a_hurry_where_that_is_allowed(
    serve: Any, join: Join, inbox: Any, sample: Sample
) -> None:
    """Its own threads and Zenoh's run before ordinary ones; where it may not, it says so."""
    served = serve("--realtime")
    client = join(served.endpoint)
    got = inbox(ContactEvent).subscribe(client, ALL_CONTACT, history=True)
    matched(client.publisher(servo_key("lf"))).put(sample(1, contact=True))
    assert got.wait(1)[0].leg == "lf"
    pid = served.process.pid
    # Zenoh names its threads; libraries of linear algebra made theirs before, and let them sleep.
    # These three stay; others come and go.
    names = {int(task.name): named(task) for task in Path(f"/proc/{pid}/task").iterdir()}
    of_zenoh = [tid for tid, name in names.items() if name in ("app-0", "net-0", "acc-0")]
    assert len(of_zenoh) == 3
    told = [line for line in served.log.read_text().splitlines() if "real-time" in line]
    kinds = {os.sched_getscheduler(tid) for tid in (pid, *of_zenoh)}
    if kinds == {os.SCHED_RR}:
        assert told == []
        assert os.sched_getparam(pid).sched_priority == 15
    else:
        assert kinds == {os.SCHED_OTHER}
        (line,) = told
        assert line.startswith("adaptive-contact: no right to real-time priority; give it with:")


@pytest.mark.e2e
def test_a_misspelt_key_is_named_until_every_leg_has_samples(
    serve: Any, join: Join, inbox: Any, sample: Sample
) -> None:
    """In the log, and in the status that `watch` shows; with samples of all legs it is quiet."""
    served = serve()
    client = join(served.endpoint)
    statuses = inbox(ServiceStatus).subscribe(client, SERVICE_STATUS)
    wrong = {
        "robot/legs/rf/servo": "did you mean robot/leg/rf/servo?",
        "rf/servo": "did you mean robot/leg/rf/servo?",
        "hexa/robot/leg/rf/servo": "is hexa the robot's --namespace?",
    }
    publishers = [client.publisher(key) for key in wrong]

    def told() -> bool:
        for publisher in publishers:
            publisher.put(sample(1))
        return bool(statuses.items) and statuses.items[-1].strays == wrong

    until(told, lambda: statuses.items[-1:])
    assert "a key is read by nobody" in served.log.read_text()
    right = [matched(client.publisher(servo_key(leg))) for leg in statuses.items[-1].legs]
    for publisher in right:
        publisher.put(sample(2))
    statuses.wait(lambda items: not items[-1].strays)
    assert served.stop() == 0


# -- `serve --state` and `state show|reset` as processes, killed and restarted


@pytest.mark.e2e
def test_a_second_service_says_so_and_does_not_save(
    serve: Any, join: Join, inbox: Any, tmp_path: Path
) -> None:
    folder = str(tmp_path)
    first = serve("--state", folder)
    second = serve("--state", folder, "--connect", first.endpoint)
    got = inbox(ServiceStatus).subscribe(join(first.endpoint), SERVICE_STATUS, history=True)
    found = got.wait(
        lambda items: len({s.instance for s in items if "another service runs" in str(s.note)}) > 1
    )
    assert any("every event comes twice; stop one of them" in str(one.note) for one in found)
    assert any(status.note and "in use by another service" in status.note for status in got.items)
    assert second.stop() == 0
    assert re.search(
        r"not alone .*another service runs here for robot mini .*every event comes twice",
        second.log.read_text(),
    )
    got.items.clear()
    got.wait(lambda items: items[-1].note is None)
    assert first.stop() == 0


@pytest.mark.e2e
def test_contradictory_options_get_one_line(ours: Any, tmp_path: Path) -> None:
    done = ours("serve", "--state", tmp_path, "--no-state")
    assert (done.code, "--state and --no-state contradict each other" in done.err) == (2, True)


# -- What a service that still compiles says on the wire, and what becomes of samples meanwhi


def test_who_looks_sees_that_it_compiles_and_how_many_samples_came(
    router: Link,
    join: Callable[..., Link],
    inbox: Any,
    robot: Robot,
    sample: Callable[..., ServoSample],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    line = "compiling: about 40 s"
    given = (line, router, robot, "x", threading.Event())

    def look(_: object) -> None:
        """What the compiler does in its time."""
        client = join(router.endpoints[0])
        statuses = inbox(ServiceStatus).subscribe(client, SERVICE_STATUS)
        servo = matched(client.publisher(servo_key("rf"), reliable=True))
        for seq in range(3):
            servo.put(sample(seq))
        last = statuses.wait(lambda said: said[-1].samples == 3)[-1]
        assert last.note.startswith(f"{line}; wait: ")
        assert last.note.endswith(" 3 samples not judged")
        assert list(last.legs) == ["lf", "rf"]
        assert client.alive(SERVICE_TOKEN)
        raise ZeroDivisionError

    monkeypatch.setattr(_compiling, "compile_tick", look)
    with pytest.raises(ZeroDivisionError):  # what goes wrong in it ends the service
        _compiling.compile_in_view(*given)
