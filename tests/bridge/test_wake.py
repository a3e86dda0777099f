"""Waking servos: a standing robot is taken over where it is held, and nothing jumps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from described import AX, STS, XL, goals_written

from adaptive_contact.wire import ServoCounts

SPEAKS = ServoCounts()


def stand(rig: Any, steps: int, servos: tuple[int, ...] = (1, 2, 3)) -> int:
    """Servos that hold a load so many steps below the goal that another program has written."""
    for i in servos:
        goal = rig.servo(i).model.centre + steps
        rig.servo(i).store("torque_enable", 1)
        rig.servo(i).store("goal_position", goal)
    return goal


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_a_standing_robot_is_taken_over_from_the_goals_in_force(
    run: Callable, kind: dict, again: bool
) -> None:
    r = run("drive", ticks=5, **kind)
    goal = stand(r.rig, 60)
    written = goals_written(r.rig.servo(1))
    if again:  # after an outage as well
        r.rig.fault("hangup:@0+1000000")
        r.catcher.wait(lambda c: any("is gone" in line for line in c.lines))
        r.rig.fault()
        r.catcher.wait(lambda c: any("is back" in line for line in c.lines))
    step = r.rig.servo(1).model.step_rad
    feed = r.commanding([90 * step, 60 * step, 60 * step])
    r.catcher.wait(feed(lambda _: written and written[-1] == goal + 30))
    assert written[0] >= goal
    assert written == sorted(written)  # never away from the goal in force, nor back


@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_a_servo_that_was_silent_and_has_held_its_goal_goes_on_from_it(
    run: Callable, kind: dict
) -> None:
    r = run("drive", ticks=3, **kind)

    feed = r.commanding([0.4] * 3)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    servo = r.rig.servo(2)
    r.rig.fault("silent:id=2")
    r.catcher.wait(feed(lambda c: c.statuses and c.statuses[-1].servos.get("2", SPEAKS).silent))
    # On a computer that is too busy it is named some looks later.
    r.catcher.wait(feed(lambda c: any("servo 2 (l0 j1): no answer" in line for line in c.lines)))
    r.rig.backend.place(1, r.rig.backend.angle(1) - 0.1)  # it sags under a load, and
    r.rig.backend.set_torque(1, False)  # drives all it has
    goal, written = servo.value("goal_position"), goals_written(servo)
    r.rig.fault()
    r.catcher.wait(feed(lambda c: len(written) >= 10))
    assert set(written) == {goal}
    r.catcher.wait(feed(lambda c: any("2 (l0 j1): answers again" in line for line in c.lines)))


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_a_servo_that_was_silent_is_not_driven_blindly_and_wakes_gently(
    run: Callable, kind: dict, held: bool
) -> None:
    r = run("drive", ticks=3, **kind)

    feed = r.commanding([0.4] * 3)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    r.rig.fault("silent:id=2")
    while_silent = (lambda true: true) if held else feed
    r.catcher.wait(
        while_silent(lambda c: c.statuses and c.statuses[-1].servos.get("2", SPEAKS).silent)
    )
    # What was written before is carried out once a question that was asked later is answered.
    ticks, known = len(r.catcher.ticks), [True, False, True]
    r.catcher.wait(while_silent(lambda c: any(t["l0"].valid == known for t in c.ticks[ticks:])))
    r.rig.servo(2).store("torque_enable", 0)  # it has lost its power
    r.rig.backend.place(1, -0.6)  # and was moved by hand
    writes, others = r.rig.servo(2).writes, r.rig.servo(1).writes
    r.catcher.go_on(20, while_silent)
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


@pytest.mark.parametrize("kind", [AX, XL, STS])
def test_a_servo_that_shuts_itself_down_is_told_of_and_woken_gently(
    run: Callable, kind: dict
) -> None:
    r = run("drive", **kind)
    goal = [0.4] * 3

    feed = r.commanding(goal)
    r.catcher.wait(lambda c: len(c.ticks) >= 3)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    servo = r.rig.servo(2)
    r.rig.fault("error:id=2,bits=overload")
    r.catcher.wait(feed(lambda c: any("2 (l0 j1): shut down" in line for line in c.lines)))
    r.catcher.wait(feed(lambda c: any("2 (l0 j1): overload" in line for line in c.lines)))
    r.catcher.wait(
        feed(lambda c: c.statuses and "shutdown" in c.statuses[-1].servos.get("2", SPEAKS).alarms)
    )
    r.rig.fault()
    writes = servo.writes
    goal[:] = [0.0] * 3
    r.catcher.go_on(60, feed)
    assert servo.writes == writes
    # The others go on; this one hangs where it was.
    assert r.catcher.ticks[-1]["l0"].measured == pytest.approx([0.0, 0.4, 0.0], abs=0.02)
    if kind is AX:
        # It drives again at once, to the goal in its register.
        servo.write(servo.model.registers["torque_limit"].address, b"\xff\x03")
    else:
        servo.reboot()
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.0] * 3, abs=0.02)))
    r.catcher.wait(feed(lambda c: any("no longer shut down" in line for line in c.lines)))
