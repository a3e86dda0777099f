"""Strangers who may write a leg's key, a file or the state's folder: what becomes of the service.

Real processes and real Zenoh.  ``tests/learner/test_stream.py`` has the leg's part, by sample,
``tests/state/test_store.py`` the folder's file by file.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

import rig
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.link import (
    Finding,
    Link,
    NoRouterError,
    client_settings,
    router_settings,
)
from adaptive_contact.service.transport import MAX_MESSAGE_BYTES, MAX_SESSIONS
from adaptive_contact.wire import MSGPACK, ContactTruth, decode, encode, truth_key
from waiting import free_address, matched, until

Join = Callable[..., Link]
KEY = truth_key("rf")


def truth(n: int) -> ContactTruth:
    return ContactTruth(t_ns=n, contact=bool(n % 2), force=1.5)


def foreign(router: Link) -> zenoh.Session:
    """A session of Zenoh's own."""
    endpoints = json.dumps(router.endpoints)
    text = f'{{mode: "client", connect: {{endpoints: {endpoints}}}}}'
    return zenoh.open(zenoh.Config.from_json5(text))


def test_a_deletion_does_not_arrive(router: Link, join: Join, inbox: Any) -> None:
    client = join(router.endpoints[0])
    got = inbox().subscribe(client, KEY)
    matched(router.publisher(KEY))
    with foreign(router) as other:
        publisher = other.declare_publisher(KEY)
        publisher.delete()
        publisher.put(b"after it")
        (received,) = got.wait(1)
    assert received.payload == b"after it"


def test_samples_arrive_with_what_was_sent(router: Link, join: Join, inbox: Any) -> None:
    client = join(router.endpoints[0])
    got = inbox().subscribe(client, "robot/leg/*/truth")
    before_ns = time.monotonic_ns()
    matched(router.publisher(KEY)).put(truth(3))
    (received,) = got.wait(1)
    assert received.key == KEY
    assert received.encoding == MSGPACK
    assert decode(received.payload, ContactTruth, received.encoding) == truth(3)
    assert before_ns <= received.arrival_ns <= time.monotonic_ns()
    assert abs(received.published_ns - time.time_ns()) < 10e9


def test_late_joiners_get_the_last_one_by_history_and_by_get(
    router: Link, join: Join, inbox: Any
) -> None:
    publisher = router.publisher(KEY, reliable=True, history=1)
    for n in range(1, 4):
        publisher.put(truth(n))
    client = join(router.endpoints[0])
    got = inbox(ContactTruth).subscribe(client, "robot/leg/*/truth", history=True)
    assert [message.t_ns for message in got.wait(1)] == [3]
    publisher.put(truth(4))
    assert [message.t_ns for message in got.wait(2)] == [3, 4]
    for selector in (KEY, "robot/leg/*/truth"):
        (reply,) = client.query(selector)
        assert reply.key == KEY
        assert decode(reply.payload, ContactTruth) == truth(4)
    # History comes from late publishers, too.
    join(router.endpoints[0]).publisher(truth_key("lf"), reliable=True, history=1).put(truth(7))
    assert got.wait(3)[-1].t_ns == 7


def test_namespaces_keep_robots_apart(router: Link, join: Join, inbox: Any) -> None:
    endpoint = router.endpoints[0]
    one, two, outside = inbox(), inbox(), inbox()
    join(endpoint, namespace="one").subscribe("**", one)
    join(endpoint, namespace="two").subscribe("**", two)
    join(endpoint).subscribe("**", outside)
    sender = join(endpoint, namespace="one")
    matched(sender.publisher(KEY)).put(truth(1))
    assert one.wait(1)[0].key == KEY
    assert outside.wait(1)[0].key == f"one/{KEY}"
    matched(join(endpoint, namespace="two").publisher(KEY)).put(truth(2))
    # Had anything of `one` reached `two`, it would have come before this.
    assert [decode(got.payload, ContactTruth).t_ns for got in two.wait(1)] == [2]


def test_a_query_with_megabytes_is_refused_before_it_is_kept(router: Link) -> None:
    seen = []
    router.queryable(KEY, seen.append)
    with foreign(router) as session:
        (reply,) = session.get(KEY, payload=bytes(4_000_000), timeout=5.0)
    assert reply.err.payload.to_string() == "4000000 bytes, at most 262144"
    assert not seen


def test_a_callback_that_raises_is_counted_and_goes_on(
    router: Link, join: Join, caplog: pytest.LogCaptureFixture
) -> None:
    calls = threading.Semaphore(0)

    def raises(received: object) -> None:
        calls.release()
        raise ValueError("in a callback")

    router.subscribe(KEY, raises)
    publisher = matched(join(router.endpoints[0]).publisher(KEY))
    for n in range(2):
        publisher.put(truth(n))
        assert calls.acquire(timeout=3)
    publisher.put(truth(3))
    assert calls.acquire(timeout=3)
    assert router.callback_faults >= 2


def test_huge_messages_are_dropped_and_the_link_stays(router: Link, join: Join, inbox: Any) -> None:
    got = inbox().subscribe(router, KEY)
    publisher = matched(join(router.endpoints[0]).publisher(KEY))
    publisher.put_raw(bytes(MAX_MESSAGE_BYTES + 1_000_000), MSGPACK)

    def passed() -> bool:  # while that is under way others may be dropped here
        publisher.put(truth(1))
        return bool(got.items)

    until(passed)
    assert {received.payload for received in got.items} == {encode(truth(1))}


def test_nobody_there_and_somebody_refusing_are_told_apart(tmp_path: Path) -> None:
    nobody = free_address()
    with pytest.raises(NoRouterError, match=f"unreachable: nobody listens on tcp/{nobody}"):
        Link.open(client_settings([nobody], wait=False))

    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        refusing = f"127.0.0.1:{mute.getsockname()[1]}"
        with pytest.raises(NoRouterError, match=r"refused: .* accepts connections") as caught:
            Link.open(client_settings([refusing], wait=False))
    assert caught.value.finding.reach == "refusing"


def test_a_waiting_client_tells_why_once_and_can_be_stopped() -> None:
    nobody = free_address()
    told: list[Finding] = []
    stop = threading.Event()

    def on_wait(finding: Finding) -> None:
        told.append(finding)
        threading.Timer(0.6, stop.set).start()

    with pytest.raises(NoRouterError, match="stopped while waiting"):
        Link.open(client_settings([nobody]), on_wait=on_wait, stop=stop)
    assert [finding.reach for finding in told] == ["unreachable"]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{mode: }", "expected"),
        ("{mood: 1}", "unknown field `mood`"),
        (None, "(?i)no such file.*; give a Zenoh"),
    ],
)
def test_a_bad_zenoh_configuration_gets_one_line(
    tmp_path: Path, text: str | None, match: str
) -> None:
    path = tmp_path / "zenoh.json5"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigurationError, match=match) as caught:
        Link.open(router_settings(zenoh_config=path))
    assert ".rs" not in str(caught.value)


# -- Strangers who may write a leg's key, a file or the state's folder: what becomes of the s


@pytest.mark.e2e
def test_sessions_are_limited_and_what_is_full_is_told(serve: Any) -> None:
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
        until(lambda: full not in rig.watched(listener.link), "ended sessions are still counted")
        with Link.open(here) as again:
            assert again.is_connected()
    assert served.stop() == 0
    assert "no room for another session" in served.log.read_text()


@pytest.mark.e2e
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
