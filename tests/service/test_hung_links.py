"""Links that hang, or are cut without a word, hold up nobody else.

Real processes and real Zenoh.  The bounds are generous, as the machine may be busy: without what
is tested here, four cut links stop everybody for 10 s, and 20 that hang for 20 s.  On a quiet
machine, `LINKS=1,4,20,64 VIEWERS=10,130 LONGEST_S=0.75 pytest -s` of this file prints and holds
what is reached.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest

import rig

pytestmark = pytest.mark.e2e

LONGEST_S = float(os.environ.get("LONGEST_S", "4"))
# What the log says of links that hang or are cut.
TOLD = re.compile("links dropped that held up|links lost")
LINKS = [int(text) for text in os.environ.get("LINKS", "20").split(",")]
VIEWERS = [int(text) for text in os.environ.get("VIEWERS", "130").split(",")]
SOURCE = "10.231.7.1"


class Namespace(NamedTuple):
    """A host of its own on this machine; its address can be taken away."""

    name: str

    @property
    def enter(self) -> tuple[str, ...]:
        return ("ip", "netns", "exec", self.name)

    def cut(self) -> None:
        subprocess.run(["ip", "-n", self.name, "addr", "flush", "dev", f"{self.name}b"], check=True)


@pytest.fixture
def namespace() -> Iterator[Namespace]:
    name = f"cut{os.getpid()}"
    if shutil.which("ip") is None:
        pytest.skip("no `ip` (Debian package iproute2): no host whose address could be removed")
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"no network namespace can be made here: {made.stderr.strip()}")
    try:
        for line in (
            f"ip link add {name}a type veth peer name {name}b netns {name}",
            f"ip addr add {SOURCE}/24 dev {name}a",
            f"ip link set {name}a up",
            f"ip -n {name} addr add 10.231.7.2/24 dev {name}b",
            f"ip -n {name} link set {name}b up",
        ):
            subprocess.run(line.split(), check=True)
        yield Namespace(name)
    finally:
        subprocess.run(["ip", "netns", "del", name], check=True)
        subprocess.run(["ip", "link", "del", f"{name}a"], capture_output=True)


def delays_since(robot: Any, listener: Any, leg: str, since: float) -> list[float]:
    """How late the events of a leg came, s after their samples; none may be missing."""
    events = [(at, event) for at, event in listener.events if event.leg == leg and at > since]
    seqs = [event.seq for _, event in events]
    assert seqs == list(range(seqs[0], seqs[-1] + 1, seqs[1] - seqs[0])), "an event is missing"
    delays = sorted(at - robot.sent_at[event.seq] for at, event in events)
    print(
        f"{len(delays)} events, late by {delays[len(delays) // 2]:.4f} s, at most {delays[-1]:.3f}"
    )
    return delays


@pytest.mark.parametrize(
    ("behind", "links"),
    [*(("a socket", many) for many in LINKS), *(("a proxy", many) for many in VIEWERS)],
)
def test_subscribers_that_hang_hold_up_nobody(
    serve: Any,
    program: Any,
    users: Any,
    behind: str,
    links: int,
) -> None:
    """Read-only users of the documented set, whose sessions say that they may be silent for hours.

    On a Unix socket nothing is acknowledged.  Behind a proxy that stops reading, what is sent to
    them stays in the kernel's buffers, then in Zenoh's.  No lease ends either.
    """
    unix = f"unixsock-stream/{users.service.parent}/u"
    words = ("--listen", unix, "--listen", "0.0.0.0:0", "--zenoh-config", str(users.service))
    served = serve(*words)
    there, near = served.endpoint.replace("0.0.0.0", "127.0.0.1").split(", ")
    wire = rig.Wire(near)
    where = wire.endpoint if behind == "a proxy" else there
    hanging = program("-c", rig.FOREIGN, where, links, users.viewer, "3600000")
    hanging.wait_line("subscribed")
    robot = rig.Robot50(near, ("lf", "rf"), zenoh_config=users.robot)
    listener = rig.Listener(near, zenoh_config=users.viewer)
    with rig.closing(wire, listener, robot):
        listener.steady(robot, "rf", 2)
        if behind == "a proxy":
            wire.cut()
        else:
            hanging.process.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        # What fills them, the kernel's buffers and then Zenoh's: 3 MB/s to each.
        with rig.closing(rig.Bulk(near, "rr", zenoh_config=users.robot)):
            shown = rig.watched(listener.link, "links of subscribers dropped", 60.0)
            listener.steady(robot, "rf", 2)
        assert max(delays_since(robot, listener, "rf", stopped)) < LONGEST_S
        assert listener.statuses["rf"].missed == 0
        assert "links dropped since the start" in shown
    dropped = re.search(r"(\d+) links of subscribers dropped", shown)
    # Links are counted, not events: each once, and only those that hang.
    assert 1 <= int(dropped[1]) <= links
    assert served.stop() == 0
    assert "links dropped that held up" in served.log.read_text()


@pytest.mark.parametrize("links", LINKS)
def test_links_that_are_cut_without_a_word_hold_up_nobody(
    serve: Any, program: Any, namespace: Namespace, links: int
) -> None:
    served = serve("--listen", "127.0.0.1:0", "--listen", f"{SOURCE}:0", "--insecure")
    near, inside = served.endpoint.split(", ")
    robot, listener = rig.Robot50(near, ("rf",)), rig.Listener(near)
    with rig.closing(listener, robot):
        far = program("-c", rig.FOREIGN, inside, links, before=namespace.enter)
        far.wait_line("subscribed")
        listener.steady(robot, "rf", 2)
        cut = time.monotonic()
        namespace.cut()
        began = len(listener.of("rf"))
        listener.wait(lambda me: len(me.of("rf")) >= began + 25, 40.0)
        assert max(delays_since(robot, listener, "rf", cut)) < LONGEST_S
        status = listener.statuses["rf"]
        assert (status.missed, status.note) == (0, None)
        # Zenoh gives a link up that is silent for 2 s.  On a busy computer one of the far sessions
        # may have none at the moment of the cut.
        until, dropped = time.monotonic() + 60.0, 0
        while dropped < 0.9 * links:
            assert time.monotonic() < until, f"{dropped} of {links} links dropped"
            shown = rig.watched(listener.link, "links of subscribers dropped", 60.0)
            dropped = int(re.findall(r"(\d+) links of subscribers dropped", shown)[0])
    assert served.stop() == 0
    assert TOLD.search(served.log.read_text())
