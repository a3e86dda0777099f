"""Steps of readings, some of which lie between two; what too few ticks do not show."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from adaptive_contact.service.findings import Cause
from adaptive_contact.service.position_step import position_step
from adaptive_contact.service.readings import check_readings
from adaptive_contact.wire import ServoSample

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
    found = [position_step(swung(rng, ticks, AX, between), AX) for _ in range(12)]
    assert not [step for step in found if step is not None and off(step, AX)]


@pytest.mark.parametrize("step", [AX / 2, AX / 3, 2 * AX, math.tau / 4096, 0.0015, 0.02])
@pytest.mark.parametrize(("ticks", "between"), [(150, 0.0), (600, 0.2), (600, 0.4)])
def test_another_step_is_found_all_the_same(step: float, ticks: int, between: float) -> None:
    rng = np.random.default_rng(2)
    found = [position_step(swung(rng, ticks, step, between), AX) for _ in range(8)]
    assert not [one for one in found if off(one, step)]


@pytest.mark.parametrize("between", [0.0, 0.15])
def test_nobody_needs_to_know_the_step(between: float) -> None:
    rng = np.random.default_rng(3)
    for step in (AX, math.tau / 4096):
        assert not off(position_step(swung(rng, 600, step, between)), step)


def causes(measured: Array, desired: Array) -> list[Cause]:
    rows = zip(measured.tolist(), desired.tolist(), strict=True)
    samples = [
        ServoSample(t_ns=20_000_000 * k, seq=k, measured=read, desired=told)
        for k, (read, told) in enumerate(rows)
    ]
    names = [f"j{j}" for j in range(measured.shape[1])]
    return [fault.cause for fault in check_readings(samples, names, AX)]


def commanded(still: int, moving: int) -> Array:
    """(still + moving, 1) commands of a joint that begins to swing after some ticks."""
    told = np.concatenate([np.zeros(still), 0.4 * np.sin(np.arange(moving) / 8.0)])
    return np.round(told / AX)[:, None] * AX


@pytest.mark.parametrize(
    ("of", "cause"),
    [
        (lambda told: np.full_like(told, 0.1), Cause.FROZEN),
        (lambda told: np.roll(told, 4, axis=0) + 0.8, Cause.FAR),
        (lambda told: -np.roll(told, 4, axis=0), Cause.BACKWARDS),
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
        if cause is not Cause.FROZEN:
            read += AX * rng.integers(-1, 2, read.shape)
        assert (cause in causes(read, told)) is judged, (still, moving)


def test_a_joint_that_is_sent_elsewhere_once_and_does_not_go_is_frozen() -> None:
    told = np.concatenate([np.zeros(20), np.full(60, 0.2)])[:, None]
    assert causes(np.zeros_like(told), told) == [Cause.FROZEN]
    assert causes(np.zeros((40, 1)), told[:40]) == []
