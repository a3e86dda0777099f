"""What touches among ticks that are only believed free is found without a word of when."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from adaptive_contact.fit.outliers import GUARD_TICKS, untouched
from adaptive_contact.fit.train import Stretch, cautious, learn
from adaptive_contact.robot import Robot, parse_robot
from real_logs import DATA, load_logs

from .conftest import FakeLeg

Array = NDArray[np.float64]

SWINGS, ROWS = 50, 12
QUANTUM = 0.005
NOISE = 0.003


def leg(
    seed: int, pushed: dict[int, range], terms: int = 60
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Swings of a linear leg; some of their ticks are pushed by ten deviations or more."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(SWINGS * ROWS, terms)) * rng.uniform(0.1, 10.0, terms)
    true = rng.normal(size=(terms, 3)) * 0.02 / np.abs(theta).mean(axis=0)[:, None]
    target = theta @ true + NOISE * rng.normal(size=(len(theta), 3))
    touching = np.zeros(len(theta), dtype=bool)
    for swing, ticks in pushed.items():
        rows = swing * ROWS + np.array(ticks)
        touching[rows] = True
        # As ground does, the same way each time: what a fit can explain away.
        target[rows] += np.array([0.01, 0.03, -0.03]) * rng.uniform(0.5, 2.0, (len(rows), 1))
    position = np.arange(len(theta)) + 10 * (np.arange(len(theta)) // ROWS)
    return theta, target, position, touching


@pytest.mark.parametrize("tail", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_touches_are_found_and_free_ticks_stay(seed: int, tail: bool) -> None:
    """Where many swings touch, the light touches go with them."""
    pushed = {n: range(8, 12) for n in range(0, SWINGS, 4)}
    pushed |= {n: range(3) for n in range(1, SWINGS, 10)}
    theta, target, position, touching = leg(seed, pushed)
    found = untouched(theta, target, position, QUANTUM, tail=tail)
    assert np.count_nonzero(found.keep & touching) <= 0.03 * touching.sum()
    assert np.count_nonzero(~found.keep & ~touching) <= 0.08 * np.count_nonzero(~touching)
    assert not tail or abs(found.touched - len(pushed)) <= 2


def test_a_tick_that_stands_out_takes_its_side_of_the_swing_along() -> None:
    theta, target, position, _ = leg(7, {})
    late, early = 20 * ROWS, 30 * ROWS
    target[late + 9] += 0.2
    target[early + 2] += 0.2
    keep = untouched(theta, target, position, QUANTUM, tail=False).keep
    assert keep[late : late + 9 - GUARD_TICKS].all()
    assert not keep[late + 9 - GUARD_TICKS : late + ROWS].any()
    assert not keep[early : early + 3 + GUARD_TICKS].any()
    assert keep[early + 3 + GUARD_TICKS : early + ROWS].all()


def test_without_touches_nearly_all_is_kept() -> None:
    theta, target, position, _ = leg(8, {})
    assert untouched(theta, target, position, QUANTUM, tail=False).keep.mean() > 0.93


def test_one_touch_is_left_out_and_the_noise_keeps_its_tail() -> None:
    theta, target, position, _ = leg(10, {})
    wide = 30 * ROWS + 5
    target[wide, 0] += 4.5 * NOISE  # noise, if rare; what always trims takes it for a touch
    before = ~untouched(theta, target, position, QUANTUM, tail=False).keep
    repeated = np.tile(theta, (3, 1)), np.tile(target, (3, 1))
    position = np.concatenate([position + n * 10_000 for n in range(3)])
    touch = 20 * ROWS + np.arange(8, 12)
    repeated[1][touch] += np.array([0.02, 0.06, -0.06])
    found = untouched(*repeated, position, QUANTUM, tail=True)
    assert before[wide]
    assert found.keep[wide]
    assert not found.keep[touch].any()
    assert found.touched == 1
    assert np.count_nonzero(~found.keep) <= len(touch) + GUARD_TICKS


def test_a_baseline_of_swings_that_touched_is_as_good_as_one_of_free_swings(robot: Robot) -> None:
    """Of the same leg, stopped in every other swing, with and without a word of when."""
    measured, desired, swing, touching = FakeLeg(seed=5).run(
        900, touch=lambda n: 15 if n % 2 else None
    )
    sound = np.ones(len(swing), dtype=bool)
    pressed = touching.copy()
    for later in (1, 2, 3):
        pressed[later:] |= touching[:-later]
    free = swing & ~pressed
    told = learn(robot, {"rf": [Stretch(measured, desired, swing, free, sound)]}, origin="truth")
    mask = cautious(swing)
    assert np.count_nonzero(mask & touching) > 0.02 * np.count_nonzero(mask)
    believed = Stretch(measured, desired, swing, mask, sound, certain=False)
    found = learn(robot, {"rf": [believed]}, origin="no truth")
    assert 350 <= found.figures["rf"].touched <= 550
    assert (found.baseline.thresholds(1.0) < 2.0 * told.baseline.thresholds(1.0)).all()
    worse = np.array(found.figures["rf"].held_out_rms) / told.figures["rf"].held_out_rms
    assert worse.max() < 1.1
    # As it would be if all were taken at their word.
    taken = learn(robot, {"rf": [dataclasses.replace(believed, certain=True)]}, origin="all")
    assert (taken.baseline.thresholds(1.0) > 3.0 * told.baseline.thresholds(1.0)).any()


# -- Free motion of a real arm: what is fast, or moves only now and then, is no touch

REAL = DATA / "so101"
MOTIONS = 8
QUANTUM_RAD = 0.001534
ARM = """
[robot]
name = "arm"
period_s = 0.02
quantum_rad = 0.001534
[[leg]]
id = "arm"
joints = ["pan", "lift", "elbow"]
"""


@pytest.mark.skipif(
    not REAL.is_dir(),
    reason="no ../shared/data/so101: recordings of github.com/isaac-sim2real/sage, not part of "
    "the project",
)
def test_most_of_a_real_arms_free_ticks_are_learned() -> None:
    """A noise read off those that stand still had left out all that moved."""
    stretches = []
    moving = 0
    for motion in load_logs(REAL)[:MOTIONS]:
        measured, desired = motion.measured[:, :3], motion.desired[:, :3]
        swing = np.arange(len(measured)) % 30 < 25
        sound = np.ones(len(measured), dtype=bool)
        stretches.append(Stretch(measured, desired, swing, swing, sound, certain=False))
        steps = np.abs(np.diff(measured, axis=0)).max(axis=1) / QUANTUM_RAD
        moving += int(np.count_nonzero(steps[swing[1:]] > 2.0))
    figures = learn(parse_robot(ARM, source="arm"), {"arm": stretches}, origin="test").figures[
        "arm"
    ]
    total = figures.rows + figures.outliers
    assert moving > 0.5 * total
    assert figures.outliers < 0.2 * total
    assert figures.touched < 0.05 * figures.swings
    # Of no motion: the model is one of the moving ticks, too.
    assert (np.array(figures.held_out_rms) < 0.4 * np.array(figures.naive_rms)).all()
