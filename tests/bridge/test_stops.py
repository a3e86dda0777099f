"""What a driven robot does when commands stop, when the service dies, and when it is back.

With a controller of the test's own, and with the example's, as docs/bridge.md has it.
"""

from __future__ import annotations

import itertools
import queue
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from described import AX, goals_written

from adaptive_contact.robot.write import write_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import BridgeStatus, Command, command_key, decode
from adaptive_contact.wire.received import Received
from programs import Program
from waiting import until

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(240)]


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


def test_a_leg_is_held_when_commands_stop_or_the_service_dies_and_goes_on_gently_after(
    rig: Callable, start: Callable[..., Program], tmp_path: Path
) -> None:
    r = rig(**AX)
    (tmp_path / "robot.toml").write_text(write_robot(r.robot))
    robot = str(tmp_path / "robot.toml")
    service = start("serve", "--config", robot, "--listen", "tcp/127.0.0.1:0")
    endpoint = service.wait_line(r"listening on (tcp/\S+?)[;,]")[1]
    bridge = start("bridge", "dynamixel", "--drive", "--config", robot, "--connect", endpoint)
    bridge.next_line("driving 6 servos")
    servo = r.servo(1)
    centre, goals = servo.model.centre, goals_written(servo)
    with Link.open(client_settings([endpoint])) as link:
        commands, statuses = Commands(link, [0.4] * 3), queue.SimpleQueue[Received]()
        link.subscribe("robot/bridge/*/status", statuses.put)
        try:
            there = centre + round(0.4 / servo.model.step_rad)
            until(lambda: goals and goals[-1] == there)
            told = statuses.get(timeout=60.0)
            status = decode(told.payload, BridgeStatus, told.encoding)
            assert (status.port, status.mode) == ("p0", "drive")
            commands.goal = None
            bridge.next_line("leg l0: no command for 200 ms, holding the last goal")
            written = len(goals)
            commands.goal = [0.4] * 3
            bridge.next_line("leg l0: commands are back")
            until(lambda: len(goals) > written + 5)
            # The service is the router too: nothing arrives any more.
            service.stop(signal.SIGKILL)
            bridge.next_line("leg l0: no command for 200 ms, holding the last goal")
            held, written = servo.value("goal_position"), len(goals)
            assert held == there
            assert servo.drives
            commands.goal = [0.2] * 3  # to nobody yet
            start("serve", "--config", robot, "--listen", endpoint).next_line("listening on")
            bridge.next_line("leg l0: commands are back")
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
    bridge.stop()
    assert servo.drives
    assert servo.value("goal_position") == aim
