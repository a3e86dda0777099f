"""`serve` as a process of its own, with a fake learner behind the real everything else."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.service.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.service.watch import View
from adaptive_contact.service.watch_table import headline
from adaptive_contact.wire import (
    ALL_CONTACT,
    JSON,
    ContactEvent,
    LearnerStatus,
    ServoSample,
    learner_key,
    servo_key,
)
from waiting import free_address, matched, until

pytestmark = pytest.mark.e2e

Join = Callable[..., Link]
Sample = Callable[..., ServoSample]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_says_when_it_is_ready_and_ends_cleanly_and_soon(
    serve: Any, join: Join, sample: Sample, number: int
) -> None:
    served = serve()
    assert (
        "robot mini, legs lf rf; baseline none (`adaptive-contact fit` makes one)" in served.ready
    )
    client = join(served.endpoint)
    matched(client.publisher(servo_key("lf"))).put(sample(1))
    began = time.monotonic()
    assert served.stop(number) == 0
    assert time.monotonic() - began < 10.0
    assert "Traceback" not in served.log.read_text()


def test_json_in_json_out_and_structured_logs(
    serve: Any, join: Join, inbox: Any, sample: Sample
) -> None:
    served = serve("--json", "--log-json")
    client = join(served.endpoint, json=True)
    got = inbox()
    client.subscribe(ALL_CONTACT, got, history=True)
    learner = inbox(LearnerStatus)
    client.subscribe(learner_key("rf"), learner)
    publisher = matched(client.publisher(servo_key("rf")))
    publisher.put(sample(1))
    publisher.put(sample(2, contact=True))
    (received,) = got.wait(1)
    assert received.encoding == JSON
    assert json.loads(received.payload)["leg"] == "rf"
    learner.wait(lambda items: any(status.ticks == 2 for status in items))
    assert served.stop() == 0
    lines = [json.loads(line) for line in served.log.read_text().splitlines()]
    assert {"leg status", "figures"} <= {line["message"] for line in lines}


def test_a_router_that_joins_another_says_only_what_it_knows(
    serve: Any, join: Join, rig: ModuleType
) -> None:
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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_for_its_lines_ends_nothing(
    router: Link, inbox: Any, program: Any, config: Path, fake: ModuleType
) -> None:
    tokens = inbox()
    router.watch_tokens("robot/service", tokens)
    with Path("/dev/full").open("w") as full:
        served = program(
            *(fake.__file__, "--config", config, "--no-state"),
            *("--connect", router.endpoints[0]),
            stdout=full,
            stderr=full,
        )
    assert tokens.wait(1)[0] == ("robot/service", True)
    statuses = inbox(ServiceStatus)
    router.subscribe(SERVICE_STATUS, statuses)
    statuses.wait(2)  # it works on after the line that could not be written
    assert served.stop() == 0


def test_a_stop_while_waiting_for_a_router_is_clean(serve: Any) -> None:
    with socket.socket() as mute:  # accepts, says nothing
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        address = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        served = serve("--connect", address, wait=False)
        until(
            lambda: not (f"refused: {address} accepts connections" not in served.log.read_text()),
            lambda: served.log.read_text(),
        )
        began = time.monotonic()
        assert served.stop() == 0
        assert time.monotonic() - began < 10.0


def named(task: Path) -> str:
    with contextlib.suppress(OSError):
        return (task / "comm").read_text().strip()
    return "ended"


def test_in_a_hurry_where_that_is_allowed(
    serve: Any, join: Join, inbox: Any, sample: Sample
) -> None:
    """Its own threads and Zenoh's run before ordinary ones; where it may not, it says so."""
    served = serve("--realtime")
    got = inbox(ContactEvent)
    client = join(served.endpoint)
    client.subscribe(ALL_CONTACT, got, history=True)
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


def test_a_misspelt_key_is_named_until_every_leg_has_samples(
    serve: Any, join: Join, inbox: Any, sample: Sample
) -> None:
    """In the log, and in the status that `watch` shows; with samples of all legs it is quiet."""
    served = serve()
    client = join(served.endpoint)
    statuses = inbox(ServiceStatus)
    client.subscribe(SERVICE_STATUS, statuses)
    wrong = {
        "robot/legs/rf/servo": "did you mean robot/leg/rf/servo?",
        "rf/servo": "did you mean robot/leg/rf/servo?",
        "hexa/robot/leg/rf/servo": "is hexa the robot's --namespace?",
    }
    publishers = [client.publisher(key) for key in wrong]
    until = time.monotonic() + 20
    while not (statuses.items and statuses.items[-1].strays == wrong):
        assert time.monotonic() < until, statuses.items[-1:]
        for publisher in publishers:
            publisher.put(sample(1))
        time.sleep(0.05)  # the period of the source
    assert "a key is read by nobody" in served.log.read_text()
    view = View(legs=[], service=statuses.items[-1], alive=True)
    assert "nobody reads rf/servo: did you mean robot/leg/rf/servo?" in headline(view).plain
    right = [matched(client.publisher(servo_key(leg))) for leg in statuses.items[-1].legs]
    for publisher in right:
        publisher.put(sample(2))
    statuses.wait(lambda items: not items[-1].strays)
    assert served.stop() == 0
