"""A port's loop in real time against virtual servos: modes, outages, faults."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from adaptive_contact.bridge.loop import PortLoop
from adaptive_contact.bridge.outlet import Mailbox
from adaptive_contact.bridge.status import ServoCounts
from adaptive_contact.wire import MSGPACK, Command, encode

AX = {"model": "AX-12A", "protocol": 1}
XL = {"model": "XL-330", "protocol": 2}
FAST = {**XL, "extra": "fast = true"}
SPEAKS = ServoCounts()


class Running:
    """A loop on a thread."""

    def __init__(self, rig: Any, mode: Any, catcher: Any) -> None:
        self.rig, self.catcher = rig, catcher
        self.mailbox = Mailbox()
        self.loop = PortLoop(rig.plans[0], mode, catcher, self.mailbox, run=11)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.loop.run, args=(self._stop,), daemon=True)
        self._thread.start()

    def command(self, leg: str, *desired: float, preview: list[list[float]] | None = None) -> None:
        payload = encode(Command(desired=list(desired), preview=preview))
        self.mailbox.put(leg, payload, MSGPACK, time.monotonic_ns())

    def end(self) -> None:
        self._stop.set()
        self._thread.join(5.0)
        assert not self._thread.is_alive()


@pytest.fixture
def run(rig: Callable, catcher: Callable) -> Iterator[Callable[..., Running]]:

    running: list[Running] = []

    def start(mode: str, **kind: Any) -> Running:
        made = rig(**kind)
        running.append(Running(made, mode, catcher(len(made.plans[0].legs))))
        return running[-1]

    yield start
    for one in running:
        one.end()


@pytest.mark.parametrize("kind", [AX, XL])
def test_observing_never_writes(run: Callable, kind: dict) -> None:
    r = run("observe", **kind)
    r.command("l0", 0.5, 0.5, 0.5)
    r.catcher.wait(lambda c: len(c.ticks) >= 40)
    assert all(servo.writes == 0 for port in r.rig.ports for servo in port.servos)
    sample = r.catcher.ticks[-1]["l1"]
    assert sample.run == 11
    assert sample.valid is None
    assert sample.phase is None
    assert sample.measured == pytest.approx([0.0] * 3, abs=0.003)


@pytest.mark.parametrize("kind", [AX, XL])
def test_samples_are_a_tick_apart_and_numbered(run: Callable, kind: dict) -> None:
    r = run("observe", **kind)
    r.catcher.wait(lambda c: len(c.ticks) >= 60 and c.statuses)
    samples = [tick["l0"] for tick in r.catcher.ticks]
    seqs = [s.seq for s in samples]
    assert seqs == sorted(set(seqs))
    span_s = (samples[-1].t_ns - samples[0].t_ns) / 1e9
    assert span_s == pytest.approx(0.02 * (seqs[-1] - seqs[0]), abs=0.015)
    status = r.catcher.statuses[0]
    assert status.port == "p0"
    assert status.state == "running"
    assert status.cycle_ms.p50 > 0


@pytest.mark.parametrize("kind", [AX, XL])
def test_driving_moves_what_was_asked_for_and_nothing_else(run: Callable, kind: dict) -> None:
    r = run("drive", **kind)
    r.catcher.wait(lambda c: len(c.ticks) >= 20)
    assert all(servo.writes == 0 for port in r.rig.ports for servo in port.servos)

    def feed(c: Any) -> bool:
        r.command("l0", 0.3, -0.2, 5.0)
        return bool(c.ticks) and c.ticks[-1]["l0"].measured == pytest.approx(
            [0.3, -0.2, 1.0], abs=0.02
        )

    r.catcher.wait(feed)
    # The other leg has neither torque nor goal from us.
    assert all(r.rig.servo(i).writes == 0 for i in (4, 5, 6))
    steps = [
        abs(b - a)
        for before, after in zip(r.catcher.ticks, r.catcher.ticks[1:], strict=False)
        for a, b in zip(before["l0"].desired, after["l0"].desired, strict=True)
    ]
    assert max(steps) <= 0.15 + 0.006


def test_the_sample_pairs_a_reading_with_the_command_written_after_it(run: Callable) -> None:
    r = run("drive", **XL)
    r.catcher.wait(lambda c: len(c.ticks) >= 3)

    def feed(c: Any) -> bool:
        r.command("l0", 0.01, 0.0, 0.0)
        return c.ticks[-1]["l0"].desired[0] > 0.009

    r.catcher.wait(feed)
    servo = r.rig.servo(1)

    def agrees(c: Any) -> bool:
        # A sync write is not answered: the servo takes it a little later than we tell of it.
        steps = servo.value("goal_position") - servo.model.centre
        return c.ticks[-1]["l0"].desired[0] == pytest.approx(steps * servo.model.step_rad, abs=1e-9)

    r.catcher.wait(agrees)


def test_a_command_stream_that_stops_is_held_and_told(run: Callable) -> None:
    r = run("drive", **AX)
    r.catcher.wait(lambda c: len(c.ticks) >= 5)
    r.command("l0", 0.1, 0.1, 0.1)
    r.catcher.wait(lambda c: any("holding the last goal" in line for line in c.lines))
    writes = [r.rig.servo(i).writes for i in (1, 2, 3)]
    ticks = len(r.catcher.ticks)
    r.catcher.wait(lambda c: len(c.ticks) >= ticks + 10)
    assert [r.rig.servo(i).writes for i in (1, 2, 3)] == writes
    r.catcher.wait(lambda c: c.statuses and c.statuses[-1].state == "holding")
    assert r.catcher.statuses[-1].holding == ["l0"]


def test_bad_commands_are_counted_and_change_nothing(run: Callable) -> None:
    r = run("drive", **AX)
    r.catcher.wait(lambda c: len(c.ticks) >= 5)
    r.command("l0", 0.1)
    ticks = len(r.catcher.ticks)
    r.catcher.wait(lambda c: len(c.ticks) >= ticks + 3)
    r.mailbox.put("l0", b"\xc1", MSGPACK, 0)
    r.catcher.wait(lambda c: c.statuses and c.statuses[-1].commands_refused == 2)
    assert r.rig.servo(1).writes == 0


@pytest.mark.parametrize("kind", [AX, XL])
def test_a_silent_servo_harms_no_other_and_comes_back(run: Callable, kind: dict) -> None:
    r = run("observe", **kind)
    r.catcher.wait(lambda c: len(c.ticks) >= 10)
    r.rig.fault("silent:id=2")
    r.catcher.wait(lambda c: c.ticks[-1]["l0"].valid == [True, False, True])
    ticks = len(r.catcher.ticks)
    r.catcher.wait(lambda c: len(c.ticks) >= ticks + 50)
    # A busy computer may let another answer come too late now and then.
    during = r.catcher.ticks[ticks:]
    assert sum(tick["l0"].valid == [True, False, True] for tick in during) >= 0.9 * len(during)
    assert sum(tick["l1"].valid is None for tick in during) >= 0.9 * len(during)
    assert r.catcher.statuses[-1].servos["2"].silent
    assert r.catcher.statuses[-1].servos["2"].faults["no_answer"] >= 3
    r.rig.fault()
    began = time.monotonic()
    r.catcher.wait(lambda c: c.ticks[-1]["l0"].valid is None, 2.0)
    assert time.monotonic() - began < 1.0


def stand(rig: Any, steps: int, servos: tuple[int, ...] = (1, 2, 3)) -> int:
    """Servos that hold a load so many steps below the goal that another program has written."""
    for i in servos:
        goal = rig.servo(i).model.centre + steps
        rig.servo(i)._store("torque_enable", 1)
        rig.servo(i)._store("goal_position", goal)
    return goal


def goals_written(servo: Any) -> list[int]:
    """Goals that are written to a servo from now on."""
    goals, write, register = [], servo.write, servo.model.registers["goal_position"]

    def spy(address: int, data: bytes) -> Any:
        if address == register.address:
            goals.append(int.from_bytes(data, "little"))
        return write(address, data)

    servo.write = spy
    return goals


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("kind", [AX, XL])
def test_a_standing_robot_is_taken_over_from_the_goals_in_force(
    run: Callable, kind: dict, again: bool
) -> None:
    r = run("drive", **kind)
    r.catcher.wait(lambda c: len(c.ticks) >= 5)
    goal = stand(r.rig, 60)
    written = goals_written(r.rig.servo(1))
    if again:  # after an outage as well
        r.rig.fault("hangup:@0+1000000")
        r.catcher.wait(lambda c: any("is gone" in line for line in c.lines))
        r.rig.fault()
        r.catcher.wait(lambda c: any("is back" in line for line in c.lines))
    step = r.rig.servo(1).model.step_rad

    def feed(_: Any) -> bool:
        r.command("l0", 90 * step, 60 * step, 60 * step)
        return bool(written) and written[-1] == goal + 30

    r.catcher.wait(feed)
    assert written[0] >= goal
    assert written == sorted(written)  # never away from the goal in force, nor back


@pytest.mark.parametrize("kind", [AX, XL])
def test_a_servo_that_was_silent_and_has_held_its_goal_goes_on_from_it(
    run: Callable, kind: dict
) -> None:
    r = run("drive", **kind)

    def feed(true: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def check(c: Any) -> Any:
            r.command("l0", 0.4, 0.4, 0.4)
            return true(c)

        return check

    r.catcher.wait(lambda c: len(c.ticks) >= 3)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    servo = r.rig.servo(2)
    r.rig.fault("silent:id=2")
    r.catcher.wait(feed(lambda c: c.statuses and c.statuses[-1].servos.get("2", SPEAKS).silent))
    assert any("servo 2 (l0 j1): no answer" in line for line in r.catcher.lines)
    r.rig.backend._angle[1] -= 0.1  # it sags under a load, and drives all it has
    r.rig.backend._driven[1] = False
    goal, written = servo.value("goal_position"), goals_written(servo)
    r.rig.fault()
    r.catcher.wait(feed(lambda c: len(written) >= 10))
    assert set(written) == {goal}
    r.catcher.wait(feed(lambda c: any("2 (l0 j1): answers again" in line for line in c.lines)))


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("kind", [AX, XL])
def test_a_servo_that_was_silent_is_not_driven_blindly_and_wakes_gently(
    run: Callable, kind: dict, held: bool
) -> None:
    r = run("drive", **kind)

    def feed(true: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def check(c: Any) -> Any:
            r.command("l0", 0.4, 0.4, 0.4)
            return true(c)

        return check

    r.catcher.wait(lambda c: len(c.ticks) >= 3)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    r.rig.fault("silent:id=2")
    while_silent = (lambda true: true) if held else feed
    r.catcher.wait(
        while_silent(lambda c: c.statuses and c.statuses[-1].servos.get("2", SPEAKS).silent)
    )
    r.rig.servo(2)._store("torque_enable", 0)  # it has lost its power
    r.rig.backend.place(1, -0.6)  # and was moved by hand
    writes, others, ticks = r.rig.servo(2).writes, r.rig.servo(1).writes, len(r.catcher.ticks)
    r.catcher.wait(while_silent(lambda c: len(c.ticks) >= ticks + 20))
    assert r.rig.servo(2).writes == writes
    assert held or r.rig.servo(1).writes > others
    r.rig.fault()
    if held:  # no command comes while it is away, nor when it is back
        r.catcher.wait(lambda c: c.ticks[-1]["l0"].valid is None)
    ticks = len(r.catcher.ticks)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured[1] < -0.5))
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    goals = [t["l0"].desired[1] for t in r.catcher.ticks[ticks:]]
    back = next(k for k, goal in enumerate(goals) if goal < 0.0)
    assert goals[back] == pytest.approx(-0.6, abs=0.05)
    assert (
        max(b - a for a, b in zip(goals[back:], goals[back + 1 :], strict=False)) < 0.15 / 5 + 0.006
    )


def test_a_leg_with_a_dead_servo_is_still_there_after_a_pulled_cable(run: Callable) -> None:
    r = run("observe", **AX)
    r.catcher.wait(lambda c: len(c.ticks) >= 5)
    r.rig.fault("silent:id=2")
    r.catcher.wait(lambda c: c.ticks[-1]["l0"].valid == [True, False, True])
    r.rig.fault("silent:id=2", "hangup:@0+1000000")
    r.catcher.wait(lambda c: any("is gone" in line for line in c.lines))
    r.rig.fault("silent:id=2")
    r.catcher.wait(lambda c: any("is back" in line for line in c.lines))
    ticks = len(r.catcher.ticks)
    r.catcher.wait(lambda c: len(c.ticks) >= ticks + 20)  # the catcher keeps whole ticks only
    assert r.catcher.ticks[-1]["l0"].valid == [True, False, True]


def test_a_preview_is_in_the_sample_of_its_command(run: Callable) -> None:
    r = run("drive", **XL)
    r.catcher.wait(lambda c: len(c.ticks) >= 3)

    def feed(c: Any) -> bool:
        r.command("l0", 0.0, 0.0, 0.0, preview=[[0.1, 0.0, 0.0], [9.0, 0.0, 0.0]])
        return c.ticks[-1]["l0"].preview is not None

    r.catcher.wait(feed)
    [first, second] = r.catcher.ticks[-1]["l0"].preview
    assert first == pytest.approx([0.1, 0.0, 0.0])
    assert second == pytest.approx([0.25, 0.0, 0.0])  # no further than a goal would go
    ticks = len(r.catcher.ticks)
    r.catcher.wait(lambda c: len(c.ticks) >= ticks + 5)
    assert r.catcher.ticks[-1]["l0"].preview is None


@pytest.mark.parametrize("mode", ["observe", "drive"])
def test_a_pulled_cable_is_survived(run: Callable, mode: str) -> None:
    r = run(mode, **AX)
    r.catcher.wait(lambda c: len(c.ticks) >= 10)
    if mode == "drive":
        r.command("l0", 0.1, 0.1, 0.1)
        r.catcher.wait(lambda c: c.ticks[-1]["l0"].desired[0] > 0)
    r.rig.fault("hangup:@0+1000000")
    r.catcher.wait(lambda c: any("is gone" in line for line in c.lines))
    r.catcher.wait(lambda c: c.statuses and c.statuses[-1].state == "lost")
    ticks = len(r.catcher.ticks)
    seq = r.catcher.ticks[-1]["l0"].seq
    r.rig.fault()
    began = time.monotonic()
    r.catcher.wait(lambda c: len(c.ticks) > ticks)
    assert time.monotonic() - began < 2.0
    assert r.catcher.ticks[-1]["l0"].seq > seq + 10  # the gap shows
    r.catcher.wait(lambda c: c.statuses[-1].reconnects == 1)
    if mode == "drive":  # nothing moves again before the next command
        writes = r.rig.servo(1).writes
        ticks = len(r.catcher.ticks)
        r.catcher.wait(lambda c: len(c.ticks) >= ticks + 20)
        assert r.rig.servo(1).writes == writes


def test_stale_readings_are_marked(run: Callable) -> None:
    r = run("drive", **AX)
    r.catcher.wait(lambda c: len(c.ticks) >= 5)
    goal = [0.8]
    r.rig.fault("stale:id=1,p=0.2")

    def feed(c: Any) -> bool:
        if c.ticks[-1]["l0"].measured[0] * goal[0] > 0.5:
            goal[0] = -goal[0]
        r.command("l0", goal[0], 0.0, 0.0)
        return sum(1 for t in c.ticks if t["l0"].valid == [False, True, True]) >= 5

    r.catcher.wait(feed, 20.0)


def test_overload_is_reported(run: Callable) -> None:
    r = run("observe", **XL)
    r.rig.fault("error:id=5,bits=overload")
    r.catcher.wait(lambda c: c.statuses and "5" in c.statuses[-1].servos)
    r.catcher.wait(lambda c: "overload" in c.statuses[-1].servos["5"].alarms)
    assert r.catcher.ticks[-1]["l1"].valid is None  # the position is good all the same


@pytest.mark.parametrize("kind", [AX, XL, FAST])
def test_wrong_checksums_are_told_of_in_the_status(run: Callable, kind: dict) -> None:
    r = run("observe", **kind)
    r.catcher.wait(lambda c: len(c.ticks) >= 5)
    r.rig.fault("flip:id=5,p=0.2")
    r.catcher.wait(
        lambda c: (
            c.statuses and c.statuses[-1].servos.get("5", SPEAKS).faults.get("corrupt", 0) >= 3
        )
    )


@pytest.mark.parametrize("kind", [AX, XL])
def test_a_servo_that_shuts_itself_down_is_told_of_and_woken_gently(
    run: Callable, kind: dict
) -> None:
    r = run("drive", **kind)
    goal = [0.4]

    def feed(true: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def check(c: Any) -> Any:
            r.command("l0", goal[0], goal[0], goal[0])
            return true(c)

        return check

    r.catcher.wait(lambda c: len(c.ticks) >= 3)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    servo = r.rig.servo(2)
    r.rig.fault("error:id=2,bits=overload")
    r.catcher.wait(feed(lambda c: any("2 (l0 j1): shut down" in line for line in c.lines)))
    assert any("2 (l0 j1): overload" in line for line in r.catcher.lines)
    r.catcher.wait(
        feed(lambda c: c.statuses and "shutdown" in c.statuses[-1].servos.get("2", SPEAKS).alarms)
    )
    r.rig.fault()
    writes, ticks, goal[0] = servo.writes, len(r.catcher.ticks), 0.0
    r.catcher.wait(feed(lambda c: len(c.ticks) >= ticks + 60))
    assert servo.writes == writes
    assert not servo.drives
    # The others go on; this one hangs where it was.
    assert r.catcher.ticks[-1]["l0"].measured == pytest.approx([0.0, 0.4, 0.0], abs=0.02)
    written, ticks = goals_written(servo), len(r.catcher.ticks)
    if kind is AX:
        # It drives again at once, to the goal in its register.
        servo.write(servo.model.registers["torque_limit"].address, b"\xff\x03")
    else:
        servo.reboot()
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.0] * 3, abs=0.02)))
    assert written[0] * servo.model.step_rad == pytest.approx(
        servo.model.centre * servo.model.step_rad + 0.4, abs=0.05
    )
    easy = 0.15 / 5 / servo.model.step_rad
    assert max(a - b for a, b in itertools.pairwise(written)) <= easy + 1
    r.catcher.wait(feed(lambda c: any("no longer shut down" in line for line in c.lines)))
