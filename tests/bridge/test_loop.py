"""A port's loop in real time against virtual servos: modes, outages, faults."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from described import AX, SCS, STS, XL

from adaptive_contact.bridge.packets import BROADCAST_ID, Codec, Instruction, version_of
from adaptive_contact.wire import MSGPACK
from waiting import Every


@pytest.mark.parametrize("kind", [AX, XL, STS, SCS])
def test_observing_never_writes(run: Callable, kind: dict) -> None:
    r = run("observe", **kind)
    r.command("l0", 0.5, 0.5, 0.5)
    r.catcher.wait(lambda c: len(c.ticks) >= 40)
    assert all(servo.writes == 0 for servo in r.rig.port.servos)
    # On a busy machine an answer may come too late now and then.
    r.catcher.wait(lambda c: c.ticks[-1]["l1"].valid is None)
    sample = next(tick["l1"] for tick in reversed(r.catcher.ticks) if tick["l1"].valid is None)
    assert sample.run == 11
    assert sample.valid is None
    assert sample.phase is None
    assert sample.measured == pytest.approx([0.0] * 3, abs=0.003)


@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_samples_are_a_tick_apart_and_numbered(run: Callable, kind: dict) -> None:
    r = run("observe", **kind)
    r.catcher.wait(lambda c: len(c.ticks) >= 60 and c.statuses)
    samples = [tick["l0"] for tick in r.catcher.ticks]
    seqs = [s.seq for s in samples]
    assert seqs == sorted(set(seqs))
    # A busy machine makes single ticks late: the earliest of each half show the period.
    late_s = [s.t_ns / 1e9 - samples[0].t_ns / 1e9 - 0.02 * s.seq for s in samples]
    half = len(late_s) // 2
    assert min(late_s[:half]) == pytest.approx(min(late_s[half:]), abs=0.015)
    status = r.catcher.statuses[0]
    assert status.port == "p0"
    assert status.state == "running"
    assert status.cycle_ms.p50 > 0


def test_the_sample_pairs_a_reading_with_the_command_written_after_it(run: Callable) -> None:
    r = run("drive", ticks=3, **XL)
    r.catcher.wait(r.commanding([0.01, 0.0, 0.0])(lambda c: c.ticks[-1]["l0"].desired[0] > 0.009))
    servo = r.rig.servo(1)

    def agrees(c: Any) -> bool:
        # A sync write is not answered: the servo takes it a little later than we tell of it.
        steps = servo.value("goal_position") - servo.model.centre
        return c.ticks[-1]["l0"].desired[0] == pytest.approx(steps * servo.model.step_rad, abs=1e-9)

    r.catcher.wait(agrees)


def test_a_command_stream_that_stops_is_held_and_told(run: Callable) -> None:
    r = run("drive", ticks=5, **AX)
    r.command("l0", 0.1, 0.1, 0.1)
    r.catcher.wait(lambda c: any("holding the last goal" in line for line in c.lines))
    writes = [r.rig.servo(i).writes for i in (1, 2, 3)]
    r.catcher.go_on(10)
    assert [r.rig.servo(i).writes for i in (1, 2, 3)] == writes
    r.catcher.wait(lambda c: c.statuses and c.statuses[-1].state == "holding")
    assert r.catcher.statuses[-1].holding == ["l0"]


def test_bad_commands_are_counted_and_change_nothing(run: Callable) -> None:
    r = run("drive", ticks=5, **AX)
    r.command("l0", 0.1)
    r.catcher.go_on(3)
    r.mailbox.store_command("l0", b"\xc1", MSGPACK, 0)
    r.catcher.wait(lambda c: c.statuses and c.statuses[-1].commands_refused == 2)
    assert r.rig.servo(1).writes == 0


@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_a_driven_leg_goes_on_without_a_dead_servo_after_a_pulled_cable_and_says_so(
    run: Callable, kind: dict
) -> None:
    r = run("drive", ticks=5, **kind)

    feed = r.commanding([0.4] * 3)
    r.lose_servo_and_cable(2)
    at = pytest.approx([0.4, 0.0, 0.4], abs=0.02)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == at))
    told = "leg l0: goes on without servo 2 (no answer)"
    r.catcher.wait(feed(lambda c: f"port p0: {told}" in c.lines))
    r.catcher.wait(feed(lambda c: c.statuses and c.statuses[-1].note == told))
    assert r.rig.servo(2).writes == 0
    assert not any("answers again" in line for line in r.catcher.lines), "it never did"
    r.rig.fault()
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    r.catcher.wait(feed(lambda c: c.statuses[-1].note is None))


def test_a_leg_none_of_whose_servos_can_be_read_says_that_its_commands_wait(run: Callable) -> None:
    r = run("drive", ticks=5, **AX)
    r.rig.fault(*(f"silent:id={i}" for i in (1, 2, 3)))
    told = "leg l0: commands wait for servo 1, 2, 3 (no answer)"
    feed = r.commanding([0.4] * 3)
    r.catcher.wait(feed(lambda c: c.statuses and c.statuses[-1].note == told))
    assert all(r.rig.servo(i).writes == 0 for i in (1, 2, 3))


def test_a_preview_is_in_the_sample_of_its_command(run: Callable) -> None:
    r = run("drive", ticks=3, **XL)
    feed = r.commanding([0.0] * 3, preview=[[0.1, 0.0, 0.0], [9.0, 0.0, 0.0]])
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].preview is not None))
    [first, second] = r.catcher.ticks[-1]["l0"].preview
    assert first == pytest.approx([0.1, 0.0, 0.0])
    assert second == pytest.approx([0.25, 0.0, 0.0])  # no further than a goal would go
    r.catcher.go_on(5)
    assert r.catcher.ticks[-1]["l0"].preview is None


@pytest.mark.parametrize("mode", ["observe", "drive"])
def test_a_pulled_cable_is_survived(run: Callable, mode: str) -> None:
    r = run(mode, **AX)
    r.catcher.wait(lambda c: len(c.ticks) >= 10)
    if mode == "drive":
        commanded = r.commanding([0.1] * 3)
        r.catcher.wait(commanded(lambda c: c.ticks[-1]["l0"].desired[0] > 0))
    r.rig.fault("hangup:@0+1000000")
    r.catcher.wait(lambda c: any("is gone" in line for line in c.lines))
    r.catcher.wait(lambda c: c.statuses and c.statuses[-1].state == "lost")
    seq = r.catcher.ticks[-1]["l0"].seq
    r.rig.fault()
    r.catcher.go_on(1)
    assert r.catcher.ticks[-1]["l0"].seq > seq + 10  # the gap shows
    r.catcher.wait(lambda c: c.statuses[-1].reconnects == 1)
    if mode == "drive":  # nothing moves again before the next command
        writes = r.rig.servo(1).writes
        r.catcher.go_on(20)
        assert r.rig.servo(1).writes == writes


def test_stale_readings_are_marked(run: Callable) -> None:
    r = run("drive", ticks=5, **AX)
    goal = [0.8]
    r.rig.fault("stale:id=1,p=0.2")

    def feed(c: Any) -> bool:
        if c.ticks[-1]["l0"].measured[0] * goal[0] > 0.5:
            goal[0] = -goal[0]
        r.command("l0", goal[0], 0.0, 0.0)
        return sum(1 for t in c.ticks if t["l0"].valid == [False, True, True]) >= 5

    r.catcher.wait(feed, 20.0)


# -- Looking on while another controller talks on the same bus: its packets, and what they br

READ, WRITE, SYNC_WRITE = Instruction.READ, Instruction.WRITE, Instruction.SYNC_WRITE
SWING_RAD = 0.3


class Controller(Every):
    """Another master: writes goals, reads servos, and talks while others do.

    What it says goes to the servos and, as on a wire, to the bridge's ear as well.
    """

    def __init__(self, rig: Any) -> None:
        self._port = rig.port
        self._model = self._port.servos[0].model
        self._codec = Codec(version_of(self._model.protocol))
        self._fd = os.open(Path(rig.plans[0].port.device), os.O_RDWR | os.O_NOCTTY)
        self._rng = np.random.default_rng(3)
        super().__init__(0.002, self._talk)

    def _talk(self) -> None:
        width, goal = self._codec.version, self._model.registers["goal_position"]
        place, size = (x.to_bytes(width, "little") for x in (goal.address, goal.size))
        steps = round(SWING_RAD * math.sin(3.0 * time.monotonic()) / self._model.step_rad)
        data = goal.data(self._model.centre + steps)
        servo, what = int(self._rng.integers(1, 7)), self._rng.uniform()
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
        self.close()
        os.close(self._fd)


@pytest.fixture
def controller(ended: Callable) -> Callable[[Any], Controller]:
    return lambda rig: ended(Controller(rig))


@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_an_observer_bears_another_master_and_counts_what_it_breaks(
    run: Callable, controller: Callable, kind: dict
) -> None:
    r = run("observe", ticks=5, **kind)
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
