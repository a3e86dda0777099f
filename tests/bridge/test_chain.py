"""The whole chain in processes of its own: simulator, virtual bus, DynamixelSDK, bridge, Zenoh,
service, contact events; scored against the simulator's truth."""

from __future__ import annotations

import contextlib
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

import pytest

from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    BridgeStatus,
    Command,
    ContactEvent,
    LearnerStatus,
    ServoSample,
    command_key,
    decode,
    servo_key,
)
from waiting import until

pytestmark = pytest.mark.e2e
# Real time on pseudo-terminals: run by `make test-all`, on a machine with nothing else to do.
slow = pytest.mark.slow

READY = "stop with Ctrl-C"


class Process:
    """A command of ours; ready when it says how to stop it."""

    def __init__(self, *arguments: str, cwd: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-u", "-m", "adaptive_contact", *arguments],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "XDG_STATE_HOME": str(cwd)},
        )
        self._lines: queue.Queue[str | None] = queue.Queue()
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._pump, daemon=True)
        self._reader.start()

    def _pump(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.said.append(line)
            self._lines.put(line)
        self._lines.put(None)

    def ready(self, timeout_s: float = 300.0) -> str:
        deadline = time.monotonic() + timeout_s
        while True:
            line = self._lines.get(timeout=max(deadline - time.monotonic(), 0.01))
            assert line is not None, "".join(self.said)
            if READY in line:
                return line

    def workers(self) -> list[int]:
        """Processes that this one has spawned, the ports'."""
        found = []
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            with contextlib.suppress(OSError):
                parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
                words = (entry / "cmdline").read_bytes()
                if int(parent) == self._process.pid and b"spawn_main" in words:
                    found.append(int(entry.name))
        return sorted(found)

    def wait(self, timeout_s: float) -> int:
        return self._process.wait(timeout_s)

    def stop(self) -> int:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()
        code = self._process.wait()
        self._reader.join(10)
        assert self._process.stdout is not None
        self._process.stdout.close()
        return code


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Process]]:
    running: list[Process] = []

    def begin(*arguments: str) -> Process:
        running.append(Process(*arguments, cwd=tmp_path))
        return running[-1]

    yield begin
    for process in reversed(running):
        process.stop()


def router(start: Callable[..., Process]) -> str:
    serve = start("serve", "--listen", "tcp/127.0.0.1:0", "--no-state")
    return serve.ready().split("listening on ")[1].split(";")[0].split(",")[0].strip()


def bridge_to(start: Callable[..., Process], *words: str) -> Process:
    """A bridge that is ready, begun again where this computer was too busy for its servos."""
    while True:
        bridge = start("bridge", "dynamixel", *words)
        try:
            bridge.ready()
        except AssertionError:
            if not any("come too late" in line for line in bridge.said):
                raise
        else:
            return bridge


def wait_for(items: queue.Queue, enough: Callable[[Any], bool], timeout_s: float) -> Any:
    deadline = time.monotonic() + timeout_s
    while True:
        received = items.get(timeout=max(deadline - time.monotonic(), 0.01))
        if enough(received):
            return received


def touched(received: Any) -> bool:
    event = decode(received.payload, ContactEvent, received.encoding)
    return isinstance(event, ContactEvent) and event.contact


def test_a_contact_comes_through_the_whole_chain(start: Callable[..., Process]) -> None:
    """The one of these that is not slow: one event is enough, however late and whichever."""
    endpoint = router(start)
    with Link.open(client_settings([endpoint])) as link:
        contacts: queue.Queue = queue.Queue()
        link.subscribe(ALL_CONTACT, contacts.put)
        start(
            "bridge", "virtual", "--dir", "bus", "--ports", "2", "--write-config", "rig.toml",
            "--scenario", "walk-rough", "--no-wire-time",
        ).ready()  # fmt: skip
        bridge = bridge_to(start, "--config", "rig.toml", "--connect", endpoint)
        wait_for(contacts, touched, 300.0)
    assert bridge.stop() == 0


@slow
@pytest.mark.timeout(240)
def test_contacts_of_a_virtual_robot_arrive_and_a_fault_is_told(
    start: Callable[..., Process],
) -> None:
    endpoint = router(start)
    start(
        "bridge", "virtual", "--dir", "bus", "--ports", "3", "--write-config", "rig.toml",
        "--scenario", "pose-collisions", "--fault", "silent:id=1@60",
    ).ready()  # fmt: skip
    words = ("bridge", "dynamixel", "--config", "rig.toml", "--connect", endpoint)
    contacts: queue.Queue = queue.Queue()
    statuses: queue.Queue = queue.Queue()

    def silent(received: Any) -> bool:
        status = decode(received.payload, BridgeStatus, received.encoding)
        return "1" in status.servos and status.servos["1"].silent

    with Link.open(client_settings([endpoint])) as link:
        link.subscribe(ALL_CONTACT, contacts.put)
        link.subscribe("robot/bridge/*/status", statuses.put)
        bridge = start(*words)
        bridge.ready()
        wait_for(contacts, touched, 40.0)
        wait_for(statuses, silent, 80.0)
    bridge.stop()
    assert any("servo 1 (lf coxa): no answer" in line for line in bridge.said)
    refused = start(*words)
    assert refused.wait(60) == 2
    assert "missing servo 1 (lf coxa)" in "".join(refused.said)


@slow
def test_samples_commands_and_status_pass(start: Callable[..., Process], tmp_path: Path) -> None:
    endpoint = router(start)
    start(
        "bridge", "virtual", "--robot", "quadruped", "--dir", "bus", "--write-config", "rig.toml"
    ).ready()
    start(
        "bridge", "dynamixel", "--config", "rig.toml", "--drive", "--connect", endpoint
    ).ready()  # fmt: skip
    samples: queue.Queue = queue.Queue()
    statuses: queue.Queue = queue.Queue()
    with Link.open(client_settings([endpoint])) as link:
        link.subscribe(servo_key("fl"), samples.put)
        link.subscribe("robot/bridge/*/status", statuses.put)
        commands = link.publisher(command_key("fl"))

        def arrived(received: Any) -> bool:
            sample = decode(received.payload, ServoSample, received.encoding)
            commands.put(Command(desired=[-0.9, -0.8]))
            return sample.measured == pytest.approx([-0.9, -0.8], abs=0.12)

        wait_for(samples, arrived, 30.0)
        received = wait_for(statuses, lambda _: True, 5.0)
        status = decode(received.payload, BridgeStatus, received.encoding)
        assert (status.port, status.mode) == ("legs", "drive")
    # The gait controller's example drives legs of two joints too.
    stepped = subprocess.run(
        [sys.executable, "examples/gait_controller.py", "--config", str(tmp_path / "rig.toml"),
         "--leg", "fl", "--steps", "1", "--connect", endpoint],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert stepped.returncode == 0, stepped.stderr
    assert "step 1: no contact, foot at -" in stepped.stdout


@slow
@pytest.mark.timeout(240)
def test_a_robot_that_its_own_controller_swings_is_learned_by_looking_on(
    start: Callable[..., Process], tmp_path: Path
) -> None:
    """The simulated robot that moves all its legs by itself walks, so that its swings do end in
    touches; how well it is learned is not asked here."""
    start(
        "bridge", "virtual", "--dir", "bus", "--ports", "2", "--write-config", "rig.toml",
        "--scenario", "walk-rough", "--realtime",
    ).ready()  # fmt: skip
    words = ("robot", "learn", "--config", "rig.toml", "--out", "obs.json", "--realtime")
    short = start(*words, "--seconds", "15")
    assert short.wait(60) == 2
    short.stop()
    assert "run this again with --more obs.mcap" in short.said[-1]
    assert not (tmp_path / "obs.json").exists()
    learn = start(*words, "--seconds", "75", "--more", "obs.mcap")
    assert learn.wait(170) == 0, "".join(learn.said)
    learn.stop()
    assert (tmp_path / "obs.json").exists()
    assert (tmp_path / "obs-2.mcap").exists()
    assert sum("x the noise of its readings" in line for line in learn.said) == 6


@slow
def test_a_ports_process_that_is_killed_is_followed_by_one_that_is_heard(
    start: Callable[..., Process],
) -> None:
    endpoint = router(start)
    start(
        "bridge", "virtual", "--dir", "bus", "--ports", "2", "--write-config", "rig.toml",
        "--scenario", "walk-rough",
    ).ready()  # fmt: skip
    bridge = start("bridge", "dynamixel", "--config", "rig.toml", "--connect", endpoint)
    bridge.ready()
    heard: queue.Queue = queue.Queue()
    ticks: dict[str, int] = {}
    rejects: dict[str, dict[str, int]] = {}
    with Link.open(client_settings([endpoint])) as link:
        link.subscribe(ALL_LEARNER, heard.put)

        def all_beyond(least: dict[str, int]) -> Callable[[Any], bool]:
            def check(received: Any) -> bool:
                status = decode(received.payload, LearnerStatus, received.encoding)
                ticks[status.leg] = status.ticks
                rejects[status.leg] = dict(status.rejects)
                return len(ticks) == 6 and all(n > least.get(leg, 0) for leg, n in ticks.items())

            return check

        wait_for(heard, all_beyond({}), 30.0)
        workers = bridge.workers()
        assert len(workers) == 2
        os.kill(workers[0], signal.SIGKILL)
        until(lambda: bridge.workers() != workers and len(bridge.workers()) == 2)
        # What was heard before the end of the old one may still be on its way.
        wait_for(heard, all_beyond({leg: n + 100 for leg, n in ticks.items()}), 30.0)
    # In the old one's run, the new one's numbers would be refused until they had caught up.
    assert all(not counts.get("duplicate_seq") for counts in rejects.values()), rejects


@slow
@pytest.mark.timeout(600)
def test_the_chain_loses_at_most_a_point_of_recall(
    start: Callable[..., Process], tmp_path: Path
) -> None:
    """Measured with --realtime, which needs the right to it, on two cores with other work."""
    from compare import compare

    endpoint = router(start)
    robot = start(
        "bridge", "virtual", "--dir", "bus", "--ports", "3", "--write-config", "rig.toml",
        "--scenario", "pose-collisions", "--record", "direct.mcap", "--seconds", "320",
        "--realtime",
    )  # fmt: skip
    robot.ready()
    bridge = start(
        "bridge", "dynamixel", "--config", "rig.toml", "--connect", endpoint, "--realtime"
    )
    bridge.ready()
    recorder = start("record", "bridged.mcap", "--connect", endpoint)
    recorder.ready()
    assert robot.wait(400) == 0
    bridge.stop()
    recorder.stop()
    hexapod = shipped_robot()
    baseline = shipped_baseline(hexapod.name)
    assert baseline is not None
    result = compare(
        tmp_path / "direct.mcap", tmp_path / "bridged.mcap", hexapod, baseline, skip_s=3.0
    )
    for name, score in result._asdict().items():
        counted = score.total.counted
        print(
            f"{name}: {counted.found} of {counted.touches}, recall {counted.recall:.4f}, "
            f"false alarms {score.total.false_alarms}, latency {counted.latency}"
        )
    direct, live = result.direct.total.counted, result.live.total.counted
    assert direct.touches >= 100
    assert live.recall >= direct.recall - 0.01
    # A bridge that looks on does not know swing from stance: against samples that do not say it
    # either, ticks lost and read off their moment may cost one false alarm in fifty touches.
    untold = result.direct_no_phase.total.false_alarms
    assert result.live.total.false_alarms <= untold + live.touches / 50
