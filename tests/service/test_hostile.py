"""Strangers who may write a leg's key, a file or the state's folder: what becomes of the service.

Real processes and real Zenoh.  ``tests/learner/test_stream.py`` has the leg's part, by sample,
``tests/state/test_store.py`` the folder's file by file.
"""

from __future__ import annotations

import stat
import subprocess
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from adaptive_contact.service.link import Link, NoRouterError, client_settings
from adaptive_contact.service.settings import router_settings
from adaptive_contact.service.transport import MAX_SESSIONS
from adaptive_contact.wire import ServoSample, servo_key

pytestmark = pytest.mark.e2e

SHOTS = 20


def shoot(robot: Any, listener: Any, **fields: Any) -> None:
    """Publish one sample on the robot's key every five ticks of it."""
    publisher = listener.link.publisher(servo_key("rf"))
    for shot in range(SHOTS):
        due = robot.seq + 5
        while robot.seq < due:
            time.sleep(0.002)
        made = {name: value(robot.seq, shot) for name, value in fields.items()}
        publisher.put(ServoSample(measured=[0.0, 0.1, 0.2], desired=[0.0, 0.1, 0.2], **made))


def test_numbers_far_ahead_cost_nothing_and_are_not_missed(serve: Any, rig: ModuleType) -> None:
    served = serve()
    robot, listener = rig.Robot50(served.endpoint, ("rf",), run=7), rig.Listener(served.endpoint)
    with rig.closing(listener, robot):
        listener.steady(robot, "rf", 2)
        began = len(listener.events)
        shoot(
            robot,
            listener,
            seq=lambda seq, shot: seq + 9_000_000 + shot,
            t_ns=lambda seq, shot: robot.epoch_ns + seq * 20_000_000 + 1,
            run=lambda seq, shot: 7,
        )
        listener.wait(lambda me: me.statuses["rf"].rejects.get("seq_jump") == SHOTS)
        listener.steady(robot, "rf", 2)
        # Not one event is missing, late or wrong.
        told = [event.seq for event in listener.of("rf", began)]
        assert told == list(range(told[0], told[-1] + 1, rig.HALF))
        status = listener.statuses["rf"]
        assert (status.missed, status.restarts) == (0, 0)
        assert status.rejects == {"seq_jump": SHOTS}
        assert "seq_jump" in rig.watched(listener.link, "seq_jump")
    assert served.stop() == 0
    assert "reason=seq_jump" in served.log.read_text()


def test_runs_that_do_not_last_blind_a_leg_for_a_moment_only(serve: Any, rig: ModuleType) -> None:
    served = serve()
    robot, listener = rig.Robot50(served.endpoint, ("rf",), run=7), rig.Listener(served.endpoint)
    with rig.closing(listener, robot):
        listener.steady(robot, "rf", 6)  # more than a run that is short
        before = listener.statuses["rf"]
        shoot(
            robot,
            listener,
            seq=lambda seq, shot: shot,
            t_ns=lambda seq, shot: shot,
            run=lambda seq, shot: 1000 + shot,
        )
        assert "new runs came and did not last" in rig.watched(listener.link, "new runs came")
        listener.steady(robot, "rf")
        status = listener.statuses["rf"]
        # One was believed at once, and the next, which showed that the first did not last; then
        # the robot was again, after 25 samples of its own.
        assert status.restarts - before.restarts == 3
        assert status.rejects["other_publisher"] <= SHOTS - 2 + 30
        assert status.missed == before.missed
    assert served.stop() == 0


def test_sessions_are_limited_and_what_is_full_is_told(serve: Any, rig: ModuleType) -> None:
    served = serve("--max-sessions", "4")
    robot, listener = rig.Robot50(served.endpoint, ("rf",)), rig.Listener(served.endpoint)
    with rig.closing(listener, robot):
        here = client_settings([served.endpoint], wait=False)
        with Link.open(here), Link.open(here):
            with pytest.raises(NoRouterError, match="has no room for another session"):
                Link.open(here)
            full = "4 sessions are connected, as many as may be: others are refused"
            assert full in rig.watched(listener.link, full)
            listener.steady(robot, "rf", 2)
        until = time.monotonic() + 20
        while full in rig.watched(listener.link):
            assert time.monotonic() < until, "sessions that have ended are still counted"
        with Link.open(here) as again:
            assert again.is_connected()
    assert served.stop() == 0
    assert "no room for another session" in served.log.read_text()


def test_the_limit_of_sessions_is_ours_then_the_files_then_the_command_lines(
    tmp_path: Any,
) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text("{transport: {unicast: {max_sessions: 12}}}")
    listen = ["tcp/127.0.0.1:0"]
    for settings, most in (
        (router_settings(listen), MAX_SESSIONS),
        (router_settings(listen, zenoh_config=path), 12),
        (router_settings(listen, zenoh_config=path, max_sessions=5), 5),
    ):
        with Link.open(settings) as router:
            assert (router.max_sessions, router.sessions()) == (most, 0)


@pytest.mark.parametrize("suffix", [".new", ".state", ".before", ".old"])
def test_serve_writes_through_no_link_in_a_folder_that_others_may_write_to(
    serve: Any, rig: ModuleType, tmp_path: Path, suffix: str
) -> None:
    """Somebody has put a link under a state's name, to a file of the service's user."""
    folder, victim = tmp_path / "kept", tmp_path / "victim"
    victim.write_bytes(b"precious")

    def walk() -> str:
        """One life of the service, with a leg that walks; the log."""
        served = serve("--state", str(folder))
        robot, listener = rig.Robot50(served.endpoint, ("rf",)), rig.Listener(served.endpoint)
        with rig.closing(listener, robot):
            listener.steady(robot, "rf", 2)
            if exposed:
                rig.watched(listener.link, "other users may write to")
        assert served.stop() == 0
        return str(served.log.read_text())

    exposed = False
    assert "state is open to others" not in walk()
    (state,) = folder.glob("*/rf-*.state")
    assert stat.S_IMODE(state.stat().st_mode) == 0o600
    assert stat.S_IMODE(state.parent.stat().st_mode) == stat.S_IMODE(folder.stat().st_mode) == 0o700
    planted = state.with_suffix(suffix)
    planted.unlink(missing_ok=True)
    planted.symlink_to(victim)
    state.parent.chmod(0o777)

    exposed = True
    assert "state is open to others" in walk()
    assert victim.read_bytes() == b"precious"
    assert not any(path.is_symlink() for path in state.parent.glob("rf-*[!d]"))
    assert state.read_bytes().startswith(b"ACSTATE")


@pytest.mark.parametrize("name", ["robot.toml", "baseline.json"])
def test_files_that_are_nested_deeply_get_one_line(
    command: Any, config: Path, tmp_path: Path, name: str
) -> None:
    """By the real service, which says what it found and starts nothing."""
    deep = tmp_path / f"deep-{name}"
    depth = 200_000
    if name == "robot.toml":
        deep.write_text(f"a = {'[' * depth}{']' * depth}\n")
        options = ("--config", str(deep))
    else:
        deep.write_text(f'{{"format": {"[" * depth}{"]" * depth}}}')
        options = ("--config", str(config), "--baseline", str(deep))
    process = command(
        *("-m", "adaptive_contact", "serve", "--listen", "127.0.0.1:0", "--no-state", *options),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    out, error = process.communicate(timeout=600)
    process.stderr.close()
    assert process.returncode == 2, error[-500:]
    assert out == ""
    assert error.startswith(f"adaptive-contact: {deep}: ")
    assert error.count("\n") == 1
    assert "nested" in error
