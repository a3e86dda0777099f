"""Standing feet of a made-up quadruped, whose angles are solved for here."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from adaptive_contact.checks.conventions.judge import ConventionFinding, check_motion
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.robot import shipped_robot

TICKS, CYCLE = 1500, 100
STEP_RAD = 0.001534
PHASES = {
    "walk": ({"fl": 0.0, "rr": 0.25, "fr": 0.5, "rl": 0.75}, 0.75),
    "trot": ({"fl": 0.0, "rr": 0.0, "fr": 0.5, "rl": 0.5}, 0.55),
}


def motions(gait: str, turn: Callable = np.array, *, phase: bool) -> dict[str, LegMotion]:
    """Commands of a body that moves straight on over its standing feet."""
    robot = shipped_robot("quadruped")
    starts, duty = PHASES[gait]
    made = {}
    for leg in robot.legs:
        thigh, shank = leg.lengths_m
        at = (np.arange(TICKS) / CYCLE + starts[leg.id]) % 1
        swing = at >= duty
        share = np.where(swing, (at - duty) / (1 - duty), at / duty)
        ahead = 0.03 * np.where(swing, share - 0.5, 0.5 - share)
        x = 0.06 + np.cos(leg.mount.yaw_rad) * ahead
        z = -0.11 + np.where(swing, 0.03 * np.sin(np.pi * share), 0.0)
        far = np.hypot(x, z)
        knee = -np.arccos((far**2 - thigh**2 - shank**2) / (2 * thigh * shank))
        hip = np.arctan2(z, x) - np.arctan2(shank * np.sin(knee), thigh + shank * np.cos(knee))
        desired = np.rint(np.column_stack([hip, knee]) / STEP_RAD) * STEP_RAD
        measured = desired + 0.01 * ~swing[:, None]  # the ground pushes up
        seq = np.arange(TICKS)
        made[leg.id] = LegMotion(
            seq * 20_000_000, seq, turn(measured), turn(desired), swing if phase else None
        )
    return made


def accused(gait: str, turn: Callable = np.array, *, phase: bool) -> list[ConventionFinding]:
    found = check_motion(shipped_robot("quadruped"), motions(gait, turn, phase=phase))
    return [finding for finding in found.values() if finding is not None]


@pytest.mark.parametrize("gait", ["walk", "trot"])
@pytest.mark.parametrize("phase", [True, False])
def test_feet_that_go_in_a_line_show_no_zeros_and_none_are_told(gait: str, phase: bool) -> None:
    assert accused(gait, phase=phase) == []
    off = accused(gait, lambda q: q - [0.3, -0.6], phase=phase)
    assert all(not any(one.offsets_rad) for one in off)


@pytest.mark.parametrize("signs", [(-1, -1), (1, -1), (-1, 1)])
def test_signs_of_a_quadruped_that_walks_are_found(signs: tuple[int, int]) -> None:
    found = accused("walk", lambda q: q * signs, phase=True)
    assert [one.leg for one in found] == ["fl", "fr", "rl", "rr"]
    assert {one.directions for one in found} == {signs}
