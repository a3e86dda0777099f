"""Real Zenoh on loopback with free ports; the service in a process of its own where it says so."""

from __future__ import annotations

import contextlib
import importlib
import itertools
import re
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import pytest

from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import Message, ServoSample, decode, servo_key
from programs import Program, tried
from waiting import until

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))  # the helpers beside the tests

ROBOT = """
[robot]
name = "mini"
period_s = 0.02
quantum_rad = 0.00511
[[leg]]
id = "lf"
joints = ["coxa", "femur", "tibia"]
[[leg]]
id = "rf"
joints = ["coxa", "femur", "tibia"]
"""


class Inbox:
    """A sink that can be waited on."""

    def __init__(self) -> None:
        self.items: list[Any] = []

    def __call__(self, *item: Any) -> None:
        self.items.append(item[0] if len(item) == 1 else item)

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


class MessageInbox(Inbox):
    """Keeps decoded messages of one kind."""

    def __init__(self, kind: type[Message]) -> None:
        super().__init__()
        self._kind = kind

    def __call__(self, *item: Any) -> None:
        received = item[0]
        super().__call__(decode(received.payload, self._kind, received.encoding))


class Served(Program):
    """A service with the fake learner in a process of its own."""

    def __init__(self, *words: object, log: Path, wait: bool) -> None:
        self.log = log
        with log.open("w") as stderr:
            super().__init__(HERE / "fake_service.py", "--save-often", *words, stderr=stderr)
        self.ready = self.wait_line("").string if wait else ""
        self.endpoint = self.ready.partition("listening on ")[2].partition(";")[0]


@pytest.fixture(scope="session")
def fake() -> ModuleType:
    return importlib.import_module("fake_service")


@pytest.fixture(scope="session")
def rig() -> ModuleType:
    return importlib.import_module("rig")


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


@pytest.fixture
def inbox() -> Callable[..., Inbox]:
    return lambda kind=None: Inbox() if kind is None else MessageInbox(kind)


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
    text = (HERE.parents[1] / "docs/security.md").read_text(encoding="utf-8")
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
