"""The gateway as a process between a service and a router of ROS 2; a foreign SDK behind it."""

from __future__ import annotations

import itertools
import json
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import zenoh
import zenoh.ext
from views import status

from adaptive_contact.robot import load_robot
from adaptive_contact.ros2 import rmw
from adaptive_contact.ros2.rmw import RosType
from adaptive_contact.ros2.types import typestore
from adaptive_contact.service.link import Link
from adaptive_contact.service.ros2 import WAITING, Gateway, Inbox
from adaptive_contact.wire import (
    MSGPACK,
    ServoSample,
    encode,
    learner_key,
    servo_key,
)
from adaptive_contact.wire.received import Received
from programs import Program
from ros_messages import Messages
from waiting import free_address, until

pytestmark = pytest.mark.e2e

STATE = "/legs/controller_state"
LEGS = ("lf", "rf")
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in ("coxa", "femur", "tibia")]


def open_router(port: int) -> zenoh.Session:
    """A router with the settings of rmw_zenohd: peers find each other through it."""
    settings = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "timestamping/enabled": True,
    }
    chosen = zenoh.Config()
    for key, value in settings.items():
        chosen.insert_json5(key, json.dumps(value))
    return zenoh.open(chosen)


@pytest.fixture
def port() -> int:
    return int(free_address().rpartition(":")[2])


@pytest.fixture
def ros(port: int) -> Iterator[zenoh.Session]:
    with open_router(port) as session:
        yield session


def says(program: Program, *words: str) -> list[str]:
    """The lines that hold all words, once there are some."""
    return until(
        lambda: [line for line in program.lines if all(word in line for word in words)],
        lambda: program.lines[-8:],
    )


@pytest.fixture
def gateway(program, config: Path, port: int) -> Callable[..., Program]:
    """Starts `bridge ros2`, and waits until it reads."""

    def start(endpoint: str, *args: str) -> Program:
        running: Program = program(
            *("-m", "adaptive_contact", "bridge", "ros2", "--config", str(config)),
            *("--connect", endpoint, "--ros-connect", f"127.0.0.1:{port}", *args),
        )
        says(running, "reading", STATE)
        return running

    return start


class Publisher(Messages):
    """A publisher of the far side, with rmw_zenoh's keys and attachments."""

    def __init__(self, session: zenoh.Session) -> None:
        super().__init__()
        self._session = session
        self._seq = 0

    def now(self, read: list[float], told: list[float] | None = None) -> Any:
        return self.state(JOINTS, read, told or [0.0] * 6, time.time_ns())

    def put(
        self,
        payload: bytes,
        name: str = RosType.CONTROLLER_STATE,
        *,
        hash_: str | None = None,
        topic: str = STATE,
        lost: int = 0,
    ) -> None:
        """Publish, as what is reliable in ROS 2 does."""
        self._seq += 1 + lost
        address = rmw.Address(topic, name, hash_ or self.store.hash_rihs01(name))
        self._session.put(
            rmw.topic_key(0, address),
            payload,
            attachment=rmw.encode_attachment(rmw.Attachment(self._seq, time.time_ns(), bytes(16))),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )


def until_used(publisher: Publisher, samples: Any) -> None:
    """Publish until the first sample arrives: the declarations travel."""

    def arrived() -> bool:
        publisher.put(publisher.cdr(publisher.now([0.0] * 6)))
        return bool(samples.items)

    until(arrived)


def test_nodes_of_a_foreign_sdk(serve, gateway, join, inbox, program, ros, port) -> None:
    served = serve()
    link: Link = join(served.endpoint)
    samples, learners = inbox(ServoSample), inbox()
    link.subscribe(servo_key("rf"), samples)
    link.subscribe(learner_key("rf"), learners)
    gateway(served.endpoint)
    foreign: Program = program(
        Path(__file__).parent / "foreign_ros2.py", port, stdin=subprocess.PIPE
    )

    def told(topic: str) -> list[Any]:
        return [
            line
            for line in map(json.loads, (text for text in foreign.lines if text[:1] == "{"))
            if line["topic"] == topic
        ]

    until(lambda: len(told("rf")) >= 6 and told("diagnostics") and told("states"))
    foreign.process.stdin.write("quiet\n")
    foreign.process.stdin.flush()
    until(lambda: told("sent"))

    ticks = told("sent")[0]["ticks"]
    # Nothing is published on the topic any more: who joins now gets what is latched, or nothing.
    until(
        lambda: told("values")[-1]["legs"]["rf"]["valid"] == 0.0 and not told("rf")[-1]["contact"]
    )
    foreign.process.stdin.write("join\n")
    foreign.process.stdin.flush()
    until(lambda: told("late"), lambda: foreign.lines[-12:])
    assert [line["contact"] for line in told("late")] == [False]
    foreign.process.stdin.close()
    got: list[ServoSample] = samples.wait(50)
    assert ticks >= len(got)
    assert [s.seq for s in got] == list(range(got[0].seq, got[0].seq + len(got)))
    assert len({s.run for s in got}) == 1
    assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(got))
    assert {s.measured[0] for s in got} == {0.0, 0.5}

    contacts = [line["contact"] for line in told("rf")]
    assert all(a != b for a, b in itertools.pairwise(contacts))
    values = told("values")[-1]
    names = {"contact", "score", "onset_age", "withheld", "valid", "age"}
    assert set(values["legs"]["rf"]) == names
    assert any(line["legs"].get("rf", {}).get("score") == 2.0 for line in told("values"))
    assert values["stamp"] in {s.t_ns for s in got}
    states = told("states")[-1]["legs"]
    assert set(states) == set(LEGS)
    assert all(set(of) == {"contact", "p", "known"} for of in states.values())
    rows = told("diagnostics")[-1]["rows"]
    assert {f"adaptive_contact: leg {leg}" for leg in LEGS} <= set(rows)
    graph = told("graph")[0]["topics"]
    assert graph["/adaptive_contact/rf/contact"] == [RosType.BOOL]
    assert graph[STATE] == [RosType.CONTROLLER_STATE]


def test_bad_messages_get_a_line_each(serve, gateway, join, inbox, ros) -> None:
    served = serve()
    link: Link = join(served.endpoint)
    samples = inbox(ServoSample).subscribe(link, servo_key("lf"))
    running = gateway(served.endpoint)
    publisher = Publisher(ros)
    until_used(publisher, samples)

    good = publisher.cdr(publisher.now([0.1] * 6))
    for _ in range(3):
        publisher.put(b"\x00\x01\x00\x00\x01", RosType.BOOL)
        publisher.put(good, hash_="RIHS01_" + 64 * "0")
        publisher.put(good[: len(good) // 2])
        publisher.put(b"")
        publisher.put(bytes(300_000))
        publisher.put(publisher.cdr(publisher.now([np.nan] + [0.2] * 5)))
    publisher.put(publisher.cdr(publisher.now([0.3] * 6)), lost=2)
    got = samples.wait(lambda all_: all_[-1].measured == [0.3] * 3)
    assert [s.valid for s in got if s.measured[1] == 0.2] == [[False, True, True]] * 3
    assert got[-1].seq - got[-2].seq == 3  # two were lost
    for words in (
        ("carries std_msgs/msg/Bool", "expected control_msgs"),
        ("type hash RIHS01_00000000…", "another definition"),
        ("is no control_msgs/msg/JointTrajectoryControllerState",),
        ("300000 bytes, at most",),
        ("NaN or infinite", "lf_coxa"),
    ):
        assert len(says(running, STATE, *words)) == 1  # of three

    assert running.process.poll() is None


def test_a_topic_that_floods_drops_its_own_oldest() -> None:
    inbox = Inbox(("/a", "/b"))
    a, b, other = (
        rmw.topic_key(0, rmw.Address(topic, RosType.JOINT_STATE, ""))
        for topic in ("/a", "/b", "/c")
    )

    def message(key: str, number: int) -> Received:
        return Received(key, b"", "", number, None)

    for key in (b, other, "robot/x"):
        inbox.add(message(key, 0))
    for number in range(WAITING + 36):
        inbox.add(message(a, number))
    got = [inbox.get(0.0)[1] for _ in range(WAITING + 1)]
    assert got == [message(b, 0), *(message(a, n) for n in range(36, WAITING + 36))]
    assert inbox.get(0.0) is None
    assert inbox.pop_dropped() == {"/a": 36}
    assert inbox.pop_dropped() == {}


def test_learners_of_other_robots_take_no_places(config: Path) -> None:
    service = cast(Link, SimpleNamespace(publisher=lambda key: None))
    ros = cast(Link, SimpleNamespace(id="aa"))
    gateway = Gateway(load_robot(config), service, ros, 1, lambda line: None)
    for leg in ("x1", "x2", "x3", *LEGS):
        payload = encode(status(leg=leg), MSGPACK)
        gateway.store_status(Received(learner_key(leg), payload, MSGPACK, 0, None))
    shown = typestore().deserialize_cdr(gateway.diagnosis(None), RosType.DIAGNOSTICS)
    names = [row.name for row in shown.status]
    assert names == [*(f"adaptive_contact: leg {leg}" for leg in LEGS), "adaptive_contact: gateway"]


def test_a_router_that_comes_back(serve, gateway, join, inbox, port) -> None:
    served = serve()
    link: Link = join(served.endpoint)
    samples = inbox(ServoSample).subscribe(link, servo_key("lf"))
    with open_router(port) as first:
        running = gateway(served.endpoint)
        until_used(Publisher(first), samples)
    says(running, "ROS 2 cannot be reached")
    samples.items.clear()
    with open_router(port) as second:
        says(running, "the service and ROS 2 are there")
        until_used(Publisher(second), samples)


def test_legs_without_samples_are_told_of(serve, gateway, ros) -> None:
    assert len(says(gateway(serve().endpoint), "no sample of legs lf, rf yet")) == 1
