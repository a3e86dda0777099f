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
from types import ModuleType
from typing import Any

import pytest

from adaptive_contact.cli import _compiling
from adaptive_contact.robot import Robot
from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.service.watch import View
from adaptive_contact.service.watch_table import headline
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
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

Join = Callable[..., Link]
Sample = Callable[..., ServoSample]


@pytest.mark.e2e
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


@pytest.mark.e2e
def test_json_in_json_out_and_structured_logs(
    serve: Any, join: Join, inbox: Any, sample: Sample
) -> None:
    served = serve("--json", "--log-json")
    client = join(served.endpoint, json=True)
    got = inbox().hears(client, ALL_CONTACT, history=True)
    learner = inbox(LearnerStatus).hears(client, learner_key("rf"))
    publisher = matched(client.publisher(servo_key("rf")))
    publisher.put(sample(1))
    publisher.put(sample(2, contact=True))
    (received,) = got.wait(1)
    assert received.encoding == JSON
    assert json.loads(received.payload)["leg"] == "rf"
    learner.wait(lambda items: any(status.ticks == 2 for status in items))
    assert served.stop() == 0
    lines = [json.loads(line) for line in served.log.read_text().splitlines()]
    assert "leg status" in {line["message"] for line in lines}


@pytest.mark.e2e
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
    got = inbox(ContactEvent).hears(client, ALL_CONTACT, history=True)
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
    statuses = inbox(ServiceStatus).hears(client, SERVICE_STATUS)
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


# -- `serve --state` and `state show|reset` as processes, killed and restarted


@pytest.fixture
def state(ours: Any) -> Callable[..., tuple[int, str, str]]:
    """Runs `adaptive-contact state …`."""
    return lambda *words: ours("state", *words)


def learner(link: Link, inbox: Any, leg: str, test: Callable[[LearnerStatus], bool]) -> Any:
    got = inbox(LearnerStatus)
    subscribed = link.subscribe(learner_key(leg), got)
    found = got.wait(lambda items: any(test(status) for status in items))
    subscribed.close()
    return next(status for status in found if test(status))


def feed(link: Link, leg: str, sample: Sample, first: int, last: int, **fields: Any) -> None:
    publisher = matched(link.publisher(servo_key(leg)))
    for seq in range(first, last + 1):
        publisher.put(sample(seq, contact=seq % 2 == 1, **fields))


@pytest.mark.e2e
def test_a_second_service_says_so_and_does_not_save(
    serve: Any, join: Join, inbox: Any, tmp_path: Path
) -> None:
    folder = str(tmp_path)
    first = serve("--state", folder)
    second = serve("--state", folder, "--connect", first.endpoint)
    got = inbox(ServiceStatus).hears(join(first.endpoint), SERVICE_STATUS, history=True)
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


@pytest.mark.e2e
def test_show_and_reset(
    serve: Any, join: Join, inbox: Any, sample: Sample, state: Any, tmp_path: Path
) -> None:
    folder = tmp_path / "kept"
    code, _, error = state("show", "--state", str(folder))
    assert (code, error.count("\n")) == (2, 1)
    assert "is no folder; give the --state DIR of the service" in error
    served = serve("--state", str(folder))
    link = join(served.endpoint)
    for leg in ("lf", "rf"):
        feed(link, leg, sample, 1, 4)
        learner(link, inbox, leg, lambda status: status.ticks == 4)
    assert served.stop() == 0
    # A look between two samples of a leg may have saved it before the end did.
    for before in folder.glob("*/*.before"):
        before.unlink()

    code, out, error = state("show", "--state", str(folder), "--json")
    assert (code, error) == (0, "")
    rows = json.loads(out)
    assert [(row["robot"], row["leg"], row["model_version"]) for row in rows] == [
        ("mini", "lf", 3),
        ("mini", "rf", 3),
    ]
    assert all(row["refused"] is None for row in rows)
    damaged = Path(rows[0]["file"])
    damaged.write_bytes(damaged.read_bytes()[:-9])
    _, out, _ = state("show", "--state", str(folder))
    assert out.startswith(f"mini, in {folder}/mini\n")
    assert f"{damaged.name}: damaged: " in out
    assert (out.count(" refused "), out.count(" sound ")) == (1, 1)

    # What the learner refused is no state to go on from, whole as it may be.
    whole = Path(rows[1]["file"])
    aside = whole.with_name(f"{whole.name}.refused")
    whole.rename(aside)
    for before in folder.glob("*/*.before"):
        before.unlink()
    _, out, _ = state("show", "--state", str(folder), "--leg", "rf")
    assert "state.refused" in out
    aside.rename(whole)

    running = serve("--state", str(folder))
    code, _, error = state("reset", "--state", str(folder), "--yes")
    assert code == 2
    assert "in use by another service" in error
    assert running.stop() == 0
    # What saves that were killed have left; `.old` is all that was learned.
    for path in (damaged, whole):
        path.with_suffix(".new").write_bytes(b"half of a st")
        path.with_suffix(".old").write_bytes(whole.read_bytes())
    code, _, error = state("reset", "--state", str(folder), "--leg", "zz", "--yes")
    assert code == 2
    assert "nothing of leg 'zz' is kept in" in error
    code, out, _ = state("reset", "--state", str(folder), "--leg", "rf", "--yes")
    assert (code, out.startswith("forgot")) == (0, True)
    assert not list(folder.glob("*/rf-*"))
    assert {path.suffix for path in folder.glob("*/lf-*")} >= {".new", ".old"}
    left = json.loads(state("show", "--state", str(folder), "--json")[1])
    assert {Path(row["file"]).name.partition("-")[0] for row in left} == {"lf"}


# -- What a service that still compiles says on the wire, and what becomes of samples meanwhi


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
        statuses = inbox(ServiceStatus).hears(client, SERVICE_STATUS)
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
