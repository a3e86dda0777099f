"""The service's own figures: latency quantiles, and a brake on repeated log lines."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Hashable
from typing import Final

import msgspec

__all__ = ["Brake", "Latency", "LatencyMs"]

_NS_PER_MS: Final = 1e6
_KEPT: Final = 4096  # p99 of as many is good to about 40 values beyond it
_BRAKE_S: Final = 10.0
_BRAKED_KINDS: Final = 256


class LatencyMs(msgspec.Struct, frozen=True, kw_only=True):
    """Quantiles of the newest values, in milliseconds, and how many there ever were."""

    p50: float
    p99: float
    max: float
    count: int


class Latency:
    """Keeps the newest latencies and gives their quantiles."""

    def __init__(self, kept: int = _KEPT) -> None:
        self._values: deque[int] = deque(maxlen=kept)
        self._count = 0

    def add(self, latency_ns: int) -> None:
        """Take one in, ns."""
        self._values.append(latency_ns)
        self._count += 1

    def quantiles(self) -> LatencyMs | None:
        """Quantiles of the newest values, by nearest rank; None before the first."""
        if not self._values:
            return None
        ordered = sorted(self._values)
        last = len(ordered) - 1
        return LatencyMs(
            p50=ordered[round(0.50 * last)] / _NS_PER_MS,
            p99=ordered[round(0.99 * last)] / _NS_PER_MS,
            max=ordered[-1] / _NS_PER_MS,
            count=self._count,
        )


class Brake:
    """Lets one line of a kind through per period, and says how many it held back.

    Args:
        period_s: between two lines of a kind.
    """

    def __init__(self, period_s: float = _BRAKE_S) -> None:
        self._period_ns = int(period_s * 1e9)
        # kind -> when the last line passed, and how many came since; the oldest kind goes first.
        self._kinds: OrderedDict[Hashable, tuple[int, int]] = OrderedDict()

    def passes(self, kind: Hashable, now_ns: int, times: int = 1) -> int | None:
        """Ask for a line.

        Args:
            kind: what the line is about; each kind has its own period.
            now_ns: monotonic.
            times: how many such things happened.

        Returns:
            How many the line stands for, or None where it is to be held back.
        """
        passed_ns, held = self._kinds.get(kind, (None, 0))
        if passed_ns is not None and now_ns - passed_ns < self._period_ns:
            self._kinds[kind] = (passed_ns, held + times)
            return None
        self._kinds[kind] = (now_ns, 0)
        self._kinds.move_to_end(kind)
        if len(self._kinds) > _BRAKED_KINDS:
            self._kinds.popitem(last=False)
        return held + times
