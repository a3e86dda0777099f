r"""Generates movements to learn a leg from: free swings between random poses.

A leg goes from a low pose to a high one and back, over and over, each leg at its own pace.  Poses
are drawn around the one it was found in, within an amplitude and the joints' limits; between them
the joints follow the minimum-jerk profile :math:`s(\tau) = 10\tau^3 - 15\tau^4 + 6\tau^5`, whose
speed is 0 at both ends.  After each descent it rests for a few ticks, which ends the swing.

Reference:
    T. Flash, N. Hogan, "The coordination of arm movements", J. Neurosci. 5, 1985.

Samples straight off the bus, without a network: for checking and learning a new robot.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, Literal

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.bridge.loop import PortLoop
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.bridge.transport import Mailbox
from adaptive_contact.errors import AdaptiveContactError, ConfigurationError
from adaptive_contact.priority import raise_priority
from adaptive_contact.robot import Leg
from adaptive_contact.wire import MSGPACK, BridgeStatus, Command, ServoSample, encode

REST_TICKS: Final = 4
# Now and then a leg is held until its servos rest, so that gravity shows which way is down.
HELD_TICKS, HELD_SWINGS = 25, 8
# A swing rises at least so much, or it cannot be distinguished from standing, m.
_RISE_M: Final = 0.025
# Ticks of an ascent and of a descent.
_TICKS: Final = (9, 18)


def free_swings(
    leg: Leg,
    start_rad: Sequence[float],
    rng: np.random.Generator,
    *,
    amplitude_rad: float,
    max_step_rad: float,
) -> Iterator[list[float]]:
    """Yield goals of one leg, tick by tick, without end.

    Args:
        leg: with a geometry; its limits are kept.
        start_rad: (J,) where it is now.
        rng: of the poses and paces.
        amplitude_rad: how far from there a joint may go.
        max_step_rad: largest step of a joint in a tick.

    Raises:
        ConfigurationError: it cannot lift its foot that way.
    """
    home = np.array(start_rad, dtype=np.float64)
    lower, upper = home - amplitude_rad, home + amplitude_rad
    if leg.limits is not None:
        low, high = np.array(leg.limits.lower_rad), np.array(leg.limits.upper_rad)
        margin = 0.05 * (high - low)  # Limits are kept off by this share of the range between them.
        # A joint that is found outside its limits may stay, and go no further out.
        lower = np.maximum(lower, np.minimum(low + margin, home))
        upper = np.minimum(upper, np.maximum(high - margin, home))
    here = home
    for swing in itertools.count(1):
        low, high = _pair(leg, lower, upper, rng)
        for target in (high, low):
            yield from _move(here, target, rng, max_step_rad)
            here = target
        rest = REST_TICKS if swing % HELD_SWINGS else HELD_TICKS
        yield from (here.tolist() for _ in range(rest))


def _pair(leg: Leg, lower: Array, upper: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    assert leg.chain is not None
    for _ in range(400):
        one, other = rng.uniform(lower, upper), rng.uniform(lower, upper)
        heights = leg.chain.foot(np.stack([one, other]))[:, 2]
        if abs(heights[1] - heights[0]) >= _RISE_M:
            return (one, other) if heights[1] > heights[0] else (other, one)
    raise ConfigurationError(
        f"leg '{leg.id}' cannot lift its foot by {100 * _RISE_M:.1f} cm from where it is; give a "
        "larger --amplitude, or move it away from its limits"
    )


def _move(
    start: Array, end: Array, rng: np.random.Generator, max_step_rad: float
) -> Iterator[list[float]]:
    # The profile's top speed is 15/8 of its mean.
    least = int(np.ceil(1.875 * np.abs(end - start).max() / max_step_rad))
    ticks = max(int(rng.integers(_TICKS[0], _TICKS[1] + 1)), least)
    share = np.arange(1, ticks + 1) / ticks
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    for row in start + smooth[:, None] * (end - start):
        yield row.tolist()


# Goals of a leg, one per tick, given the first sample of it.
Script = Callable[[ServoSample], Iterator[list[float]]]


class _Basket:
    """Keeps the samples of one port, and answers them with goals."""

    def __init__(self, scripts: Mapping[str, Script], print_line: Callable[[str], None]) -> None:
        self.kept: dict[str, list[ServoSample]] = {}
        self.mailbox = Mailbox()
        self.error: AdaptiveContactError | None = None
        self.print_line = print_line
        self._scripts = scripts
        self._running: dict[str, Iterator[list[float]]] = {}

    def samples(self, samples: Mapping[str, ServoSample]) -> None:
        """Keep a tick's samples; each asks for its leg's next goal."""
        for leg, sample in samples.items():
            self.kept.setdefault(leg, []).append(sample)
            if leg in self._scripts and self.error is None:
                self._answer(leg, sample)

    def status(self, status: BridgeStatus) -> None:
        """Ignore the status: what happens is said."""

    def _answer(self, leg: str, sample: ServoSample) -> None:
        try:
            if leg not in self._running:
                self._running[leg] = self._scripts[leg](sample)
            goal = next(self._running[leg])
        except AdaptiveContactError as error:
            self.error = error  # raised on the thread that waits
            return
        payload = encode(Command(desired=goal))
        self.mailbox.store_command(leg, payload, MSGPACK, time.monotonic_ns())


def collect(
    plans: Sequence[PortPlan],
    seconds: float,
    *,
    scripts: Mapping[str, Script] | None = None,
    realtime: bool = False,
    stop: threading.Event | None = None,
    print_line: Callable[[str], None] = lambda _: None,
    on_samples: Callable[[dict[str, list[ServoSample]]], None] = lambda _: None,
) -> dict[str, list[ServoSample]]:
    """Run all ports for some time, a thread each.

    Args:
        plans: the ports; handshakes have been made.
        seconds: how long, from the first sample.
        scripts: goals by leg; with them the servos are driven, without them nothing is written.
        realtime: let the ports' threads run before all ordinary ones.
        stop: ends it early when set.
        print_line: called with what happens.
        on_samples: shown what there is so far, ten times a second; not to be changed.

    Returns:
        Samples by leg, in order.

    Raises:
        AdaptiveContactError: a port cannot be opened, or a leg cannot do what its script says.
    """
    mode: Literal["observe", "drive"] = "observe" if scripts is None else "drive"
    end, halt = stop or threading.Event(), threading.Event()
    baskets = [_Basket(scripts or {}, print_line) for _ in plans]
    run = time.time_ns() // 1_000_000

    def run_port(plan: PortPlan, basket: _Basket) -> None:
        refused = raise_priority() if realtime else None
        if refused is not None:
            print_line(refused)
        try:
            PortLoop(plan, mode, basket, basket.mailbox, run).run(halt)
        except AdaptiveContactError as error:
            basket.error = error

    threads = [
        threading.Thread(target=run_port, args=pair, name=f"port-{pair[0].name}", daemon=True)
        for pair in zip(plans, baskets, strict=True)
    ]
    # Five for the first sample; ports wake their servos in a tenth of it
    until = time.monotonic() + 5.0 + seconds
    for thread in threads:
        thread.start()
    try:
        swinging = False
        while time.monotonic() < until and not end.wait(0.1):
            kept = _all(baskets)
            on_samples(kept)
            if not swinging and any(kept.values()):
                swinging, until = True, time.monotonic() + seconds
            if any(basket.error is not None for basket in baskets):
                break
    finally:
        halt.set()
        for thread in threads:
            thread.join(5.0)
    for basket in baskets:
        if basket.error is not None:
            raise basket.error
    return _all(baskets)


def _all(baskets: Sequence[_Basket]) -> dict[str, list[ServoSample]]:
    # Copies first: the ports' threads go on adding.
    return {leg: rows for basket in baskets for leg, rows in [*basket.kept.items()]}
