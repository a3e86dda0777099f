"""The loop that serves virtual ports.

One thread does it all: it brings the backend up to the moment, answers what has come, and sleeps
in ``select`` until the next packet, reply or physics step.
"""

from __future__ import annotations

import gc
import select
import threading
import time
from collections.abc import Sequence

from adaptive_contact_sim.virtual.backend import Backend
from adaptive_contact_sim.virtual.port import VirtualPort

__all__ = ["VirtualServer"]


class VirtualServer:
    """Serves virtual ports in real time.

    Args:
        ports: the buses.
        backend: what moves behind all of them.
    """

    def __init__(self, ports: Sequence[VirtualPort], backend: Backend) -> None:
        self.ports = tuple(ports)
        self._backend = backend
        self._start_s = 0.0

    @property
    def elapsed_s(self) -> float:
        """Since the start."""
        return time.monotonic() - self._start_s

    def __enter__(self) -> VirtualServer:
        self._start_s = time.monotonic()
        for port in self.ports:
            port.open()
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports:
            port.close()

    def run(self, stop: threading.Event) -> None:
        """Serve until stopped; the ports have to be open (``with server:``)."""
        # What exists now stays: a full collection would keep the bus waiting for tens of ms.
        gc.collect()
        gc.freeze()
        while not stop.is_set():
            self._cable()
            now_s = time.monotonic()
            next_s = min(self._backend.advance(now_s), now_s + 0.05)
            for port in self.ports:
                if port.is_up:
                    next_s = min(next_s, port.flush(time.monotonic()))
            masters = {port.master: port for port in self.ports if port.is_up}
            wait_s = max(next_s - time.monotonic(), 0.0)
            ready, _, _ = select.select(list(masters), [], [], wait_s)
            if ready:
                # The servos are where they are when asked, not where they were a step ago.
                self._backend.advance(time.monotonic())
            for master in ready:
                now_s = time.monotonic()
                masters[master].receive(now_s, now_s - self._start_s)
                masters[master].flush(time.monotonic())

    def _cable(self) -> None:
        """Pull cables and put them back, as the faults say."""
        elapsed = self.elapsed_s
        for port in self.ports:
            out = port.faults.hung_up(port.name, elapsed)
            if out and port.is_up:
                port.close()
            elif not out and not port.is_up:
                port.open()
