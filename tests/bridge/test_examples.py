"""The examples as their users run them; test_documents.py has the loop of the gait controller."""

from __future__ import annotations

import contextlib
import itertools
import math
import runpy
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from adaptive_contact.robot import foot, shipped_robot
from adaptive_contact.robot.write import write_robot
from adaptive_contact.service.link import Link, Publisher, router_settings
from adaptive_contact.wire import (
    HEARTBEAT,
    MSGPACK,
    Command,
    ContactEvent,
    ServoSample,
    command_key,
    contact_key,
    decode,
    servo_key,
)
from adaptive_contact.wire.received import Received
from programs import Program
from waiting import Every, until

EXAMPLES = Path(__file__).parents[2] / "examples"
MODEL = EXAMPLES.parent / "models" / "adaptive_contact_models" / "hexapod" / "robot.toml"


@pytest.mark.parametrize(("robot", "leg"), [("hexapod", "rf"), ("quadruped", "fl")])
def test_the_gait_controller_places_feet_of_three_joints_and_of_two(robot: str, leg: str) -> None:
    described = shipped_robot(robot).leg(leg)
    wanted = np.array([0.6 * sum(described.lengths_m), 0.0, -0.05])
    joints = runpy.run_path(str(EXAMPLES / "gait_controller.py"))["angles"](described, wanted)
    assert foot(joints, described.lengths_m, described.joint_axes) == pytest.approx(wanted)


def ended(program: Program, code: int) -> str:
    """What a program that ends by itself has said; a traceback is none of it."""
    with contextlib.closing(program):
        assert program.wait(600) == code, program.lines
    said = "\n".join(program.lines)
    assert "Traceback" not in said
    return said


def begin(example: str, *words: str) -> Program:
    return Program(EXAMPLES / example, *words)


SCRIPTS = sorted(path.name for path in EXAMPLES.glob("*.py"))


@pytest.mark.e2e
@pytest.mark.parametrize("example", SCRIPTS)
def test_an_example_explains_itself_and_refuses_what_it_does_not_know(example: str) -> None:
    assert "usage: " in ended(begin(example, "--help"), 0)
    assert ": error: " in ended(begin(example, "--nosuch"), 2)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--leg", "zz"), "has no leg 'zz'"),
        (("--config", "/nonexist.toml"), "cannot be read"),
        (("--zenoh-config", "/nonexist.json5"), "/nonexist.json5"),
        (("--namespace", "a b"), "namespace 'a b' cannot be part of a key"),
    ],
)
def test_the_gait_controller_says_in_one_line_what_is_wrong(
    words: tuple[str, ...], message: str
) -> None:
    said = ended(begin("gait_controller.py", *words), 2)
    assert message in said
    assert "\n" not in said


@pytest.mark.e2e
def test_the_gait_controller_without_a_bridge() -> None:
    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
        said = ended(begin("gait_controller.py", "--connect", link.endpoints[0]), 2)
    assert said.startswith("gait_controller: no sample of leg 'rf' for 5 s; run")
    assert "\n" not in said


@pytest.mark.e2e
def test_a_bridge_without_a_router_says_so(
    rig: Callable, start: Callable[..., Program], tmp_path: Path
) -> None:
    r = rig(model="AX-12A", protocol=1)
    (tmp_path / "robot.toml").write_text(write_robot(r.robot))
    words = ("--config", "robot.toml", "--connect", "tcp/127.0.0.1:1")
    bridge = start("bridge", "dynamixel", *words)
    bridge.wait_line("port p0: unreachable: nobody listens on")
    assert bridge.stop() == 0


def event(leg: str, t_ns: int, *, contact: bool, **more: object) -> ContactEvent:
    return ContactEvent(
        leg=leg, t_ns=t_ns, onset_ns=t_ns - 13_000_000, seq=2**40, contact=contact, score=1.5,
        status="valid", residual=[0.25, -1e-9, 3.0], model_version=70_000, **more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def contacts_in_c(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """``examples/contacts.c`` compiled as its comment says, with all warnings as errors."""
    compiler, config = shutil.which("cc"), shutil.which("pkg-config")
    if compiler is None or config is None:
        pytest.skip("no C compiler, or no pkg-config, on this computer")
    asked = subprocess.run([config, "--cflags", "--libs", "zenohpico"], capture_output=True)
    if asked.returncode != 0:
        pytest.skip("zenoh-pico is not installed: pkg-config knows no zenohpico")
    flags = asked.stdout.decode().split()
    made = str(tmp_path_factory.mktemp("c") / "contacts")
    paths = [f"-Wl,-rpath,{flag[2:]}" for flag in flags if flag.startswith("-L")]
    subprocess.run(
        [compiler, "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-DZENOH_LINUX",
         str(EXAMPLES / "contacts.c"), *flags, *paths, "-o", made],
        check=True,
    )  # fmt: skip
    return [made]


Reading = tuple[Link, Publisher, Callable[[], str]]


@pytest.fixture
def reading_in_c(contacts_in_c: list[str]) -> Iterator[Reading]:
    """A router that has an event, whose publisher, and the next line of the subscriber in C."""
    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
        contacts = link.publisher(contact_key("rf"), reliable=True, history=1)
        contacts.put(event("rf", 1_040_000_000, contact=True))
        process = subprocess.Popen(
            [*contacts_in_c, link.endpoints[0]],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        try:
            yield link, contacts, process.stdout.readline
        finally:
            process.kill()
            process.wait(60)
            process.stdout.close()


@pytest.mark.e2e
def test_the_subscriber_in_c_prints_contacts(reading_in_c: Reading) -> None:
    _, contacts, line = reading_in_c

    def said() -> str:
        """The next line but those on a leg that is not known: nothing beats here."""
        while "known" in (words := line()):
            pass
        return words

    assert "listening to robot/leg/*/contact" in said()
    assert said() == "rf touches at 1.040 s, score 1.5\n"  # though it came later
    contacts.put(event("rf", 2**62, contact=False))
    assert said() == f"rf lets go at {2**62 // 10**9}.427 s, score 1.5\n"
    contacts.put(event("rf", 2**62 + 10**9, contact=False, withheld=True, doubt="held"))
    assert " is withheld at " in said()
    contacts.put_raw(msgspec.msgpack.encode({"v": 1, "leg": "rf"}), MSGPACK)
    assert "is no contact event" in said()


@pytest.mark.e2e
def test_no_contact_outlives_its_source_in_c(reading_in_c: Reading) -> None:
    """A leg is not known where heartbeats call it old, lack it, are broken, or end."""
    link, _, line = reading_in_c
    heartbeats = link.publisher(HEARTBEAT)

    def beat_until(words: str, legs: object) -> None:
        beat = msgspec.msgpack.encode({"v": 1, "legs": legs})
        with contextlib.closing(Every(0.1, lambda: heartbeats.put_raw(beat, MSGPACK))):
            assert line() == words

    young = {"t_ns": 1, "age_s": 0.02, "contact": True}
    old = [{"rf": {**young, "age_s": age}} for age in (0.6, 7, -1.0, math.nan)]
    assert "listening" in line()
    assert line() == "rf touches at 1.040 s, score 1.5\n"
    assert line() == "rf is not known\n"  # nothing beats
    for legs in (*old, {}, {"rf": 3}, {"rf": {}}, {"r\x1bf": young}, [1], None):
        beat_until("rf is known again\n", {"rf": young})
        beat_until("rf is not known\n", legs)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("tcp/127.0.0.1:1",), "contacts: no router at tcp/127.0.0.1:1; start"),
        (("tcp/127.0.0.1:1", "a//b"), "contacts: 'a//b' is no key; give one such as"),
    ],
)
def test_the_subscriber_in_c_says_in_one_line_what_is_wrong(
    contacts_in_c: list[str], words: tuple[str, ...], message: str
) -> None:
    ended = subprocess.run([*contacts_in_c, *words], capture_output=True, text=True, timeout=40)
    assert ended.returncode == 2
    assert ended.stderr.startswith(message)
    assert ended.stderr.count("\n") == 1


class FakeBridge(Every):
    """Samples of one leg at 50 Hz, whose servos are where they were sent a tick before."""

    def __init__(self, link: Link, leg: str) -> None:
        self.commands: list[list[float]] = []
        self._out = link.publisher(servo_key(leg))
        self._seqs = itertools.count()
        link.subscribe(command_key(leg), self._command)
        super().__init__(0.02, self._tick)

    def _command(self, received: Received) -> None:
        command = decode(received.payload, Command, received.encoding)
        self.commands.append(list(command.desired))

    def _tick(self) -> None:
        at = [[0.0, 0.5, -1.6], *self.commands[-1:]][-1]
        t_ns = time.monotonic_ns()
        self._out.put(ServoSample(t_ns=t_ns, seq=next(self._seqs), measured=at, desired=at))


@pytest.mark.slow
@pytest.mark.e2e
def test_the_gait_controller_holds_still_while_serve_is_dead(
    start: Callable[..., Program],
) -> None:
    """`serve` is killed while a leg steps: it is held where it is, and steps again once there is a
    service to say that a foot touches, from the top."""
    leg = shipped_robot().leg("rf")

    def service() -> Program:
        # Without a baseline it reports no contact.
        words = ("--no-state", "--connect", link.endpoints[0], "--config", str(MODEL))
        serve = start("serve", *words)
        serve.wait_line("connected to")
        return serve

    def height(goal: list[float]) -> float:
        return float(foot(goal, leg.lengths_m, leg.joint_axes)[2])

    def steps() -> list[float]:
        heights = [height(goal) for goal in bridge.commands[-4:]]
        return [after - before for before, after in itertools.pairwise(heights)]

    with (
        Link.open(router_settings(["tcp/127.0.0.1:0"])) as link,
        contextlib.closing(FakeBridge(link, "rf")) as bridge,
    ):
        serve = service()
        words = ("--steps", "1000", "--connect", link.endpoints[0])
        controller = start(str(EXAMPLES / "gait_controller.py"), *words)
        controller.next_line("step 1: ")
        until(lambda: min(steps()) > 0.0)
        until(lambda: max(steps()) < 0.0)
        serve.stop(signal.SIGKILL)
        controller.next_line("no service reports contacts; holding still until one does")
        # What was commanded before it noticed may still be on its way.
        begun = len(bridge.commands) + 10
        until(lambda: len(bridge.commands) >= begun + 50)
        assert controller.process.poll() is None
        held = bridge.commands[begun:]
        assert all(goal == held[0] for goal in held)
        service()
        controller.next_line("step 2: ")
        assert max(map(height, bridge.commands[begun:])) > height(held[0]) + 0.01
