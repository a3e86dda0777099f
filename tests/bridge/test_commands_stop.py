"""The gait controller's example and a real bridge: commands stop, `serve` dies, both come back.

As docs/bridge.md has it, with a process for each program, the network between them, and a virtual
bus that is looked at where its servos are.
"""

from __future__ import annotations

import os
import queue
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

pytestmark = pytest.mark.e2e

EXAMPLE = Path(__file__).parents[2] / "examples" / "gait_controller.py"
SERVOS = (1, 2, 3)


class Program:
    """A process whose lines are waited for."""

    def __init__(self, *words: str, cwd: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-u", *words],
            cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "XDG_STATE_HOME": str(cwd)},
        )  # fmt: skip
        self.said: list[str] = []
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._pump, daemon=True)
        self._reader.start()

    def _pump(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.append(line)
            self._lines.put(line)
        self._lines.put(None)

    def until(self, words: str, timeout_s: float = 40.0) -> str:
        """The next line with these words."""
        end = time.monotonic() + timeout_s
        while (line := self._lines.get(timeout=max(end - time.monotonic(), 0.01))) is not None:
            if words in line:
                return line
        raise AssertionError(f"ended before it said '{words}': {self.said}")

    def send(self, number: int) -> None:
        self.process.send_signal(number)

    def close(self) -> None:
        self.process.terminate()  # and not killed: a bridge ends its ports' processes
        self.process.wait(20)
        self._reader.join(10)
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    running: list[Program] = []

    def begin(*words: str) -> Program:
        running.append(Program(*words, cwd=tmp_path))
        return running[-1]

    yield begin
    for program in reversed(running):
        program.close()


@pytest.fixture
def rig_that_steps(rig: Callable[..., Any], tmp_path: Path) -> Any:
    """A leg that the controller can step with; its description is robot.toml."""
    made = rig(model="AX-12A", protocol=1, legs=1)
    [leg] = made.robot.legs
    limits = Limits(lower_rad=(-2.5,) * 3, upper_rad=(2.5,) * 3)
    leg = msgspec.structs.replace(leg, lengths_m=(0.052, 0.066, 0.133), limits=limits)
    robot = msgspec.structs.replace(made.robot, legs=(leg,))
    (tmp_path / "robot.toml").write_text(write_robot(robot))
    return made


def goals(rig: Any) -> list[int]:
    return [rig.servo(number).value("goal_position") for number in SERVOS]


def wait_for(true: Callable[[], bool], what: str, timeout_s: float = 40.0) -> None:
    end = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < end, f"not within {timeout_s} s: {what}"
        time.sleep(0.005)


def moves(rig: Any) -> None:
    """Wait until the leg's goals change."""
    before = goals(rig)
    wait_for(lambda: goals(rig) != before, "a goal that moves")


def holds(rig: Any) -> None:
    """For half a second of the bridge's requests no goal is written, and torque stays on."""
    held, until = goals(rig), rig.requests + 25
    while rig.requests < until:
        assert goals(rig) == held
        time.sleep(0.005)
    assert all(rig.servo(number).torque for number in SERVOS)


@pytest.mark.timeout(120)
def test_a_leg_is_held_while_nobody_commands_it_and_goes_on_after(
    rig_that_steps: Any, start: Callable[..., Program]
) -> None:
    rig, module = rig_that_steps, ("-m", "adaptive_contact")

    def serve(where: str) -> Program:
        return start(*module, "serve", "--no-state", "--config", "robot.toml", "--listen", where)

    def control() -> Program:
        where = ("--connect", endpoint, "--config", "robot.toml", "--leg", "l0")
        return start(str(EXAMPLE), *where, "--steps", "1000")

    service = serve("tcp/127.0.0.1:0")
    endpoint = service.until("listening on").split("listening on ")[1].split(";")[0].strip()
    bridge = start(
        *module, "bridge", "dynamixel", "--config", "robot.toml", "--drive", "--connect", endpoint
    )
    bridge.until("stop with Ctrl-C")
    controller = control()
    moves(rig)

    # Commands stop: the controller hangs.
    controller.send(signal.SIGSTOP)
    bridge.until("leg l0: no command for 200 ms, holding the last goal")
    holds(rig)
    controller.send(signal.SIGCONT)
    bridge.until("leg l0: commands are back")
    moves(rig)

    # `serve`, the router, dies: the bridge holds, and the controller commands nothing more.
    service.send(signal.SIGKILL)
    bridge.until("leg l0: no command for 200 ms, holding the last goal")
    controller.until("no sample of leg 'l0' for 1 s")
    assert controller.process.wait(20) == 2
    holds(rig)
    service = serve(endpoint)
    service.until("listening on")
    controller = control()
    bridge.until("leg l0: commands are back")
    moves(rig)
