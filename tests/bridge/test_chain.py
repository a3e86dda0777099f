"""The whole chain in processes of its own: simulator, virtual bus, DynamixelSDK, bridge, Zenoh,
service, contact events; scored against the simulator's truth."""

from __future__ import annotations

import os
import queue
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest

from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.score import score_messages
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    LEG_MESSAGES,
    ContactEvent,
    LearnerStatus,
    decode,
    leg_of_key,
)
from programs import Program
from scoring import messages, play
from waiting import until

pytestmark = pytest.mark.e2e
# Real time on pseudo-terminals: run by `make test-all`, on a machine with nothing else to do.
slow = pytest.mark.slow


def workers(bridge: Program) -> list[int]:
    """Processes that a bridge has spawned, the ports'."""
    children = psutil.Process(bridge.process.pid).children(recursive=True)
    return sorted(one.pid for one in children if "spawn_main" in " ".join(one.cmdline()))


def ready(program: Program) -> Program:
    program.wait_line("stop with Ctrl-C", 300.0)
    return program


def router(start: Callable[..., Program]) -> str:
    serve = start("serve", "--listen", "tcp/127.0.0.1:0", "--no-state")
    return serve.wait_line(r"listening on (tcp/\S+?)[;,]")[1]


def bridge_to(start: Callable[..., Program], *words: str) -> Program:
    """A bridge that is ready, begun again where this computer was too busy for its servos."""
    while True:
        bridge = start("bridge", "dynamixel", *words)
        try:
            ready(bridge)
        except AssertionError:
            if not any("come too late" in line for line in bridge.lines):
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


def test_a_contact_comes_through_the_whole_chain(start: Callable[..., Program]) -> None:
    """The one of these that is not slow: one event is enough, however late and whichever."""
    endpoint = router(start)
    with Link.open(client_settings([endpoint])) as link:
        contacts: queue.Queue = queue.Queue()
        link.subscribe(ALL_CONTACT, contacts.put)
        ready(start(
            "bridge", "virtual", "--dir", "bus", "--ports", "2", "--write-config", "rig.toml",
            "--scenario", "walk-rough", "--no-wire-time",
        ))  # fmt: skip
        bridge = bridge_to(start, "--config", "rig.toml", "--connect", endpoint)
        wait_for(contacts, touched, 300.0)
    assert bridge.stop() == 0


@slow
def test_a_ports_process_that_is_killed_is_followed_by_one_that_is_heard(
    start: Callable[..., Program],
) -> None:
    endpoint = router(start)
    ready(start(
        "bridge", "virtual", "--dir", "bus", "--ports", "2", "--write-config", "rig.toml",
        "--scenario", "walk-rough",
    ))  # fmt: skip
    bridge = start("bridge", "dynamixel", "--config", "rig.toml", "--connect", endpoint)
    ready(bridge)
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
        before = workers(bridge)
        assert len(before) == 2
        os.kill(before[0], signal.SIGKILL)
        until(lambda: workers(bridge) != before and len(workers(bridge)) == 2)
        # What was heard before the end of the old one may still be on its way.
        wait_for(heard, all_beyond({leg: n + 100 for leg, n in ticks.items()}), 30.0)
    # In the old one's run, the new one's numbers would be refused until they had caught up.
    assert all(not counts.get("duplicate_seq") for counts in rejects.values()), rejects


def kept(path: Path, name: str) -> list[tuple[str, Any]]:
    """Messages of a kind in a recording, each with its leg, in the order of their times."""
    found = [
        (leg_of_key(record.key), decode(record.payload, LEG_MESSAGES[name], record.encoding))
        for record in read_recording(path)
        if record.key.endswith(f"/{name}")
    ]
    return sorted(found, key=lambda pair: (pair[1].t_ns, pair[0]))


@slow
@pytest.mark.timeout(600)
def test_the_chain_loses_at_most_a_point_of_recall(
    start: Callable[..., Program], tmp_path: Path
) -> None:
    """Measured with --realtime, which needs the right to it, on two cores with other work."""
    endpoint = router(start)
    robot = start(
        "bridge", "virtual", "--dir", "bus", "--ports", "3", "--write-config", "rig.toml",
        "--scenario", "pose-collisions", "--record", "direct.mcap", "--seconds", "320",
        "--realtime",
    )  # fmt: skip
    ready(robot)
    bridge = start(
        "bridge", "dynamixel", "--config", "rig.toml", "--connect", endpoint, "--realtime"
    )
    ready(bridge)
    recorder = start("record", "bridged.mcap", "--connect", endpoint)
    ready(recorder)
    assert robot.wait(400) == 0
    bridge.stop()
    recorder.stop()
    hexapod = shipped_robot()
    baseline = shipped_baseline(hexapod.name)
    assert baseline is not None
    own, received = tmp_path / "direct.mcap", tmp_path / "bridged.mcap"
    stamps = [sample.t_ns for _, sample in kept(received, "servo")]
    # Not the bridge's first seconds, while it looks for its place in the tick.
    begin_ns, end_ns = stamps[0] + 3 * 10**9, stamps[-1]
    # Truth of touches before the first sample still matters to it.
    truth = [(leg, t) for leg, t in kept(own, "truth") if begin_ns - 10**9 <= t.t_ns <= end_ns]
    events = [event for _, event in kept(received, "contact") if event.t_ns >= begin_ns]
    mine, theirs = (
        [(leg, s) for leg, s in kept(each, "servo") if begin_ns <= s.t_ns <= end_ns]
        for each in (own, received)
    )
    # The same without the phase, which a bridge that looks on cannot know.
    untold = [(leg, msgspec.structs.replace(s, phase=None)) for leg, s in mine]
    scores = {
        "direct": play(mine, truth, hexapod, baseline).total,
        "without phase": play(untold, truth, hexapod, baseline).total,
        "live": score_messages(messages(theirs, truth), hexapod, events).total,
    }
    for name, score in scores.items():
        counted = score.counted
        print(
            f"{name}: {counted.found} of {counted.touches}, recall {counted.recall:.4f}, "
            f"false alarms {score.false_alarms}, latency {counted.latency}"
        )
    direct, live = scores["direct"].counted, scores["live"].counted
    assert direct.touches >= 100
    assert live.recall >= direct.recall - 0.01
    # Ticks lost and read off their moment may cost one false alarm in fifty touches.
    most = scores["without phase"].false_alarms + live.touches / 50
    assert scores["live"].false_alarms <= most
