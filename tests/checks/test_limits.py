"""Goals beyond what a servo does: where it stops is described or observed, and no ground is one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.checks.limits import STOP_RAD, Limits, find_limits
from adaptive_contact.robot import parse_robot
from adaptive_contact.robot.kinematics import Chain, straight

STEP = 0.0015
CHAIN = straight((0.05, 0.07, 0.14), ("yaw", "pitch", "pitch"))
FREE = Limits.none(3)
Array = np.ndarray


def commands(ticks: int, seed: int = 1) -> Array:
    """Smooth commands (ticks, 3) rad from place to place, with rests."""
    rng, at, rows = np.random.default_rng(seed), np.zeros(3), list[Array]()
    while len(rows) < ticks:
        to = rng.uniform(-0.5, 0.5, 3)
        for k in range(15):
            rows.append(at + (1.0 - math.cos(math.pi * k / 14)) / 2.0 * (to - at))
        rows += [to] * 10
        at = to
    return np.array(rows[:ticks])


def servo(u: Array, gain: float = 0.4, noise: float = 0.3) -> Array:
    """A servo of first order, its readings on the encoder's grid."""
    rng, y, at = np.random.default_rng(2), np.zeros_like(u), u[0].copy()
    for k in range(len(u)):
        y[k] = at
        at = at + gain * (u[k] - at)
    return np.asarray(np.round(y / STEP + noise * rng.standard_normal(y.shape)) * STEP)


def clipped(u: Array, *, low: float = -np.inf, high: float = np.inf) -> Array:
    v = u.copy()
    v[:, 1] = np.clip(v[:, 1], low, high)
    return v


def found(
    y: Array, u: Array, *, chain: Chain | None = CHAIN, described: Limits = FREE,
    known: Limits = FREE,
) -> tuple[list[float], list[float]]:  # fmt: skip
    limits = find_limits(chain, described, known, STEP, y, u)
    return limits.lower.tolist(), limits.upper.tolist()


NOWHERE = ([-np.inf] * 3, [np.inf] * 3)


@pytest.mark.parametrize("chain", [CHAIN, None])
@pytest.mark.parametrize("ticks", [450, 900, 2400])
def test_where_a_servo_stops_is_observed(chain: Chain | None, ticks: int) -> None:
    u = commands(ticks)
    low, high = found(servo(clipped(u, low=-0.2, high=0.25)), u, chain=chain)
    assert low == [-np.inf, pytest.approx(-0.2, abs=2 * STEP), -np.inf]
    assert high == [np.inf, pytest.approx(0.25, abs=2 * STEP), np.inf]


@pytest.mark.parametrize("gain", [0.1, 0.3, 0.9])
def test_a_servo_that_follows_stops_nowhere(gain: float) -> None:
    u = commands(2400)
    assert found(servo(u, gain), u) == NOWHERE


def test_ground_is_no_limit() -> None:
    """A foot that is pressed on flat ground stops at one height, whatever the other joints do."""
    u = commands(1200)
    u[:, 0] = u[:, 2] = 0.0  # so that the joint's angle there is always the same, too
    y = servo(clipped(u, low=-0.2))
    assert found(y, u) == NOWHERE


def test_a_frozen_joint_has_no_limit() -> None:
    u = commands(1200)
    y = servo(u)
    y[:, 1] = y[0, 1]
    assert found(y, u) == NOWHERE


def test_what_is_described_holds_from_the_first_stop_until_readings_pass_it() -> None:
    said = Limits(np.array([-1.0, -0.2, -1.0]), np.array([1.0, 0.25, 1.0]))
    u = commands(1200)
    first = int(np.argmax((u[:, 1] > 0.3) | (u[:, 1] < -0.25))) + 25
    y = servo(clipped(u, low=-0.2, high=0.25))
    low, high = found(y[:first], u[:first], described=said)
    assert (low[1], high[1]) in ((-0.2, np.inf), (-np.inf, 0.25))
    assert found(servo(u), u, described=said) == NOWHERE
    assert found(servo(u), u, described=said, known=said)[0] == [-1.0, -np.inf, -1.0]


def test_limits_are_named_clip_and_are_saved() -> None:
    limits = Limits(np.array([-np.inf, -0.2, -np.inf]), np.array([np.inf, 0.25, np.inf]))
    u = np.array([[0.0, 0.4, 0.0], [0.0, -0.1, 0.0]])
    assert limits.clip(u).tolist() == [[0.0, 0.25, 0.0], [0.0, -0.1, 0.0]]
    assert limits.reached(("coxa", "femur", "tibia"), u) == "femur stops at 0.250 rad"
    assert limits.reached(("coxa", "femur", "tibia"), u[1:]) == ""
    again = Limits.saved([of.tolist() for of in limits], 3)
    assert all(map(np.array_equal, again, limits))
    for bad in (None, [], [[0.0], [1.0]], [[1.0] * 3, [0.0] * 3], [["a"] * 3] * 2, {"a": 1}):
        assert Limits.saved(bad, 3) is None


# -- A learner finds them, says so, uses them from then on, and saves them

ROBOT = (
    '[robot]\nname = "stops"\nperiod_s = 0.02\nquantum_rad = 0.0015\n[[leg]]\nid = "a"\n'
    'joints = ["coxa", "femur", "tibia"]\nlengths_m = [0.05, 0.07, 0.14]\n'
)
LIMITS = "limits = { lower_rad = [-2.0, -0.2, -2.0], upper_rad = [2.0, 0.25, 2.0] }\n"


@pytest.mark.parametrize("described", [True, False])
def test_the_model_sees_where_the_goals_end(described: bool) -> None:
    robot = parse_robot(ROBOT + LIMITS * described, source="stops")
    learner, u = ContactLearner(robot, "a"), commands(1000)
    rows = zip(servo(clipped(u, low=-0.2, high=0.25)).tolist(), u.tolist(), strict=True)
    for k, (read, told) in enumerate(rows):
        phase = "swing" if k % 25 < 15 else "stance"
        learner.update(
            ServoSample(t_ns=k * 20_000_000, seq=k, measured=read, desired=told, phase=phase)
        )
    limits = learner.report.source.limits
    assert limits.lower[1] == pytest.approx(-0.2, abs=STOP_RAD)
    assert limits.upper[1] == pytest.approx(0.25, abs=STOP_RAD)
    assert not np.isfinite([*limits.lower[[0, 2]], *limits.upper[[0, 2]]]).any()
    note = learner.report.source.limits_note or ""
    assert note.startswith("goals go beyond what the servos do (femur stops at ")
    place = learner.place
    kept = place.batch.kept_angles[place.row, : place.leg.kept_n, 4]
    assert (kept.min(), kept.max()) == (limits.lower[1], limits.upper[1])
    again = ContactLearner(robot, "a")
    assert again.restore(learner.snapshot()) is None
    assert all(map(np.array_equal, again.report.source.limits, limits))
