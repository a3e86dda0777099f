"""Connects the bridge to the network: samples and statuses out, commands in."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from typing import Final, Protocol

import numpy as np

from adaptive_contact.wire import BridgeStatus, Command, Quantiles, Rejected, ServoSample, decode

# Cycles looked back on, ten seconds at 50 Hz.
_CYCLES: Final = 500


def quantiles(values_ms: list[float]) -> Quantiles:
    """Compute quantiles of some times; zeros where there are none."""
    if not values_ms:
        return Quantiles()
    p50, p90, p99, top = np.quantile(values_ms, (0.5, 0.9, 0.99, 1.0)).round(3).tolist()
    return Quantiles(p50=p50, p90=p90, p99=p99, max=top)


class Pulse:
    """Measures the times of the cycle."""

    def __init__(self, period_s: float) -> None:
        self._period_ns = round(period_s * 1e9)
        self._cycle_ms: deque[float] = deque(maxlen=_CYCLES)
        self._published: deque[int] = deque(maxlen=_CYCLES)
        self.counts: Counter[str] = Counter()

    def beat(self, begun_ns: int, published_ns: int) -> None:
        """Note a cycle: when it began and when its samples were out, monotonic."""
        self._cycle_ms.append((published_ns - begun_ns) / 1e6)
        self._published.append(published_ns)
        self.counts["cycles"] += 1

    def forget(self) -> None:
        """Restart the statistics, after an outage."""
        self._cycle_ms.clear()
        self._published.clear()

    @property
    def cycle_ms(self) -> Quantiles:
        """Return the quantiles of cycle times, ms."""
        return quantiles(list(self._cycle_ms))

    @property
    def jitter_ms(self) -> Quantiles:
        """Return the quantiles of how far publications lie off an even grid, ms, absolute.

        The grid is the control period's, put through the middle of the publications; missed
        ticks leave a gap in it.
        """
        if len(self._published) < 3:
            return Quantiles()
        at = np.array(self._published, dtype=np.int64)
        at -= at[0]
        ticks = np.rint(at / self._period_ns)
        off = (at - ticks * self._period_ns) / 1e6
        return quantiles(np.abs(off - np.median(off)).tolist())

    def rate_hz(self, now_ns: int) -> float:
        """Return the number of cycles in the last second."""
        return float(sum(1 for t in self._published if now_ns - t <= 1_000_000_000))


class Outlet(Protocol):
    """Publishes for a bridge; over Zenoh in the product, into a list in tests."""

    def samples(self, samples: Mapping[str, ServoSample]) -> None:
        """Publish one control tick's samples, by leg."""

    def status(self, status: BridgeStatus) -> None:
        """Publish the state of the port."""

    def print_line(self, line: str) -> None:
        """Print one line for the operator: something happened."""


class Mailbox:
    """Holds the newest command of every leg.

    Written on a thread of the network, read by the cycle: each is one dictionary operation, so
    that neither waits for the other.
    """

    def __init__(self) -> None:
        # Payload, encoding, and monotonic time of arrival.
        self._newest: dict[str, tuple[bytes, str, int]] = {}
        self.rejected = 0
        self.last_reject: str | None = None

    def store_command(self, leg: str, payload: bytes, encoding: str, arrival_ns: int) -> None:
        """Store a command until :meth:`pop_command`, or until a newer one comes."""
        self._newest[leg] = payload, encoding, arrival_ns

    def pop_command(self, leg: str) -> tuple[Command, int] | None:
        """Remove and return the newest command and its time of arrival, or None."""
        post = self._newest.pop(leg, None)
        if post is None:
            return None
        payload, encoding, arrival_ns = post
        command = decode(payload, Command, encoding)
        if isinstance(command, Rejected):
            self.refuse(f"leg '{leg}': {command.detail}")
            return None
        return command, arrival_ns

    def refuse(self, why: str) -> None:
        """Count a command that cannot be used."""
        self.rejected += 1
        self.last_reject = why
