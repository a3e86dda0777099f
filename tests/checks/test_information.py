"""Readings that are the leg's own, and such that a program made."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from adaptive_contact.checks.information import (
    NEEDED_SAMPLES,
    RIDGE,
    InformationCheck,
    Survey,
    basis,
    departure,
    equal_to_commands,
    is_old,
    low_pass,
    survey,
)
from adaptive_contact.checks.motion import LegMotion

STEP = 0.005
SWING, STRIDE = 24, 40  # ticks


def commands(strides: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Commands (n, 2) rad of strides to places at random, and which ticks swing."""
    rng = np.random.default_rng(seed)
    at, rows, swing = np.zeros(2), list[np.ndarray](), list[bool]()
    for _ in range(strides):
        top, end = rng.uniform(0.3, 0.6, 2), rng.uniform(-0.3, 0.0, 2)
        for k in range(STRIDE):
            lift = math.sin(math.pi * min(k / SWING, 1.0))
            way = (1.0 - math.cos(math.pi * k / (STRIDE - 1))) / 2.0
            rows.append(at + way * (end - at) + lift * top)
            swing.append(k < SWING)
        at = end
    return np.array(rows), np.array(swing)


def servo(
    u: np.ndarray, swing: np.ndarray, *, gain: float, delay: int = 0, load: float = 0.03,
    play: float = 0.0, seed: int = 2,
) -> np.ndarray:  # fmt: skip
    """A servo of first order that its load in stance pushes back, with play at its output."""
    rng = np.random.default_rng(seed)
    y, motor, out = np.zeros_like(u), u[0].copy(), u[0].copy()
    push = 0.0
    for k in range(len(u)):
        y[k] = out
        push += 0.4 * ((0.0 if swing[k] else load * rng.uniform(0.5, 1.5)) - push)
        motor = motor + gain * (u[max(k - delay, 0)] - motor)
        out = np.clip(out, motor - push - play / 2, motor - push + play / 2)
    return y


def grid(y: np.ndarray, step: float = STEP, noise: float = 0.1, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.asarray(np.round((y + rng.normal(0.0, noise * step, y.shape)) / step) * step)


def walked(strides: int, seed: int = 1, **of: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Commands, which ticks swing, and what is read of a leg's own servos."""
    u, swing = commands(strides, seed)
    return u, swing, grid(servo(u, swing, **{"gain": 0.4, "seed": seed + 1, **of}))


def delayed(u: np.ndarray, ticks: float) -> np.ndarray:
    k = np.arange(len(u)) - ticks
    return np.stack([np.interp(k, np.arange(len(u)), of) for of in u.T], axis=1)


def made(y: np.ndarray, u: np.ndarray, swing: np.ndarray | None = None) -> LegMotion:
    return LegMotion(np.arange(len(y)), np.arange(len(y)), y, u, swing)


def played(
    y: np.ndarray, u: np.ndarray, swing: np.ndarray, *, predicted: bool | None = None,
    step: float = STEP,
) -> tuple[InformationCheck, list[tuple[int, str | None]]]:  # fmt: skip
    """A check that has followed a stream, and what it said when."""
    check, said = InformationCheck(y.shape[1], step), list[tuple[int, str | None]]()
    all_of = made(y, u, swing)
    for at in (np.flatnonzero(np.diff(swing.astype(int))) + 2).tolist():
        newest = all_of.part(np.s_[max(at - NEEDED_SAMPLES, 0) : at])
        if check.check_strides(at, newest, begins=bool(swing[at - 1]), predicted=predicted):
            said.append((at, check.found and check.found.kind))
    return check, said


Lie = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of readings and commands
RNG = np.random.default_rng(5)
COPIES: dict[str, Lie] = {
    **{f"{ticks} ticks late": lambda _, u, t=ticks: delayed(u, t) for ticks in (0, 2.5, 4, 12)},
    "rounded": lambda _, u: grid(delayed(u, 3), noise=0.0),
    "moved": lambda _, u: delayed(u, 1) + 0.02,
    "scaled": lambda _, u: 0.5 * u,
    "noisy": lambda _, u: delayed(u, 5) + RNG.normal(0.0, 1e-4, u.shape),
    "filtered": lambda _, u: grid(low_pass(delayed(u, 2), (0.6,))[0], noise=0.0),
    "nearly all of it": lambda y, u: grid(0.95 * delayed(u, 2) + 0.05 * y, noise=0.0),
}
STALE: dict[str, Lie] = {
    "held": lambda y, _: y[3 * (np.arange(len(y)) // 3)],
    "a second old": lambda y, _: y[np.maximum(np.arange(len(y)) - 50, 0)],
}


@pytest.mark.parametrize("begin", [8 * STRIDE, 8 * STRIDE + 7, 8 * STRIDE + 30])
@pytest.mark.parametrize("name", [*COPIES, *STALE])
def test_what_carries_nothing_is_found_in_three_strides_and_over_in_five(
    name: str, begin: int
) -> None:
    u, swing, own = walked(24)
    end = begin + 6 * STRIDE
    y = own.copy()
    y[begin:end] = (COPIES | STALE)[name](own, u)[begin:end]
    kinds = ["copy"] if name in COPIES else ["held" if name == "held" else "old"]
    _, said = played(y, u, swing)
    assert [kind for _, kind in said] == [*kinds, None]
    (found, _), (over, _) = said
    whole = -(-begin // STRIDE) * STRIDE  # of the first whole stride
    assert begin < found <= whole + 3 * STRIDE + 2
    assert end < over <= end + 5 * STRIDE


@pytest.mark.parametrize("name", COPIES)
def test_when_it_began_is_known(name: str) -> None:
    u, swing, own = walked(14)
    y, begin = own.copy(), 8 * STRIDE + 5
    y[begin:] = COPIES[name](own, u)[begin:]
    check, said = played(y, u, swing)
    assert begin - 20 <= said[-1][0] - check.found.since <= begin + 2


@pytest.mark.parametrize("gain", [0.3, 0.6, 0.95])
@pytest.mark.parametrize("delay", range(5))
@pytest.mark.parametrize("step", [0.005, 0.0015, 1e-7])
def test_a_servo_that_carries_load_is_its_own(gain: float, delay: int, step: float) -> None:
    u, swing = commands(20)
    y = grid(servo(u, swing, gain=gain, delay=delay), step)
    check, said = played(y, u, swing, step=max(step, 0.0005))
    assert (said, check.suspected, check.unproved) == ([], False, False)


def test_a_leg_that_carries_nothing_is_open_where_its_model_predicts_it() -> None:
    """And once it carries load it is its own."""
    u, swing = commands(24)
    light = grid(servo(u, swing, gain=0.95, load=0.0))
    for predicted in (None, False):
        assert [kind for _, kind in played(light, u, swing, predicted=predicted)[1]] == ["copy"]
    check, said = played(light, u, swing, predicted=True)
    assert (said, check.suspected, check.unproved) == ([], True, True)
    loaded = grid(servo(u, swing, gain=0.95))
    y = np.concatenate([light[: 10 * STRIDE], loaded[10 * STRIDE :]])
    check, said = played(y, u, swing, predicted=True)
    assert (said, check.suspected, check.unproved) == ([], False, False)
    assert [kind for _, kind in played(y, u, swing)[1]] == ["copy", None]


@pytest.mark.parametrize(("predicted", "said"), [(None, []), (True, []), (False, ["copy"])])
def test_a_leg_that_stands_still_in_its_stances_is_open(
    predicted: bool | None, said: list[str]
) -> None:
    """It may carry nothing; where its model does not predict it, it is another's motion."""
    u, swing = commands(16)
    for begin in range(0, len(u), STRIDE):
        u[begin + SWING : begin + STRIDE] = u[begin + SWING - 1]
    y = grid(servo(u, swing, gain=0.4, load=0.0), noise=0.05)
    check, found = played(y, u, swing, predicted=predicted)
    assert [kind for _, kind in found] == said
    assert check.unproved == (not said)


def test_an_open_joint_that_hardly_moves_stays_open() -> None:
    u, swing = commands(20)
    u[10 * STRIDE : 16 * STRIDE, 0] = u[10 * STRIDE, 0]
    y = grid(servo(u, swing, gain=0.4))
    y[: 18 * STRIDE, 0] = grid(delayed(u, 2), noise=0.0)[: 18 * STRIDE, 0]
    for strides, unproved in ((9, True), (16, True), (20, False)):
        n = strides * STRIDE
        check, said = played(y[:n], u[:n], swing[:n], predicted=True)
        assert (said, check.unproved) == ([], unproved), strides


@pytest.mark.parametrize("noise", [0.5, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_copy_with_noise_is_found_where_the_leg_has_shown_itself(noise: float, seed: int) -> None:
    u, swing, y = walked(24, seed)
    end = 18 * STRIDE
    y[10 * STRIDE : end] = grid(delayed(u, 3), noise=noise, seed=seed)[10 * STRIDE : end]
    check, said = played(y, u, swing)
    assert [kind for _, kind in said] == ["copy", None]
    assert said[0][0] <= 14 * STRIDE + 2
    assert end < said[1][0] <= end + 5 * STRIDE
    assert not check.unproved


@pytest.mark.parametrize("noise", [0.5, 1.0])
def test_what_never_showed_itself_is_unproved_until_it_carries_load(noise: float) -> None:
    """A leg that hangs, and a copy with noise from the start on, are the same thing."""
    u, swing = commands(24)
    y = grid(delayed(u, 3), noise=noise)
    check, said = played(y[: 10 * STRIDE], u[: 10 * STRIDE], swing[: 10 * STRIDE])
    assert (said, check.unproved) == ([], True)
    y[10 * STRIDE :] = grid(servo(u, swing, gain=0.4))[10 * STRIDE :]
    check, said = played(y, u, swing)
    assert (said, check.unproved) == ([], False)


def test_a_copied_joint_that_hardly_moves_for_strides_stays_a_copy() -> None:
    u, swing = commands(24)
    still = slice(14 * STRIDE, 18 * STRIDE)
    u[still, 0] = u[still.start, 0]
    y = grid(servo(u, swing, gain=0.4))
    y[8 * STRIDE : 20 * STRIDE, 0] = delayed(u, 2)[8 * STRIDE : 20 * STRIDE, 0]
    _, said = played(y, u, swing)
    assert [kind for _, kind in said] == ["copy", None]
    assert 20 * STRIDE < said[1][0] <= 25 * STRIDE


@pytest.mark.parametrize("seed", range(6))
def test_old_readings_of_a_leg_that_carries_stay_old(seed: int) -> None:
    u, swing, own = walked(40, seed, gain=0.3, load=0.12)
    y = own.copy()
    y[8 * STRIDE : 34 * STRIDE] = np.roll(own, 50, axis=0)[8 * STRIDE : 34 * STRIDE]
    _, said = played(y, u, swing)
    assert [kind for _, kind in said] == ["old", None]
    assert said[1][0] > 34 * STRIDE


def test_one_joint_is_named() -> None:
    u, swing, y = walked(12)
    y[:, 1] = delayed(u, 2)[:, 1]
    check, _ = played(y, u, swing)
    assert check.found.joints == (1,)
    assert survey(made(y, u, swing), STEP) == Survey((1,), (), old=False)


def test_lost_samples_and_spoilt_readings_hide_nothing_and_accuse_nobody() -> None:
    u, swing = commands(30)
    kept = np.random.default_rng(4).random(len(u)) > 0.01
    for y, kinds in ((grid(servo(u, swing, gain=0.4)), []), (delayed(u, 3), ["copy"])):
        y = y.copy()
        y[::97, 0] = -math.pi
        check, said = InformationCheck(2, STEP), list[str]()
        rows = LegMotion(np.flatnonzero(kept), np.flatnonzero(kept), y[kept], u[kept])
        for at in (np.flatnonzero(np.diff(swing[kept].astype(int))) + 2).tolist():
            newest = rows.part(np.s_[max(at - NEEDED_SAMPLES, 0) : at])
            if check.check_strides(at, newest, begins=bool(swing[kept][at - 1])) and check.found:
                said.append(check.found.kind)
        assert said == kinds


@pytest.mark.parametrize("zero", [0.0, 0.3 * STEP])
@pytest.mark.parametrize("described", [STEP, 2e-6, 0.7 * STEP])
def test_a_servo_on_its_commands_grid_is_no_copy(zero: float, described: float) -> None:
    u, swing = commands(12)
    u = np.round(u / STEP) * STEP + zero
    y = np.round((servo(u, swing, gain=0.9, load=0.0) - zero) / STEP) * STEP + zero
    for last in range(200, len(u), 40):
        assert equal_to_commands(made(y, u).part(np.s_[:last]), 80, described) == ((), 80)


@pytest.mark.parametrize("zero", [0.0, 0.3 * STEP])
def test_commands_for_readings_in_swings_alone_are_found(zero: float) -> None:
    u, swing = commands(12)
    y = np.round((servo(u, swing, gain=0.4) - zero) / STEP) * STEP + zero
    y = np.where(swing[:, None], np.roll(u, 2, axis=0), y)
    joints, since = equal_to_commands(made(y, u), 120, STEP)
    assert joints == (0, 1)
    assert 110 < since <= 120


def test_copies_in_swings_alone_stay_copies_where_fewer_in_a_row_show_it() -> None:
    u, swing = commands(26)
    u = np.round(u / STEP) * STEP
    y = grid(servo(u, swing, gain=0.4))
    at, begin, end = np.arange(len(u)), 8 * STRIDE, 20 * STRIDE
    lies = swing & (at >= begin) & (at < end) & ((at < begin + 4 * STRIDE) | (at % 8 > 0))
    y[lies] = u[lies]
    _, said = played(y, u, swing)
    assert [kind for _, kind in said] == ["copy", None]
    assert end < said[1][0] <= end + 5 * STRIDE


def test_least_squares_against_a_slow_reference() -> None:
    """Its coefficients by a singular value decomposition, with the ridge as rows of its own."""
    u, _, y = walked(6)
    ticks, steps = 90, np.array([STEP, STEP])
    found = departure(made(y, u), ticks, steps)
    for joint in range(2):
        columns, read = basis(u)[joint, -ticks:], y[-ticks:, joint]
        rows = np.ones(ticks, dtype=bool)
        for last in (False, True):
            x, z = columns - columns[rows].mean(axis=0), read - read[rows].mean()
            ridge = np.sqrt(RIDGE * np.sum(x[rows] ** 2)) * np.eye(x.shape[1])
            rest = np.zeros(x.shape[1])
            weights = np.linalg.pinv(np.vstack([x[rows], ridge])) @ np.concatenate([z[rows], rest])
            off = np.where(rows, z - x @ weights, 0.0)
            if not last:
                rows[np.argsort(np.abs(off))[-2:]] = False
        moving = np.abs(np.diff(u[-ticks - 1 :, joint])) > 0.5 * STEP
        square = sum(e * e for e, m in zip(off, moving, strict=True) if m)
        free = int((moving & rows).sum()) - columns.shape[1] - 1
        assert found.rms[joint] == pytest.approx(math.sqrt(square / free) / STEP, rel=1e-3)


@pytest.mark.parametrize("pole", [0.5, 0.9])
def test_a_low_pass_is_its_recursion(pole: float) -> None:
    u, _ = commands(3)
    f = u[0].copy()
    for of, passed in zip(u, low_pass(u, (pole,))[0], strict=True):
        f = pole * f + (1.0 - pole) * of
        assert passed == pytest.approx(f, abs=1e-9)


@pytest.mark.parametrize("before", range(60))
def test_commands_of_any_past_are_looked_at(before: int) -> None:
    """However few samples there are before the ticks that are judged: of exchanged joints here."""
    u, swing = commands(6)
    y = grid(servo(u, swing, gain=0.35))[:, ::-1]
    ticks = 100
    samples = made(y, u).part(np.s_[-(ticks + before) :])
    assert is_old(samples, ticks) in (True, False)
