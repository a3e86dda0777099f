"""A leg whose goals go beyond what its servos do: found, said, used from then on, and saved."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.checks.limits import STOP_RAD
from adaptive_contact.robot import parse_robot

ROBOT = (
    '[robot]\nname = "stops"\nperiod_s = 0.02\nquantum_rad = 0.0015\n[[leg]]\nid = "a"\n'
    'joints = ["coxa", "femur", "tibia"]\nlengths_m = [0.052, 0.066, 0.138]\n'
)
LIMITS = "limits = { lower_rad = [-2.0, -0.2, -2.0], upper_rad = [2.0, 0.25, 2.0] }\n"


def samples(ticks: int) -> list[ServoSample]:
    """Swings up and down to places at random, with a femur that goes from -0.2 to 0.25 rad."""
    rng, at, rows = np.random.default_rng(1), np.zeros(3), []
    while len(rows) < ticks:
        up, down = rng.uniform([-0.5, 0.1, -0.5], 0.6), rng.uniform(-0.6, [0.5, -0.1, 0.5])
        for to in (up, down):
            for k in range(15):
                x = (1.0 - math.cos(math.pi * k / 14)) / 2.0
                rows.append((at + x * (to - at), "swing"))
            at = to
        rows += [(at, "stance")] * 12
    y, made = rows[0][0].copy(), []
    for k, (u, phase) in enumerate(rows):
        read = np.round(y / 0.0015 + 0.3 * rng.standard_normal(3)) * 0.0015
        made.append(
            ServoSample(
                t_ns=k * 20_000_000, seq=k, measured=read.tolist(), desired=u.tolist(), phase=phase
            )
        )
        y = y + 0.35 * (np.clip(u, [-9.0, -0.2, -9.0], [9.0, 0.25, 9.0]) - y)
    return made


@pytest.mark.parametrize("described", [True, False])
def test_the_model_sees_where_the_goals_end(described: bool) -> None:
    robot = parse_robot(ROBOT + LIMITS * described, source="stops")
    learner = ContactLearner(robot, "a")
    for sample in samples(1000):
        learner.update(sample)
    limits = learner.report.source.limits
    assert limits.lower[1] == pytest.approx(-0.2, abs=STOP_RAD)
    assert limits.upper[1] == pytest.approx(0.25, abs=STOP_RAD)
    assert not np.isfinite([*limits.lower[[0, 2]], *limits.upper[[0, 2]]]).any()
    note = learner.report.source.limits_note or ""
    assert note.startswith("goals go beyond what the servos do (femur stops at -0.")
    place = learner.place
    kept = place.batch.kept_angles[place.row, : place.leg.kept_n, 4]
    assert (kept.min(), kept.max()) == (limits.lower[1], limits.upper[1])

    again = ContactLearner(robot, "a")
    assert again.restore(learner.snapshot()) is None
    assert all(map(np.array_equal, again.report.source.limits, limits))
