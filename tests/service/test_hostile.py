"""Strangers who may write a leg's key, a file or the state's folder: what becomes of the service.

Real processes and real Zenoh.  ``tests/learner/test_stream.py`` has the leg's part, by sample,
``tests/state/test_store.py`` the folder's file by file.
"""

from __future__ import annotations

import time
from types import ModuleType
from typing import Any

import pytest

from adaptive_contact.service.link import Link, NoRouterError, client_settings
from adaptive_contact.service.settings import router_settings
from adaptive_contact.service.transport import MAX_SESSIONS

pytestmark = pytest.mark.e2e


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
