"""Steps of readings, some of which lie between two; what too few ticks do not show."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from adaptive_contact import ServoSample
from adaptive_contact.checks.findings import Cause, Fault, entries
from adaptive_contact.checks.position_step import position_step
from adaptive_contact.checks.readings import check_readings

AX = math.radians(300.0) / 1023
Array = NDArray[np.float64]


def swung(rng: np.random.Generator, ticks: int, step: float, between: float = 0.0) -> Array:
    """(ticks,) readings of a joint that swings, a share of them carried off their lines."""
    swing = 0.3 * np.sin(np.arange(ticks) * math.tau / rng.uniform(25, 60) + rng.uniform(0, 6))
    lines = np.round((swing + rng.normal(0.0, 0.02, ticks)) / step) * step
    carried = rng.random(ticks) < between
    return np.where(carried, lines + rng.uniform(-0.03, 0.03, ticks), lines)


def off(found: float | None, step: float) -> bool:
    return found is None or abs(found / step - 1.0) > 0.01


@pytest.mark.parametrize("between", [0.1, 0.2, 0.3, 0.5])
@pytest.mark.parametrize("ticks", [40, 70, 100])
def test_readings_between_two_lines_do_not_make_the_step_finer(ticks: int, between: float) -> None:
    rng = np.random.default_rng(ticks)
    found = [position_step(swung(rng, ticks, AX, between)) for _ in range(12)]
    assert not [step for step in found if step is not None and off(step, AX)]


@pytest.mark.parametrize("step", [AX / 2, AX / 3, 2 * AX, math.tau / 4096, 0.0015, 0.02])
@pytest.mark.parametrize(("ticks", "between"), [(150, 0.0), (600, 0.2), (600, 0.4)])
def test_another_step_is_found_all_the_same(step: float, ticks: int, between: float) -> None:
    rng = np.random.default_rng(2)
    found = [position_step(swung(rng, ticks, step, between)) for _ in range(8)]
    assert not [one for one in found if off(one, step)]


@pytest.mark.parametrize("part", [1 / 2, 1 / 3, 1 / 6, 0.4])
def test_one_reading_off_the_lines_leaves_the_step(part: float) -> None:
    """Its two gaps are fractions of the step, and all others are whole in them."""
    lines = AX * np.arange(68.0)
    read = np.append(lines, AX * (30.0 + part))
    assert not off(position_step(read), AX)


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("places", [1, 2, 5, 8])
def test_readings_without_steps_that_rest_in_few_places_have_none(
    places: int, noise: float
) -> None:
    rng = np.random.default_rng(places)
    found = []
    for _ in range(2):
        at = rng.uniform(-1.0, 1.0, places)
        goals = np.repeat(at[rng.integers(0, places, 60)], 20)
        ramp = np.convolve(goals, np.ones(8) / 8, "valid")
        readings = ramp + rng.normal(0.0, noise, len(ramp))
        found += [position_step(readings)]
    assert found == [None] * 2


def faults(
    measured: Array,
    desired: Array,
    quantum_rad: float | None = AX,
    limits: tuple[tuple[float, float], ...] = ((-3.0, 3.0),) * 2,
) -> list[Fault]:
    rows = zip(measured.tolist(), desired.tolist(), strict=True)
    samples = [
        ServoSample(t_ns=20_000_000 * k, seq=k, measured=read, desired=told)
        for k, (read, told) in enumerate(rows)
    ]
    names = [f"j{j}" for j in range(measured.shape[1])]
    return list(check_readings(samples, names, quantum_rad, limits[: len(names)]))


def causes(measured: Array, desired: Array, quantum_rad: float | None = AX) -> list[Cause]:
    return [fault.cause for fault in faults(measured, desired, quantum_rad)]


def swings(rng: np.random.Generator, ticks: int = 600) -> Array:
    """(ticks, 2) commands of swings with rests between them."""
    goals, rows = np.zeros(2), []
    while len(rows) < ticks:
        to, n = rng.uniform(-0.7, 0.7, 2), int(rng.integers(12, 30))
        share = np.arange(1, n + 1)[:, None] / n
        rows += list(goals + (3 * share**2 - 2 * share**3) * (to - goals)) + [to] * 10
        goals = to
    return np.array(rows[:ticks])


def late(commands: Array, ticks: int) -> Array:
    return commands[np.maximum(np.arange(len(commands)) - ticks, 0)]


def followed(rng: np.random.Generator, commands: Array, delay: int, rad_s: float) -> Array:
    """What a critically damped servo makes of its commands, so many ticks of 20 ms late."""
    at, speed, rows = commands[0].copy(), np.zeros(2), []
    for goal in late(commands, delay):
        rows.append(at + rng.normal(0.0, 2e-4, 2))
        for _ in range(20):
            speed += 1e-3 * (rad_s**2 * (goal - at) - 2 * rad_s * speed)
            at = at + 1e-3 * speed
    return np.array(rows)


STEPS = [AX, math.tau / 4096, 1e-4, None]


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("rad_s", [40.0, 100.0, 400.0])
def test_a_servo_that_follows_closely_is_no_copy(rad_s: float, step: float | None) -> None:
    for delay in range(5):
        rng = np.random.default_rng(delay)
        told = swings(rng)
        read = followed(rng, told, delay, rad_s)
        for grid in (step, None):  # readings in the steps that are said, and floats
            shown = read if grid is None else np.round(read / grid) * grid
            found = [fault for fault in faults(shown, told, step) if fault.level == "error"]
            assert not found, (delay, grid)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("rounds", [np.round, np.floor, None])
def test_a_copy_is_one_by_any_delay_and_rounding(rounds: object, step: float | None) -> None:
    told = swings(np.random.default_rng(7))
    grid = step or math.tau / 4096
    for delay in range(13):
        copy = late(told, delay)
        if rounds is not None:
            copy = rounds(copy / grid) * grid  # type: ignore[operator]
        # Rounded, it may be a light joint that carries nothing; to the last bit, no joint is.
        named = "echo" if rounds is None else "near_echo"
        assert causes(copy, told, step)[0] == named, delay


@pytest.mark.parametrize("commanded", [True, False], ids=["command too", "reading only"])
@pytest.mark.parametrize("first", [0, 7])
def test_a_sample_that_is_a_turn_off_puts_no_other_beyond_its_limits(
    first: int, commanded: bool
) -> None:
    rng = np.random.default_rng(6)
    told = swings(rng)
    read = followed(rng, told, 1, 40.0)
    read[first::37, 0] += math.tau
    if commanded:
        told[first::37, 0] += math.tau
    assert causes(read, told, 1e-4) == ["turn"]


@pytest.mark.parametrize("turns", [1, -2])
@pytest.mark.parametrize("from_the_start", [False, True])
def test_turns_that_come_and_go_are_no_degrees(turns: int, from_the_start: bool) -> None:
    rng = np.random.default_rng(5)
    told = swings(rng)
    read = followed(rng, told, 1, 40.0)
    away = (np.arange(len(told)) // 90 % 2 == 0) == from_the_start
    read[away, 0] += turns * math.tau
    assert "turn" in causes(read, told, None)
    assert not {"units", "limits"} & set(causes(read, told, None))
    assert causes(np.degrees(read), np.degrees(told), None) == ["units"]


@pytest.mark.parametrize(("share", "named"), [(0.1, False), (0.6, True)])
def test_joints_beyond_their_limits_are_named_where_they_are_so_for_long(
    share: float, named: bool
) -> None:
    rng = np.random.default_rng(6)
    told = swings(rng) + np.where(np.arange(600) < share * 600, 3.9, 0.0)[:, None]
    read = followed(rng, told, 1, 40.0)
    found = [fault for fault in faults(read, told, None) if fault.cause == "limits"]
    assert len(found) == (2 if named else 0)
    assert all(f"in {share:.0%} of the samples" in (fault.detail or "") for fault in found)


@pytest.mark.parametrize(("times", "level"), [(1, "note"), (2, "note"), (9, "warning")])
def test_what_befalls_a_few_readings_is_a_note(times: int, level: str) -> None:
    rng = np.random.default_rng(8)
    told = swings(rng)
    read = followed(rng, told, 1, 40.0)
    read[50 : 50 + 40 * times : 40, 0] += 0.5
    (entry,) = entries(("lf", fault) for fault in faults(read, told, 1e-4))
    assert (entry.cause, entry.level) == ("glitches", level)


def commanded(still: int, moving: int) -> Array:
    """(still + moving, 1) commands of a joint that begins to swing after some ticks."""
    told = np.concatenate([np.zeros(still), 0.4 * np.sin(np.arange(moving) / 8.0)])
    return np.round(told / AX)[:, None] * AX


@pytest.mark.parametrize(
    ("of", "cause"),
    [
        (lambda told: np.full_like(told, 0.1), "frozen"),
        (lambda told: np.roll(told, 4, axis=0) + 0.8, "far"),
        (lambda told: -np.roll(told, 4, axis=0), "backwards"),
    ],
    ids=["frozen", "far", "backwards"],
)
def test_what_a_joint_makes_of_its_command_takes_fifty_ticks_of_it(
    of: object, cause: Cause
) -> None:
    rng = np.random.default_rng(4)
    for still, moving, judged in ((200, 40, False), (5, 40, False), (5, 90, True)):
        told = commanded(still, moving)
        read = np.round((of(told) + 0.0) / AX) * AX  # type: ignore[operator]
        if cause != "frozen":
            read += AX * rng.integers(-1, 2, read.shape)
        assert (cause in causes(read, told)) is judged, (still, moving)


def test_a_joint_that_is_sent_elsewhere_once_and_does_not_go_is_frozen() -> None:
    told = np.concatenate([np.zeros(20), np.full(60, 0.2)])[:, None]
    assert causes(np.zeros_like(told), told) == ["frozen"]
    assert causes(np.zeros((40, 1)), told[:40]) == []


@pytest.mark.parametrize("described", [True, False])
def test_goals_beyond_what_a_servo_does_are_named(described: bool) -> None:
    rng = np.random.default_rng(7)
    goals = swings(rng, 900)
    stops = np.clip(goals, [-9.0, -0.3], [9.0, 0.3])
    measured = np.round(followed(rng, stops, 1, 25.0) / AX) * AX
    limits = ((-3.0, 3.0), (-0.3, 0.3) if described else (-3.0, 3.0))
    (fault,) = [one for one in faults(measured, goals, AX, limits) if one.cause == "goals"]
    assert (fault.detail or "").count("j1 stops at") == 2
    assert "goals" not in causes(np.round(followed(rng, goals, 1, 25.0) / AX) * AX, goals)
