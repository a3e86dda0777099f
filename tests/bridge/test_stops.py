"""What a driven robot does when commands stop, when the service dies, and when it is back.

With a controller of the test's own, and with the example's, as docs/bridge.md has it.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from adaptive_contact.robot import Limits
from adaptive_contact.robot.write import write_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import Command, command_key

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(240)]

AX = {"model": "AX-12A", "protocol": 1}
EXAMPLE = str(Path(__file__).parents[2] / "examples" / "gait_controller.py")


class Program:
    """A process of Python, and all lines that it has said."""

    def __init__(self, state: Path, *words: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-u", *words],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "XDG_STATE_HOME": str(state)},
        )  # fmt: skip
        self.lines: list[str] = []
        self._new: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._pump, daemon=True)
        self._reader.start()

    def _pump(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line)
            self._new.put(line)
        self._new.put(None)

    def wait(self, pattern: str, timeout_s: float = 40.0) -> str:
        """The next line that matches."""
        end = time.monotonic() + timeout_s
        while True:
            line = self._new.get(timeout=max(end - time.monotonic(), 0.01))
            assert line is not None, f"ended: {self.lines}"
            found = re.search(pattern, line)
            if found:
                return found[found.lastindex or 0]

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    @property
    def ended(self) -> bool:
        return self._process.poll() is not None

    def code(self, timeout_s: float = 20.0) -> int:
        """Wait for its end; its exit code."""
        return self._process.wait(timeout_s)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(60)
        self.kill()
        self._reader.join(10)
        assert self._process.stdout is not None
        self._process.stdout.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    running: list[Program] = []

    def make(*words: str) -> Program:
        """A command of ours, or an example."""
        module = () if words[0].endswith(".py") else ("-m", "adaptive_contact")
        running.append(Program(tmp_path, *module, *words))
        return running[-1]

    yield make
    for program in reversed(running):
        program.end()


class Commands:
    """Commands of one leg at 50 Hz, from a thread, until told otherwise."""

    def __init__(self, link: Link, goal: list[float]) -> None:
        self.goal: list[float] | None = goal
        self._publisher = link.publisher(command_key("l0"))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.02):
            goal = self.goal
            if goal is not None:
                self._publisher.put(Command(desired=goal))

    def end(self) -> None:
        self._stop.set()
        self._thread.join(5)


def until(true: Callable[[], Any], *watched: Program, timeout_s: float = 40.0) -> None:
    end = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < end, [program.lines for program in watched]
        threading.Event().wait(0.01)


def test_a_leg_is_held_when_commands_stop_or_the_service_dies_and_goes_on_gently_after(
    rig: Callable, start: Callable[..., Program], tmp_path: Path
) -> None:
    r = rig(**AX)
    (tmp_path / "robot.toml").write_text(write_robot(r.robot))
    robot = str(tmp_path / "robot.toml")
    service = start("serve", "--config", robot, "--listen", "tcp/127.0.0.1:0")
    endpoint = service.wait(r"listening on (tcp/\S+?)[;,]")
    bridge = start("bridge", "dynamixel", "--drive", "--config", robot, "--connect", endpoint)
    bridge.wait("driving 6 servos")
    servo = r.servo(1)
    centre, goals = servo.model.centre, []
    write = servo.write

    def spy(address: int, data: bytes) -> Any:
        if address == servo.model.registers["goal_position"].address:
            goals.append(int.from_bytes(data, "little"))
        return write(address, data)

    servo.write = spy
    with Link.open(client_settings([endpoint])) as link:
        commands = Commands(link, [0.4] * 3)
        try:
            there = centre + round(0.4 / servo.model.step_rad)
            until(lambda: goals and goals[-1] == there)
            commands.goal = None
            bridge.wait("leg l0: no command for 200 ms, holding the last goal")
            written = len(goals)
            commands.goal = [0.4] * 3
            bridge.wait("leg l0: commands are back")
            until(lambda: len(goals) > written + 5)
            # The service is the router too: nothing arrives any more.
            service.kill()
            bridge.wait("leg l0: no command for 200 ms, holding the last goal")
            held, written = servo.value("goal_position"), len(goals)
            assert held == there
            assert servo.drives
            commands.goal = [0.2] * 3  # to nobody yet
            start("serve", "--config", robot, "--listen", endpoint).wait("listening on")
            bridge.wait("leg l0: commands are back")
            aim = centre + round(0.2 / servo.model.step_rad)
            until(lambda: goals[-1] == aim)
        finally:
            commands.end()
    after = goals[written:]
    easy = 0.15 / 5 / servo.model.step_rad
    assert abs(after[0] - held) <= easy + 1  # from where it was held, at the easy pace
    assert min(after) >= aim - 1
    assert all(abs(b - a) <= easy + 1 for a, b in itertools.pairwise(after))
    # At its end the bridge leaves the torque on: a standing robot does not fall.
    bridge.end()
    assert servo.drives
    assert servo.value("goal_position") == aim


def test_the_gait_controller_goes_on_after_it_hung_and_commands_nothing_without_samples(
    rig: Callable, start: Callable[..., Program], tmp_path: Path
) -> None:
    """What acts on contacts, in place of the commands above; `serve` is the router again."""
    r = rig(**AX, legs=1)
    [leg] = r.robot.legs
    limits = Limits(lower_rad=(-2.5,) * 3, upper_rad=(2.5,) * 3)
    leg = msgspec.structs.replace(leg, lengths_m=(0.052, 0.066, 0.133), limits=limits)
    robot = str(tmp_path / "robot.toml")
    Path(robot).write_text(write_robot(msgspec.structs.replace(r.robot, legs=(leg,))))
    servos = [r.servo(number) for number in (1, 2, 3)]

    def goals() -> list[int]:
        return [servo.value("goal_position") for servo in servos]

    def moves() -> None:
        """Goals change; a controller that a busy computer kept from its samples starts again."""
        nonlocal controller
        before = goals()

        def moved() -> bool:
            nonlocal controller
            if controller.ended:
                controller = start(*steps)
            return goals() != before

        until(moved, bridge, controller)

    def holds() -> None:
        """Goals come to rest, for 20 of the bridge's requests, and torque stays on."""
        held, enough = goals(), r.requests + 20

        def rest() -> bool:
            nonlocal held, enough
            if goals() != held:  # a line from before, or commands that were on their way
                held, enough = goals(), r.requests + 20
            return r.requests >= enough

        until(rest, bridge)
        assert all(servo.drives for servo in servos)

    service = start("serve", "--no-state", "--config", robot, "--listen", "tcp/127.0.0.1:0")
    endpoint = service.wait(r"listening on (tcp/\S+?)[;,]")
    bridge = start("bridge", "dynamixel", "--drive", "--config", robot, "--connect", endpoint)
    steps = (EXAMPLE, "--config", robot, "--leg", "l0", "--connect", endpoint, "--steps", "99")
    controller = start(*steps)  # waits for samples
    bridge.wait("driving 3 servos")
    moves()

    controller.send(signal.SIGSTOP)
    bridge.wait("leg l0: no command for 200 ms, holding the last goal")
    holds()
    controller.send(signal.SIGCONT)
    moves()
    bridge.wait("leg l0: commands are back")

    service.kill()
    controller.wait("gait_controller: no sample of leg 'l0' for 1 s")
    assert controller.code() == 2
    bridge.wait("leg l0: no command for 200 ms, holding the last goal")
    holds()
    start("serve", "--no-state", "--config", robot, "--listen", endpoint)
    controller = start(*steps)  # waits for the router, too
    moves()
    bridge.wait("leg l0: commands are back")
