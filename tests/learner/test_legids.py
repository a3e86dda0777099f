"""Whose samples come under a leg's name: against another geometry of feet, and random bodies."""

from __future__ import annotations

import dataclasses
import itertools

import msgspec
import numpy as np

from adaptive_contact.checks.conventions.motion import LegMotion
from adaptive_contact.checks.leg_ids import judge_ids
from adaptive_contact.robot import Mount, Robot, foot, inverse, shipped_robot

TICKS = 600
PERIOD_NS = 20_000_000


def turned(points: np.ndarray, by: np.ndarray | float) -> np.ndarray:
    """Points (..., 2) turned about the origin."""
    (x, y), c, s = np.moveaxis(points, -1, 0), np.cos(by), np.sin(by)
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def commands_of(robot: Robot, seed: int) -> dict[str, LegMotion]:
    """Commands of legs that stand on a body which moves and turns."""
    at = np.random.default_rng(seed).uniform(0.0, 6.0, 3) + np.arange(TICKS)[:, None] * 0.05
    way, turn = 0.02 * np.sin(at[:, :2] * [1.0, 0.7]), 0.06 * np.sin(at[:, 2])
    found = {}
    for leg in robot.legs:
        home = foot(np.array([0.0, 0.6, -1.9]), leg.lengths_m, leg.joint_axes)
        place, yaw = np.array(leg.mount.xyz_m[:2]), leg.mount.yaw_rad
        on_body = turned(turned(home[:2], yaw) + place - way, -turn)
        aim = np.column_stack([turned(on_body - place, -yaw), np.full(TICKS, home[2])])
        desired = inverse(aim, leg.lengths_m)
        standing = np.zeros(TICKS, dtype=bool)
        lifted = desired + np.array([0.0, 0.02, 0.0])  # the ground holds the foot up
        found[leg.id] = LegMotion(np.arange(TICKS) * PERIOD_NS, lifted, desired, standing)
    return found


def odd_robot() -> Robot:
    """A body that looks the same from no two sides."""
    robot = shipped_robot()
    rng = np.random.default_rng(2)
    legs = []
    for leg in robot.legs[:4]:
        mount = Mount(
            xyz_m=(*(np.array(leg.mount.xyz_m[:2]) + rng.uniform(-0.03, 0.03, 2)).tolist(), 0.0),
            yaw_rad=leg.mount.yaw_rad + float(rng.uniform(-0.3, 0.3)),
        )
        legs.append(msgspec.structs.replace(leg, mount=mount))
    return msgspec.structs.replace(robot, legs=tuple(legs))


def test_every_permutation_of_an_odd_body_is_found() -> None:
    robot = odd_robot()
    rows = commands_of(robot, 1)
    ids = robot.leg_ids
    assert judge_ids(robot, None, rows) == {}
    for order in itertools.permutations(ids):
        swapped = {name: rows[owner] for name, owner in zip(ids, order, strict=True)}
        found = judge_ids(robot, None, swapped)
        expected = {name: owner for name, owner in zip(ids, order, strict=True) if name != owner}
        assert {name: owner.leg for name, owner in found.items()} == expected


def test_nothing_is_said_without_mounts_or_of_legs_that_hang() -> None:
    robot = odd_robot()
    rows = commands_of(robot, 1)
    a, b, *_ = robot.leg_ids
    swapped = {**rows, a: rows[b], b: rows[a]}
    bare = tuple(msgspec.structs.replace(leg, mount=Mount()) for leg in robot.legs)
    assert judge_ids(msgspec.structs.replace(robot, legs=bare), None, swapped) == {}
    hung = {leg: dataclasses.replace(of, measured=of.desired) for leg, of in swapped.items()}
    assert judge_ids(robot, None, hung) == {}
    # Each to and fro by itself.
    wild = np.cumsum(np.random.default_rng(3).normal(0.0, 0.01, (4, TICKS, 3)), axis=1)
    own = {
        leg: dataclasses.replace(of, measured=angles, desired=angles)
        for (leg, of), angles in zip(rows.items(), wild, strict=True)
    }
    assert judge_ids(robot, None, own) == {}
