"""Safety of commanded movements, and the rules of the cycle that need no bus."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.bridge.bus import Reading
from adaptive_contact.bridge.drive import Driver, complaint
from adaptive_contact.bridge.health import (
    ASK_EVERY,
    SILENT_AFTER,
    Punctuality,
    ServoHealth,
    due,
    is_stale,
)
from adaptive_contact.bridge.loop import LEAD_SHARE, PhaseLock
from adaptive_contact.bridge.plan import LegPlan, plan_ports
from adaptive_contact.robot import parse_robot
from adaptive_contact.wire import BridgeStatus, Command, Quantiles, ServoCounts, encode

TICK_NS = 20_000_000


def leg() -> LegPlan:
    text = """
    [robot]
    name = "r"
    period_s = 0.02
    quantum_rad = 0.005
    [port.a]
    device = "x"
    [[leg]]
    id = "l"
    joints = ["x", "y"]
    servos = { ids = [1, 2], max_step_rad = 0.1 }
    limits = { lower_rad = [-0.5, -1.0], upper_rad = [0.5, 1.0] }
    """
    return plan_ports(parse_robot(text, source="r"))[0].legs[0]


angle = st.floats(-3.0, 3.0)


@settings(max_examples=200, deadline=None)
@given(
    start=st.tuples(st.floats(-0.5, 0.5), st.floats(-1.0, 1.0)),
    commands=st.lists(st.none() | st.tuples(angle, angle), max_size=60),
    lost=st.sets(st.integers(0, 60)),
)
def test_goals_stay_within_limits_and_steps_whatever_is_commanded(
    start: tuple[float, float], commands: list[tuple[float, float] | None], lost: set[int]
) -> None:
    plan = leg()
    driver = Driver(plan)
    measured = list(start)
    last, heard = None, False
    for k, command in enumerate(commands):
        if command is not None:
            driver.receive(Command(desired=list(command)), k * TICK_NS)
            heard = True
        here = [None, None] if k in lost else measured
        goal = driver.step(here, k * TICK_NS)
        if not heard:
            assert goal is None
        if goal is None:
            continue
        before = measured if last is None else last
        for now, then, joint in zip(goal, before, plan.joints, strict=True):
            assert abs(now - then) <= plan.max_step_rad + 1e-12
            assert joint.lower_rad - 1e-9 <= now <= joint.upper_rad + 1e-9
        last = goal


def test_a_joint_outside_its_limits_comes_back_and_goes_no_further() -> None:
    driver = Driver(leg())
    driver.receive(Command(desired=[0.9, 0.0]), 0)
    assert driver.step([0.7, 0.0], 0) == pytest.approx([0.7, 0.0])
    driver.receive(Command(desired=[0.0, 0.0]), 1)
    assert driver.step([0.7, 0.0], 1)[0] < 0.7


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (Command(desired=[0.0]), "a row has 1 values; expected 2 finite ones"),
        (Command(desired=[0.0] * 2, preview=[[0.0] * 2] * 65), "preview has 65 ticks; 64 at most"),
        (Command(desired=[0.0, float("nan")]), "expected 2 finite ones"),
        (Command(desired=[0.0, 0.0], preview=[[0.0]]), "a row has 1 values"),
    ],
)
def test_commands_that_cannot_be_used(command: Command, words: str) -> None:
    assert words in complaint(command, 2)


def test_silent_servos_are_asked_in_turn_and_come_back() -> None:
    health = {i: ServoHealth() for i in range(4)}
    for _ in range(SILENT_AFTER):
        for i in (1, 2):
            health[i].record_reading(Reading(None, (), "no_answer"))
    asked = [due(health, k) for k in range(4 * ASK_EVERY)]
    assert all({0, 3} <= set(a) for a in asked)
    assert all(a[:2] == [0, 3] for a in asked)  # a silent one comes last
    extra = [set(a) - {0, 3} for a in asked]
    assert [e for e in extra if e] == [{1}, {2}, {1}, {2}]
    assert len([1 for k in range(4) if len(due(health, k, hurry=True)) == 3]) == 4
    health[1].record_reading(Reading(b"\0"))
    assert not health[1].silent


@pytest.mark.parametrize(
    ("asked_ms", "answered_ms", "speed", "rad"),
    [
        (2.0, 2.5, 4.0, 0.0),
        (5.0, 5.5, 4.0, -0.01),  # asked late: 3 ms at 4 rad/s, in whole steps of 5 mrad
        (5.0, 5.5, -4.0, 0.01),
        (1.0, 1.5, 4.0, 0.005),
        (5.0, 5.5, 0.5, 0.0),  # hardly moves
        (2.0, 5.5, 4.0, None),  # answered late: nobody knows when it looked
        (2.0, 3.5, 4.0, 0.0),  # by half a step
        (9.0, 9.5, 4.0, None),  # too long ago
        (9.0, 9.5, 0.1, 0.0),
    ],
)
def test_a_reading_off_its_moment_is_carried_back_where_that_moment_is_known(
    asked_ms: float, answered_ms: float, speed: float, rad: float | None
) -> None:
    punctual = Punctuality()
    for _ in range(50):
        assert punctual.correction(0.002, 0.0025, 4.0, 0.005) == 0.0
    found = punctual.correction(asked_ms / 1000, answered_ms / 1000, speed, 0.005)
    assert found == (None if rad is None else pytest.approx(rad))
    assert punctual.correction(0.002, 0.0025, 4.0, 0.005) == 0.0


def test_a_bus_that_has_become_slower_is_its_usual_moment_soon() -> None:
    punctual = Punctuality()
    for _ in range(50):
        punctual.correction(0.002, 0.0025, 4.0, 0.005)
    after = [punctual.correction(0.008, 0.0085, 4.0, 0.005) for _ in range(6)]
    assert after == [None, None, 0.0, 0.0, 0.0, 0.0]


def test_alarms_are_shown_and_fade() -> None:
    record = ServoHealth()
    record.record_reading(Reading(b"\0", ("overload",)))
    assert record.counts.alarms == ["overload"]
    for _ in range(100):
        record.record_reading(Reading(b"\0"))
    assert record.counts.alarms == []
    assert record.counts.faults == {"overload": 1}


@pytest.mark.parametrize(
    ("steps", "before", "speed", "stale"),
    [(500, 500, 2.0, True), (500, 500, 0.1, False), (501, 500, 2.0, False)],
)
def test_stale_is_a_position_that_stays_while_the_servo_says_it_moves(
    steps: int, before: int, speed: float, stale: bool
) -> None:
    assert is_stale(steps, before, speed, speed, 0.005 / 0.02) is stale


@pytest.mark.parametrize("write_at_s", np.linspace(0.0, 0.019, 8).tolist())
def test_the_phase_lock_comes_to_the_writes_from_anywhere(write_at_s: float) -> None:
    """Goals change once a period, at a phase of their own that drifts; the reading has to end
    up within one lead behind the writes."""
    period, drift = 0.02, 2e-6  # 100 ppm
    lock = PhaseLock(period)

    def goal(t: float) -> int:
        return int(np.floor((t - write_at_s) / (period + drift)))

    t, last = 1.0, None
    gaps = []
    for _ in range(1500):
        before, now = goal(t - lock.lead_s), goal(t)
        gaps.append((t - write_at_s) % (period + drift))
        shift = lock.update(before=before, now=now, last=last)
        last = now
        t += period + shift
    assert lock.locked
    settled = np.array(gaps[-1000:])
    # Behind the writes, never before them, and no further than the lead and a step.
    assert settled.max() < 1.2 * LEAD_SHARE * period
    assert settled.min() > 0.0


def test_a_status_of_18_servos_in_trouble_fits_the_smallest_client() -> None:
    faults = {"no_answer": 10**6, "corrupt": 10**6, "stale": 10**6, "overload": 10**6}
    status = BridgeStatus(
        port="left",
        t_ns=2**62,
        mode="observe",
        state="running",
        rate_hz=50.0,
        wanted_hz=50.0,
        cycle_ms=Quantiles(p50=1.234, p90=1.234, p99=1.234, max=1.234),
        jitter_ms=Quantiles(),
        cycles=10**9,
        missed=0,
        servos={
            str(i): ServoCounts(silent=True, alarms=["overload"], faults=faults) for i in range(18)
        },
    )
    assert len(encode(status)) < 4000
