"""What a driven robot does when commands stop, when the service dies, and when it is back.

With a controller of the test's own, and with the example's, as docs/bridge.md has it.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from described import AX, goals_written

from adaptive_contact.robot.write import write_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import BridgeStatus, Command, command_key, decode
from adaptive_contact.wire.received import Received
from programs import Program
from waiting import Every, until

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(240)]


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
        publisher, statuses = link.publisher(command_key("l0")), queue.SimpleQueue[Received]()
        link.subscribe("robot/bridge/*/status", statuses.put)
        command: list[float] | None = [0.4] * 3

        def publish() -> None:
            if command is not None:
                publisher.put(Command(desired=command))

        with contextlib.closing(Every(0.02, publish)):
            there = centre + round(0.4 / servo.model.step_rad)
            until(lambda: goals and goals[-1] == there)
            told = statuses.get(timeout=60.0)
            status = decode(told.payload, BridgeStatus, told.encoding)
            assert (status.port, status.mode) == ("p0", "drive")
            command = None
            bridge.next_line("leg l0: no command for 200 ms, holding the last goal")
            written = len(goals)
            command = [0.4] * 3
            bridge.next_line("leg l0: commands are back")
            until(lambda: len(goals) > written + 5)
            # The service is the router too: nothing arrives any more.
            service.stop(signal.SIGKILL)
            bridge.next_line("leg l0: no command for 200 ms, holding the last goal")
            held, written = servo.value("goal_position"), len(goals)
            assert held == there
            assert servo.drives
            command = [0.2] * 3  # to nobody yet
            start("serve", "--config", robot, "--listen", endpoint).next_line("listening on")
            bridge.next_line("leg l0: commands are back")
            aim = centre + round(0.2 / servo.model.step_rad)
            until(lambda: goals[-1] == aim)
    after = goals[written:]
    easy = 0.15 / 5 / servo.model.step_rad
    assert abs(after[0] - held) <= easy + 1  # from where it was held, at the easy pace
    assert min(after) >= aim - 1
    assert all(abs(b - a) <= easy + 1 for a, b in itertools.pairwise(after))
    # At its end the bridge leaves the torque on: a standing robot does not fall.
    bridge.stop()
    assert servo.drives
    assert servo.value("goal_position") == aim
