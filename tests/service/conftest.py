"""Real Zenoh on loopback with free ports; the service in a process of its own where it says so."""

from __future__ import annotations

import contextlib
import itertools
import re
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.sample_queue import Batch
from adaptive_contact.service.server import Service
from adaptive_contact.status import SERVICE_STATUS
from adaptive_contact.wire import (
    MSGPACK,
    LearnerStatus,
    Message,
    ServoSample,
    decode,
    encode,
    learner_key,
    servo_key,
)
from adaptive_contact.wire.received import Received
from programs import Program, tried
from waiting import until

sys.path.insert(0, str(Path(__file__).parent))  # the helpers beside the tests
import fake_service

ROBOT = """
[robot]
name = "mini"
period_s = 0.02
quantum_rad = 0.00511
[ros2]
state = "/legs/controller_state"
[[leg]]
id = "lf"
joints = ["coxa", "femur", "tibia"]
ros2 = { joints = ["lf_coxa", "lf_femur", "lf_tibia"] }
[[leg]]
id = "rf"
joints = ["coxa", "femur", "tibia"]
ros2 = { joints = ["rf_coxa", "rf_femur", "rf_tibia"] }
"""


class Inbox:
    """A sink that can be waited on; of a kind of messages it keeps them decoded."""

    def __init__(self, kind: type[Message] | None = None) -> None:
        self.items: list[Any] = []
        self._kind = kind

    def __call__(self, *item: Any) -> None:
        one = item[0] if len(item) == 1 else item
        if self._kind is not None:
            one = decode(one.payload, self._kind, one.encoding)
        self.items.append(one)

    def subscribe(self, link: Link, key: str, *, history: bool = False) -> Inbox:
        link.subscribe(key, self, history=history)
        return self

    def wait(self, enough: Callable[[list[Any]], bool] | int, timeout_s: float = 60.0) -> list[Any]:
        """Wait until there are so many items, or the items are enough; fails after the timeout."""
        test = enough if callable(enough) else lambda items: len(items) >= enough
        until(
            lambda: self.items and test(self.items),
            lambda: f"there are {len(self.items)} items: {self.items[-3:]}",
            timeout_s,
        )
        return list(self.items)


class Served(Program):
    """A service with the fake learner in a process of its own."""

    def __init__(self, *words: object, log: Path, wait: bool) -> None:
        self.log = log
        with log.open("w") as stderr:
            super().__init__(fake_service.__file__, "--save-often", *words, stderr=stderr)
        self.ready = self.wait_line("").string if wait else ""
        self.endpoint = self.ready.partition("listening on ")[2].partition(";")[0]


@pytest.fixture
def robot() -> Robot:
    return parse_robot(ROBOT, source="test")


@pytest.fixture
def join() -> Iterator[Callable[..., Link]]:
    """Opens clients of an endpoint, and closes them after the test."""
    links: list[Link] = []

    def open_(endpoint: str, **settings: Any) -> Link:
        link = Link.open(client_settings([endpoint], **{"wait": False, **settings}))
        links.append(link)
        return link

    yield open_
    for link in links:
        assert link.close()


class Lockstep:
    """A service in this process with a fake learner, and a client of it; driven by hand."""

    def __init__(self, link: Link, client: Link, robot: Robot, **of: Any) -> None:
        self.bank = fake_service.FakeBank(robot)
        self.service = Service(link, self.bank, robot, baseline=None, now_ns=0, **of)
        self.client = client
        self.now_ns = 0

    def settle(self) -> None:
        """A round trip: what the client has declared is known to the service after it."""
        self.client.query(SERVICE_STATUS)

    def statuses(self, inbox: Any, leg: str = "rf") -> Any:
        """What the client gets of a leg's status from now on."""
        got = inbox(LearnerStatus).subscribe(self.client, learner_key(leg))
        self.settle()
        return got

    def process(self, now_ns: int, /, **samples: ServoSample | bytes) -> None:
        payloads = {
            leg: sent if isinstance(sent, bytes) else encode(sent) for leg, sent in samples.items()
        }
        raws = {
            leg: Received(servo_key(leg), payload, MSGPACK, now_ns, None)
            for leg, payload in payloads.items()
        }
        self.service.process_batch(Batch(samples=raws), now_ns)
        self.service.complete_batch()
        self.service.publish_due(now_ns)

    def deliver(self, *samples: ServoSample) -> None:
        """One sample of leg rf per control tick."""
        for sample in samples:
            self.now_ns += 20_000_000
            self.process(self.now_ns, rf=sample)

    def idle(self, ticks: int) -> None:
        """Control ticks without a sample."""
        for _ in range(ticks):
            self.now_ns += 20_000_000
            self.process(self.now_ns)


@pytest.fixture
def lockstep(join: Callable[..., Link], robot: Robot) -> Callable[..., Lockstep]:
    return lambda link, **of: Lockstep(link, join(link.endpoints[0]), robot, **of)


@pytest.fixture
def inbox() -> Callable[..., Inbox]:
    return Inbox


@pytest.fixture
def beside_a_source(monkeypatch: pytest.MonkeyPatch, router: Link) -> Iterator[Callable[..., Any]]:
    """Runs a command beside a source that publishes all samples; ends when they are taken in."""
    from adaptive_contact.cli import _options

    threads: list[threading.Thread] = []

    def run(samples: list[tuple[str, ServoSample]], *words: str) -> Any:
        stop, left, subscribe = threading.Event(), [len(samples)], Link.subscribe

        def counting(self: Link, key: str, sink: Callable[..., None]) -> Any:
            def counted(one: Any) -> None:
                sink(one)
                left[0] -= one.key.endswith("/servo")
                if left[0] == 0:
                    stop.set()

            return subscribe(self, key, counted)

        monkeypatch.setattr(Link, "subscribe", counting)
        monkeypatch.setattr(_options, "stoppable", lambda: stop)
        publishers = {leg: router.publisher(servo_key(leg), reliable=True) for leg in dict(samples)}

        def publish() -> None:
            while not all(each.matched for each in publishers.values()) and not stop.wait(0.01):
                pass
            for leg, one in samples:
                publishers[leg].put(one)

        threads.append(threading.Thread(target=publish))
        threads[-1].start()
        result = tried(*words, "--connect", router.endpoints[0])
        stop.set()
        return result

    yield run
    for thread in threads:
        thread.join(10)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """The robot's file."""
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return path


@pytest.fixture
def serve(tmp_path: Path, config: Path) -> Iterator[Callable[..., Served]]:
    """Starts `serve` with the fake learner in a process of its own."""
    count = itertools.count()
    with contextlib.ExitStack() as running:

        def start(*args: str, wait: bool = True) -> Served:
            log = tmp_path / f"serve{next(count)}.log"
            where = () if {"--connect", "--listen"} & set(args) else ("--listen", "127.0.0.1:0")
            state = () if "--state" in args else ("--no-state",)
            served = Served("--config", config, *where, *args, *state, log=log, wait=wait)
            return running.enter_context(contextlib.closing(served))

        yield start


@pytest.fixture
def sample() -> Callable[..., ServoSample]:
    """A sample of a three-joint leg; ``contact`` is what the fake learner takes for one."""

    def make(seq: int, *, contact: bool = False, **fields: Any) -> ServoSample:
        return ServoSample(
            **{
                "t_ns": seq * 20_000_000,
                "seq": seq,
                "measured": [0.5 if contact else 0.0, 0.1, 0.2],
                "desired": [0.0, 0.1, 0.2],
                **fields,
            }
        )

    return make


class Users(NamedTuple):
    """Files of the documented set of users."""

    service: Path
    robot: Path
    viewer: Path
    stranger: Path


@pytest.fixture
def users(tmp_path: Path) -> Users:
    """As docs/security.md has them; the stranger has mistyped the robot's password."""
    text = (Path(__file__).parents[2] / "docs/security.md").read_text(encoding="utf-8")
    service, robot = re.findall(r"```json5\n(.*?)```", text, re.DOTALL)[:2]
    (names,) = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    (tmp_path / "users").write_text(names)
    files = Users(*(tmp_path / f"{name}.json5" for name in Users._fields))
    own = str(tmp_path / "users")
    files.service.write_text(service.replace("/etc/adaptive-contact/users", own))
    files.robot.write_text(robot)
    viewer = robot.replace('"robot"', '"viewer"').replace("CHANGE-ME-2", "CHANGE-ME-3")
    files.viewer.write_text(viewer)
    files.stranger.write_text(robot.replace("CHANGE-ME-2", "CHANGE-MY-2"))
    return files
