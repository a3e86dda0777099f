"""Samples straight off the bus, without a network: for checking and learning a new robot."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from adaptive_contact.bridge.loop import PortLoop
from adaptive_contact.bridge.outlet import Mailbox
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.bridge.status import BridgeStatus
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.priority import take_priority
from adaptive_contact.wire import MSGPACK, Command, ServoSample, encode

__all__ = ["Script", "collect"]

# Goals of a leg, one per tick, given the first sample of it.
Script = Callable[[ServoSample], Iterator[list[float]]]
_END_S: Final = 5.0
_LOOK_S: Final = 0.1


class _Basket:
    """Outlet of one port: keeps samples, and answers them with goals."""

    def __init__(self, scripts: Mapping[str, Script], say: Callable[[str], None]) -> None:
        self.kept: dict[str, list[ServoSample]] = {}
        self.mailbox = Mailbox()
        self.error: AdaptiveContactError | None = None
        self._scripts = scripts
        self._running: dict[str, Iterator[list[float]]] = {}
        self._say = say

    def samples(self, samples: Mapping[str, ServoSample]) -> None:
        """Keep a tick's samples; each asks for its leg's next goal."""
        for leg, sample in samples.items():
            self.kept.setdefault(leg, []).append(sample)
            if leg in self._scripts and self.error is None:
                self._answer(leg, sample)

    def status(self, status: BridgeStatus) -> None:
        """Nobody waits for it: what happens is said."""

    def say(self, line: str) -> None:
        """Pass a line on."""
        self._say(line)

    def _answer(self, leg: str, sample: ServoSample) -> None:
        try:
            if leg not in self._running:
                self._running[leg] = self._scripts[leg](sample)
            goal = next(self._running[leg])
        except AdaptiveContactError as error:
            self.error = error  # raised on the thread that waits
            return
        payload = encode(Command(desired=goal))
        self.mailbox.put(leg, payload, MSGPACK, time.monotonic_ns())


def collect(
    plans: Sequence[PortPlan],
    seconds: float,
    *,
    scripts: Mapping[str, Script] | None = None,
    realtime: bool = False,
    stop: threading.Event | None = None,
    say: Callable[[str], None] = lambda _: None,
    look: Callable[[dict[str, list[ServoSample]]], None] = lambda _: None,
) -> dict[str, list[ServoSample]]:
    """Run all ports for some time, a thread each.

    Args:
        plans: the ports; handshakes have been made.
        seconds: how long.
        scripts: goals by leg; with them the servos are driven, without them nothing is written.
        realtime: let the ports' threads run before all ordinary ones.
        stop: ends it early when set.
        say: told of what happens.
        look: shown what there is so far, ten times a second; not to be changed.

    Returns:
        Samples by leg, in order.

    Raises:
        AdaptiveContactError: a port cannot be opened, or a leg cannot do what its script says.
    """
    mode = "observe" if scripts is None else "drive"
    end, halt = stop or threading.Event(), threading.Event()
    baskets = [_Basket(scripts or {}, say) for _ in plans]
    run = time.time_ns() // 1_000_000

    def work(plan: PortPlan, basket: _Basket) -> None:
        refused = take_priority() if realtime else None
        if refused is not None:
            say(refused)
        try:
            loop = PortLoop(
                plan, "drive" if mode == "drive" else "observe", basket, basket.mailbox, run
            )
            loop.run(halt)
        except AdaptiveContactError as error:
            basket.error = error

    threads = [
        threading.Thread(target=work, args=pair, name=f"port-{pair[0].name}", daemon=True)
        for pair in zip(plans, baskets, strict=True)
    ]
    began = time.monotonic()
    for thread in threads:
        thread.start()
    try:
        while time.monotonic() - began < seconds and not end.wait(_LOOK_S):
            look(_all(baskets))
            if any(basket.error is not None for basket in baskets):
                break
    finally:
        halt.set()
        for thread in threads:
            thread.join(_END_S)
    for basket in baskets:
        if basket.error is not None:
            raise basket.error
    return _all(baskets)


def _all(baskets: Sequence[_Basket]) -> dict[str, list[ServoSample]]:
    # Copies first: the ports' threads go on adding.
    return {leg: rows for basket in baskets for leg, rows in [*basket.kept.items()]}
