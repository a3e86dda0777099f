"""Waiting for what another thread or process does, and addresses to meet it at."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from typing import Any


def until(test: Callable[[], Any], what: Any = "", timeout_s: float = 60.0) -> Any:
    """Wait until a test gives something true, and return that.

    Args:
        test: called again and again.
        what: said where it never does; or a function that gives what is said.
        timeout_s: how long to wait.
    """
    end = time.monotonic() + timeout_s
    while not (found := test()):
        assert time.monotonic() < end, what() if callable(what) else what
        time.sleep(0.005)
    return found


def matched(publisher: Any) -> Any:
    """The publisher, once somebody subscribes; Zenoh offers no event for it that we use."""
    until(lambda: publisher.matched, f"nobody subscribes to {publisher.key}")
    return publisher


def free_address() -> str:
    """A host and a port of it on which nobody listens."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


class Every(threading.Thread):
    """Calls something at once and then once in a period, on its schedule, until it is closed."""

    def __init__(self, period_s: float, call: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self._period_s = period_s
        self._call = call
        self._over = threading.Event()
        self.start()

    def run(self) -> None:
        due_s = time.monotonic()
        while not self._over.wait(max(0.0, due_s - time.monotonic())):
            self._call()
            due_s += self._period_s

    def close(self) -> None:
        self._over.set()
        self.join(60)
