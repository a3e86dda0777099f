"""Slopes of servos from their registers, and descriptions of mixed robots."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from adaptive_contact.bridge.discovery import find_servos, group, steepness
from adaptive_contact.bridge.modes import slope_rad
from adaptive_contact.bridge.tables import models_named
from adaptive_contact.robot import parse_robot
from adaptive_contact.robot.write import write_robot

X_STEP = 2 * math.pi / 4096


@pytest.mark.parametrize(
    ("model", "values", "rad"),
    [
        ("AX-12A", {"lower_slope": 32, "upper_slope": 32}, 0.164),
        ("AX-12A", {"lower_slope": 64, "upper_slope": 128}, 0.491),
        ("MX-28", {"position_p": 32}, 0.164),
        ("MX-64", {"position_p": 128}, 0.041),
        ("XL330-M288", {"position_p": 400, "pwm_limit": 885}, 283.2 * X_STEP),
        ("XM430-W350", {"position_p": 800, "pwm_limit": 885}, 141.6 * X_STEP),
        ("XM430-W350", {"position_p": 800, "pwm_limit": 442}, 70.7 * X_STEP),
        ("XM430-W350", {"position_p": 1, "pwm_limit": 885}, math.pi),
        ("XM430-W350", {"position_p": 0, "pwm_limit": 885}, None),
    ],
)
def test_slopes_of_registers(model: str, values: dict[str, int], rad: float | None) -> None:
    found = slope_rad(models_named(model)[0], values)
    assert found == (None if rad is None else pytest.approx(rad, rel=0.005))


@pytest.mark.parametrize(
    ("model", "protocol", "slope"),
    [
        ("AX-12A", 1, 0.164),
        ("XM430-W350", 2, 0.217),
        pytest.param("MX-28", 1, 0.164, marks=pytest.mark.slow),
        pytest.param("XL330-M288", 2, 0.434, marks=pytest.mark.slow),
    ],
)
def test_init_reads_the_slope_off_the_servos(
    rig: Callable, tmp_path: Path, model: str, protocol: int, slope: float
) -> None:
    r = rig(model=model, protocol=protocol)
    if model == "AX-12A":
        for servo in r.ports[0].servos:
            servo.store("lower_slope", 64)
            servo.store("upper_slope", 64)
        slope = 0.328
    found = find_servos("p0", str(tmp_path / "p0"))
    robot = parse_robot(write_robot(group([found], 3)), source="written")
    assert robot.servo.slope_rad == slope
    assert steepness([found], robot) == {model: slope}
    assert all(servo.writes == 0 for servo in r.ports[0].servos)


def test_legs_of_other_servos_have_a_quantum_of_their_own(rig: Callable, tmp_path: Path) -> None:
    rig(model="AX-12A", protocol=1, legs=1)
    one = find_servos("ax", str(tmp_path / "p0"))
    rig(model="XL330-M288", protocol=2, legs=1)
    other = find_servos("xl", str(tmp_path / "p0"))
    robot = parse_robot(write_robot(group([one, other], 3)), source="written")
    assert robot.quantum("leg1") == pytest.approx(math.radians(300) / 1023, rel=1e-3)
    assert robot.quantum("leg2") == pytest.approx(X_STEP, rel=1e-3)
    assert robot.leg("leg2").servos.port == "xl"
    assert sorted(steepness([one, other], robot)) == ["AX-12A", "XL330-M288"]
