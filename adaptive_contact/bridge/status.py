"""What a bridge tells of itself: ``robot/bridge/{port}/status``, once a second."""

from __future__ import annotations

from collections import Counter, deque
from typing import Final, Literal

import msgspec
import numpy as np

from adaptive_contact.wire import Message

__all__ = ["BridgeStatus", "Pulse", "Quantiles", "ServoCounts", "quantiles"]

State = Literal["running", "holding", "lost"]

# Cycles looked back on, ten seconds at 50 Hz.
_CYCLES: Final = 500


class Quantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Distribution of a time over the last ten seconds, ms."""

    p50: float = 0.0
    p90: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class ServoCounts(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One servo since the start of the bridge.

    Attributes:
        silent: it does not answer now.
        alarms: what it complains of now, such as ``overload``; ``shutdown`` where it has switched
            its drive off for that.
        faults: how often, by kind: ``no_answer``, ``corrupt``, ``refused``, ``stale`` (an old
            position again), ``unpunctual`` (read too far from its moment), ``carried_back`` (read
            off its moment, and put right by the servo's own speed), ``foreign_goal`` (its goal
            was not the one written: another program, or a reset), and the names of error bits.
    """

    silent: bool = False
    alarms: list[str] = msgspec.field(default_factory=list)
    faults: dict[str, int] = msgspec.field(default_factory=dict)


class BridgeStatus(Message, frozen=True, kw_only=True):
    """How a port is.

    Attributes:
        t_ns: wall clock.
        state: ``running``, ``holding`` (commands stopped), ``lost`` (the port is gone).
        rate_hz: achieved over the last second; ``wanted_hz`` is the robot's.
        cycle_ms: from the first byte written to the last sample published.
        jitter_ms: of publication, against an even grid.
        cycles, missed: control ticks made and not made, since the start.
        reconnects: times the port was lost and found again.
        commands_refused: commands that could not be used, and ``note`` names the last.
        commands_limited: commands that joint limits or the largest step have cut down.
        servos: those with something to tell, by id.
    """

    port: str
    t_ns: int
    mode: Literal["observe", "drive"]
    state: State
    rate_hz: float
    wanted_hz: float
    cycle_ms: Quantiles
    jitter_ms: Quantiles
    cycles: int
    missed: int
    reconnects: int = 0
    commands_refused: int = 0
    commands_limited: int = 0
    holding: list[str] = msgspec.field(default_factory=list)
    servos: dict[str, ServoCounts] = msgspec.field(default_factory=dict)
    note: str | None = None


def quantiles(values_ms: list[float]) -> Quantiles:
    """Quantiles of some times; zeros where there are none."""
    if not values_ms:
        return Quantiles()
    p50, p90, p99, top = np.quantile(values_ms, (0.5, 0.9, 0.99, 1.0)).round(3).tolist()
    return Quantiles(p50=p50, p90=p90, p99=p99, max=top)


class Pulse:
    """Times of the cycle.

    Args:
        period_s: control tick.
    """

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
        """Begin the statistics anew, after an outage."""
        self._cycle_ms.clear()
        self._published.clear()

    @property
    def cycle_ms(self) -> Quantiles:
        """Cycle times."""
        return quantiles(list(self._cycle_ms))

    @property
    def jitter_ms(self) -> Quantiles:
        """How far publications lie off an even grid, absolute.

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
        """Cycles in the last second."""
        return float(sum(1 for t in self._published if now_ns - t <= 1_000_000_000))
