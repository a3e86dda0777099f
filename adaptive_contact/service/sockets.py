"""Controls the sockets under a Zenoh session (TCP and Unix), beyond Zenoh's configuration.

Two things of a peer that hangs, or goes away without a word, stop a router for all others:

- Zenoh (1.10.2) sets SO_LINGER of 10 s on every socket, and closes it on one of the two threads
  that receive from all links.  :class:`LinkSockets` clears the option; the kernel then sends what
  is left in the background, and ``close`` returns at once.
- A reliable put waits for every link whose buffers are full, one after the other, for as long as
  ``wait_before_close`` says.  A short wait cuts healthy links on a busy machine (decision 33).  So
  the wait is long, and while an event is held up, every link whose peer has taken nothing for
  :data:`STUCK_NS` is shut down, all at once.

A link that takes nothing any more and holds nothing up is closed by Zenoh at the end of its lease,
without a word: it is counted as lost.

Sockets are found in ``/proc/self/fd``.  Without it Zenoh behaves as it would without this module.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import stat
import struct
import sys
import termios
import threading
import time
from collections.abc import Callable
from typing import Any, Final

# A put takes 0.05 ms; one that takes this long is held up by a link.
HELD_UP_NS: Final = 100_000_000
# A live peer's kernel acknowledges what was sent even where its process gets no core, until its
# buffer of 64 kB and more is full.
STUCK_NS: Final = 250_000_000
_NO_LINGER: Final = struct.pack("ii", 0, 0)
# Where linux/tcp.h has `tcpi_bytes_acked`, since Linux 4.1.
_BYTES_ACKED: Final = slice(120, 128)


class LinkSockets:
    """Watches the process's sockets on a thread of its own."""

    def __init__(self) -> None:
        self._busy_ns: Callable[[int], int] | None = None
        self._on_miss: Callable[[int, str], None] = lambda *_: None
        # When a link was last seen that had taken nothing for as long as HELD_UP_NS, monotonic.
        self.held_ns = 0
        self._shut: set[int] = set()  # by us, and not closed yet
        self._known: frozenset[int] = frozenset()
        # Of sockets with something to send: bytes acknowledged, and since when they are as many.
        self._queued: dict[int, tuple[int, int]] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link-sockets", daemon=True)

    def start(self) -> None:
        """Check the sockets ten times a second from now on."""
        self._thread.start()

    def close(self) -> None:
        """Stop looking; calling it twice is safe."""
        self._stop.set()

    def drop_what_holds_up(
        self, busy_ns: Callable[[int], int], on_miss: Callable[[int, str], None]
    ) -> None:
        """Shut links down that hold up a put, and count those that are lost.

        Args:
            busy_ns: how long the put under way has been going on at a monotonic time, ns.
            on_miss: called with how many links were shut down, or are gone that took nothing any
                more, and what became of them.
        """
        self._busy_ns, self._on_miss = busy_ns, on_miss

    def check_sockets(self, now_ns: int) -> None:
        """Check the sockets once; ``now_ns`` is monotonic."""
        sockets = _sockets()
        for inode, number in sockets.items():
            if inode not in self._known:
                _use(number, _clear_linger)
        self._known = frozenset(sockets)
        if self._busy_ns is None:
            return
        lost = sum(
            now_ns - since >= STUCK_NS and inode not in sockets and inode not in self._shut
            for inode, (_, since) in self._queued.items()
        )
        if lost:
            self._on_miss(lost, "links lost")
        self._shut &= sockets.keys()
        stuck = self._stuck(sockets, now_ns)
        if any(now_ns - since >= HELD_UP_NS for _, since in self._queued.values()):
            self.held_ns = now_ns
        if self._busy_ns(now_ns) < HELD_UP_NS:
            return
        shut = [inode for inode in stuck if _use(sockets[inode], _shut_down) is True]
        self._shut.update(shut)
        if shut:
            self._on_miss(len(shut), "links dropped that held up contact events")

    def _stuck(self, sockets: dict[int, int], now_ns: int) -> list[int]:
        """Return sockets with unsent data of which the peer took nothing for too long."""
        queued: dict[int, tuple[int, int]] = {}
        for inode, number in sockets.items():
            waiting, acknowledged = _use(number, _progress) or (0, 0)
            if waiting:
                before, since_ns = self._queued.get(inode, (-1, now_ns))
                queued[inode] = (acknowledged, since_ns if acknowledged == before else now_ns)
        self._queued = queued
        return [inode for inode, (_, since) in queued.items() if now_ns - since >= STUCK_NS]

    def _run(self) -> None:
        # A link that is cut before the first look can still block a receiving thread for 10 s.
        while not self._stop.wait(0.1):
            try:
                self.check_sockets(time.monotonic_ns())
            except OSError:  # no /proc, or no descriptor left
                return


def _sockets() -> dict[int, int]:
    """Return the descriptors of the process's sockets, by inode."""
    found = {}
    with os.scandir("/proc/self/fd") as descriptors:  # Path.iterdir takes five times as long
        for descriptor in descriptors:
            number = int(descriptor.name)
            try:
                status = os.fstat(number)
            except OSError:  # closed since
                continue
            if stat.S_ISSOCK(status.st_mode):
                found[status.st_ino] = number
    return found


def _use(number: int, what: Callable[[socket.socket], Any]) -> Any:
    """Call ``what`` with the socket of a link; None where the descriptor is no such thing any more.

    A duplicate is used, as the number may belong to something else a moment later.
    """
    try:
        duplicate = os.dup(number)
    except OSError:
        return None
    try:
        ours = socket.socket(fileno=duplicate)
    except OSError:  # no socket any more
        os.close(duplicate)
        return None
    with ours, contextlib.suppress(OSError):
        if ours.type == socket.SOCK_STREAM and _is_of_a_link(ours):
            return what(ours)
    return None


def _is_of_a_link(ours: socket.socket) -> bool:
    """Return whether a stream is TCP, or was accepted by a Unix listener with a path."""
    if ours.family == socket.AF_UNIX:  # pairs without a name are the runtime's own
        return bool(ours.getsockname())
    return ours.family in (socket.AF_INET, socket.AF_INET6)


def _clear_linger(ours: socket.socket) -> None:
    value = ours.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(_NO_LINGER))
    on, seconds = struct.unpack("ii", value)
    if on and seconds:  # a wait of 0 s is a choice of its own: reset the link
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)


def _progress(ours: socket.socket) -> tuple[int, int]:
    """Return the unacknowledged bytes, and a number that changes as the peer takes some."""
    waiting = struct.unpack("i", fcntl.ioctl(ours.fileno(), termios.TIOCOUTQ, b"\0" * 4))[0]
    if ours.family == socket.AF_UNIX:  # nothing is acknowledged there; what waits is all there is
        return int(waiting), int(waiting)
    info = ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _BYTES_ACKED.stop)
    return int(waiting), int.from_bytes(info[_BYTES_ACKED], sys.byteorder)


def _shut_down(ours: socket.socket) -> bool:
    ours.shutdown(socket.SHUT_RDWR)
    return True
