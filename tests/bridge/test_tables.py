"""Control tables: each register against others' tables, and what names and numbers mean."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from adaptive_contact.bridge.discovery import find_servos, group
from adaptive_contact.bridge.modes import slope_rad
from adaptive_contact.bridge.tables import MODELS, models_named
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import parse_robot
from adaptive_contact.robot.write import write_robot


def test_every_register_is_where_others_tools_have_it() -> None:
    """Each register of each model, against tables that nobody here has typed."""
    path = Path(__file__).parent / "control_tables.json"
    told = json.loads(path.read_text(encoding="utf-8"))["tables"]
    for model in MODELS:
        compared: set[str] = set()
        for table in told:
            if model.number not in table["models"]:
                continue
            for name, place in table["registers"].items():
                register = model.registers[name]
                assert [register.address, register.size] == place, (model.name, name, table)
                compared.add(name)
        assert compared == set(model.registers), model.name


def test_a_family_of_two_control_tables_is_none() -> None:
    assert [m.name for m in models_named("XM-540")] == ["XM540-W150", "XM540-W270"]
    with pytest.raises(ConfigurationError, match=r"may be MX-106 or MX-106\(2\.0\), which have"):
        models_named("MX-10")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("2xc430w251", "did you mean '2XC430-W250'"),
        ("AX-12B", "did you mean 'AX-12"),
        ("foo", "expected one such as AX-12A; all that are known are in docs"),
        ("", "expected one such as"),
    ],
)
def test_a_name_of_no_model(name: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        models_named(name)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 200


# -- Slopes of servos from their registers, and descriptions of mixed robots

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
        for servo in r.port.servos:
            servo.store("lower_slope", 64)
            servo.store("upper_slope", 64)
        slope = 0.328
    found = find_servos("p0", str(tmp_path / "p0"))
    robot = parse_robot(write_robot(group([found], 3)), source="written")
    assert robot.servo.slope_rad == slope
    assert all(servo.writes == 0 for servo in r.port.servos)


def test_legs_of_other_servos_have_a_quantum_of_their_own(rig: Callable, tmp_path: Path) -> None:
    rig(model="AX-12A", protocol=1, legs=1)
    one = find_servos("ax", str(tmp_path / "p0"))
    rig(model="XL330-M288", protocol=2, legs=1)
    other = find_servos("xl", str(tmp_path / "p0"))
    robot = parse_robot(write_robot(group([one, other], 3)), source="written")
    assert robot.quantum("leg1") == pytest.approx(math.radians(300) / 1023, rel=1e-3)
    assert robot.quantum("leg2") == pytest.approx(X_STEP, rel=1e-3)
    assert robot.leg("leg2").servos.port == "xl"
