"""Links that hang or are cut: real sockets, and real sessions in processes of their own."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress

import pytest

from adaptive_contact.service.sockets import HELD_UP_NS, STUCK_NS, LinkSockets

S = 1_000_000_000


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two ends of a TCP link on loopback; the first is the service's."""
    with socket.create_server(("127.0.0.1", 0)) as server, ExitStack() as stack:
        peer = stack.enter_context(socket.create_connection(server.getsockname()))
        ours, _ = server.accept()
        stack.enter_context(ours)
        yield ours, peer


DROPPED = (1, "links dropped that held up contact events")


def linger(ours: socket.socket) -> tuple[int, ...]:
    return struct.unpack("ii", ours.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))


def watching(
    ours: socket.socket, busy_ns: Callable[[], int]
) -> tuple[LinkSockets, list[tuple[int, str]]]:
    """Watch a link whose buffers are full; what misses events is kept."""
    fill(ours)
    sockets, missed = LinkSockets(), list[tuple[int, str]]()
    sockets.drop_what_holds_up(lambda _: busy_ns(), lambda *links: missed.append(links))
    return sockets, missed


def fill(ours: socket.socket) -> None:
    """Send until the peer, which does not read, takes no more."""
    ours.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            ours.send(b"x" * 65536)


@pytest.mark.parametrize(("before", "on"), [((1, 10), 0), ((1, 0), 1), ((0, 0), 0)])
def test_a_socket_that_would_linger_does_not(
    pair: tuple[socket.socket, socket.socket], before: tuple[int, int], on: int
) -> None:
    ours, _ = pair
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", *before))
    LinkSockets().check_sockets(0)
    assert linger(ours)[0] == on


def test_a_link_that_takes_nothing_is_shut_down_while_a_put_waits(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    ours, _ = pair
    busy = 0
    sockets, missed = watching(ours, lambda: busy)
    sockets.check_sockets(0)
    sockets.check_sockets(10 * S)  # it hangs, and holds nothing up
    assert missed == []
    busy = HELD_UP_NS
    sockets.check_sockets(10 * S + 1)
    assert missed == [DROPPED]
    with pytest.raises(OSError, match=r"Broken pipe|reset"):
        ours.send(b"x")
    assert sockets.held_ns == 10 * S + 1
    ours.close()
    sockets.check_sockets(20 * S)
    assert missed == [DROPPED], "what was dropped is not lost as well"


def test_a_link_whose_peer_reads_is_kept_however_long_a_put_waits(
    pair: tuple[socket.socket, socket.socket],
) -> None:
    ours, peer = pair
    sockets, missed = watching(ours, lambda: S)
    now_ns = 0
    for _ in range(20):
        sockets.check_sockets(now_ns)
        now_ns += STUCK_NS - 1
        left = 4 * 65536  # enough for its kernel to open the window again
        while left > 0:
            left -= len(peer.recv(min(left, 65536)))
        fill(ours)
        sockets.check_sockets(now_ns)
    assert missed == []


@pytest.mark.parametrize(
    ("after_ns", "expected"), [(STUCK_NS, [(1, "links lost")]), (STUCK_NS - 1, [])]
)
def test_a_link_that_took_nothing_until_it_was_closed_is_lost(
    pair: tuple[socket.socket, socket.socket], after_ns: int, expected: list[tuple[int, str]]
) -> None:
    """As Zenoh closes it at the end of its lease; one that has just begun to wait may be done."""
    ours, _ = pair
    sockets, missed = watching(ours, lambda: 0)
    sockets.check_sockets(0)
    sockets.check_sockets(1)
    ours.close()
    sockets.check_sockets(after_ns)
    sockets.check_sockets(after_ns + S)
    assert missed == expected


def test_other_descriptors_are_left_alone() -> None:
    with ExitStack() as stack:
        ends = [stack.enter_context(end) for end in socket.socketpair()]
        udp = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        for end in (ends[0], udp):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
        sockets = LinkSockets()
        sockets.drop_what_holds_up(lambda _: S, lambda *links: pytest.fail(f"{links}"))
        sockets.check_sockets(0)
        sockets.check_sockets(10 * S)
        assert linger(ends[0]) == linger(udp) == (1, 10)
