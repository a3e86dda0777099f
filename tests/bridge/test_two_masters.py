"""Looking on while another controller talks on the same bus: its packets, and what they break."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive_contact.bridge.packets import BROADCAST_ID, Codec, Instruction, version_of

AX = {"model": "AX-12A", "protocol": 1}
XL = {"model": "XL-330", "protocol": 2}
STS = {"model": "STS3215", "protocol": "sts"}
READ, WRITE, SYNC_WRITE = Instruction.READ, Instruction.WRITE, Instruction.SYNC_WRITE
SWING_RAD = 0.3


class Controller:
    """Another master: writes goals, reads servos, and talks while others do.

    What it says goes to the servos and, as on a wire, to the bridge's ear as well.
    """

    def __init__(self, rig: Any) -> None:
        self._port = rig.ports[0]
        self._model = self._port.servos[0].model
        self._codec = Codec(version_of(self._model.protocol))
        self._fd = os.open(Path(rig.plans[0].port.device), os.O_RDWR | os.O_NOCTTY)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        width, goal = self._codec.version, self._model.registers["goal_position"]
        place, size = (x.to_bytes(width, "little") for x in (goal.address, goal.size))
        rng = np.random.default_rng(3)
        began_s = time.monotonic()
        while not self._stop.wait(rng.uniform(0.0005, 0.004)):
            angle = SWING_RAD * math.sin(3.0 * (time.monotonic() - began_s))
            steps = self._model.centre + round(angle / self._model.step_rad)
            data = goal.data(steps)
            servo, what = int(rng.integers(1, 7)), rng.uniform()
            if what < 0.3:
                rows = b"".join(bytes((one.id,)) + data for one in self._port.servos)
                self._say(self._codec.instruction(BROADCAST_ID, SYNC_WRITE, place + size + rows))
            elif what < 0.5:  # in protocol 1.0 only its length tells it from the servo's answer
                self._say(self._codec.instruction(servo, WRITE, place + data))
            elif what < 0.8:  # only heard: the servo's own answer would come as well
                asks = self._codec.instruction(servo, READ, place + size)
                self._hear(asks + self._codec.status(servo, 0, data))
            else:  # both talk at once: what either says is broken
                self._say(self._codec.instruction(servo, WRITE, place + data)[:-3])

    def _say(self, packet: bytes) -> None:
        os.write(self._fd, packet)
        self._hear(packet)

    def _hear(self, packet: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # nobody listens now
            os.write(self._port.master, packet)

    def end(self) -> None:
        self._stop.set()
        self._thread.join(5.0)
        os.close(self._fd)


@pytest.fixture
def controller(ended: Callable) -> Callable[[Any], Controller]:
    return lambda rig: ended(Controller(rig))


@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_an_observer_bears_another_master_and_counts_what_it_breaks(
    run: Callable, controller: Callable, kind: dict
) -> None:
    r = run("observe", **kind)
    r.catcher.wait(lambda c: len(c.ticks) >= 5)
    controller(r.rig)
    ticks = len(r.catcher.ticks)

    def disturbed(c: Any) -> int:
        told = c.statuses[-1].servos.values() if c.statuses else ()
        return sum(n for servo in told for n in servo.faults.values())

    def readings(c: Any) -> list[float]:
        return [
            angle
            for tick in c.ticks[ticks:]
            for sample in tick.values()
            for angle, good in zip(sample.measured, sample.valid or [True] * 3, strict=True)
            if good
        ]

    def enough(c: Any) -> bool:  # readings, too: on a busy machine more ticks bring as many
        return len(c.ticks) >= ticks + 100 and disturbed(c) >= 5 and len(readings(c)) > 300

    r.catcher.wait(enough, 50.0)
    read = readings(r.catcher)
    samples = [sample for tick in r.catcher.ticks[ticks:] for sample in tick.values()]
    # It sees the other one's goals, and takes none of its packets for a position.
    assert max(s.desired[1] for s in samples) > 0.8 * SWING_RAD
    assert max(map(abs, read)) < SWING_RAD + 0.05
    assert all(max(map(abs, s.desired)) < SWING_RAD + 0.05 for s in samples)
    # No servo is said to complain of what another master's packets look like.
    kinds = {name for s in r.catcher.statuses[-1].servos.values() for name in s.faults}
    assert kinds <= {"no_answer", "corrupt", "stale", "unpunctual", "carried_back"}
    assert r.catcher.statuses[-1].state == "running"
