"""What a bridge tells of itself: ``robot/bridge/{port}/status``, once a second."""

from __future__ import annotations

from typing import Literal

import msgspec

from adaptive_contact.wire.messages import Message

State = Literal["running", "holding", "lost"]


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
