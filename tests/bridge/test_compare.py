"""What ``robot check`` says of registers that differ, or that shape the motion."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from described import Serve, robot, write

from adaptive_contact.bridge.compare import COMPARED, Servo, compare, read_servos
from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.bridge.tables import (
    models_named,
)
from adaptive_contact.robot import Port, parse_robot
from programs import invoke


def test_check_tells_what_differs_and_what_shapes_the_motion(bus: Serve) -> None:
    device, servos = bus("1-5:AX-12A", "6:AX-12A:upper_slope=64:moving_speed=200")
    legs = ((1, 2, 3), "AX-12A"), ((4, 5, 6), "AX-12A")
    described = robot(device, *legs, timeout_ms=10)
    path = device.parent / "robot.toml"
    said = invoke("robot", "check", "--config", write(path, described))
    assert (
        "CCW compliance slope differs among AX-12A: 32 in 5 servos, 64 in servo 6 (l1 j2)" in said
    )
    assert "moving speed of servo 6 (l1 j2) is 200: it limits how goals" in said
    assert said.count("differs") == 1
    assert all(servo.writes == 0 for servo in servos)


@pytest.mark.parametrize("model", ["AX-12A", "MX-106", "XL-320", "XL430-W250"])
def test_every_register_that_is_compared_is_read(bus: Serve, model: str) -> None:
    """Those at the end of a control table, too."""
    device, [servo] = bus(f"1:{model}")
    described = robot(device, ((1,), model), protocol=servo.model.protocol)
    [read] = read_servos(plan_ports(described))
    assert dict(read.values) == {
        name: servo.value(name) for name in COMPARED if name in servo.model.registers
    }


def servo_of(model: str, number: int, **values: int) -> Servo:
    return Servo(number, f"l{number} j", models_named(model)[0], values)


@pytest.mark.parametrize(
    ("servos", "lines"),
    [
        (
            [servo_of("XM430-W350", n, profile_velocity=44, drive_mode=0) for n in (1, 2)],
            ["profile velocity of all 2 servos is 44: it limits how goals are followed; 0 sets no"],
        ),
        (
            [servo_of("STS3215", 1, acceleration=20), servo_of("STS3215", 2, acceleration=0)],
            ["acceleration of servo 1 (l1 j) is 20: it limits how goals are followed"],
        ),
        (
            [servo_of("XL430-W250", n, drive_mode=n % 2) for n in (2, 4, 5)],
            ["drive mode differs among XL430-W250: 0 in 2 servos, 1 in servo 5 (l5 j) (1 is rev"],
        ),
        ([servo_of("XL430-W250", 1, pwm_limit=442), servo_of("AX-12A", 2, torque_limit=512)], []),
        (
            [servo_of("AX-12A", n, torque_limit=512 if n == 3 else 1023) for n in (1, 2, 3)],
            ["torque limit differs among AX-12A: 1023 in 2 servos, 512 in servo 3 (l3 j)"],
        ),
        (
            [servo_of("STS3215", n, max_acceleration=50 if n == 3 else 254) for n in (1, 2, 3)],
            ["max acceleration differs among STS3215: 254 in 2 servos, 50 in servo 3 (l3 j)"],
        ),
        ([servo_of("MX-28", n, position_p=32, goal_acceleration=0) for n in (1, 2)], []),
        ([servo_of("MX-28", 1, position_p=32), servo_of("MX-64", 2, position_p=8)], []),
        (
            [servo_of("AX-12A", n, return_delay=250 * (n == 3)) for n in (1, 2, 3)],
            ["return delay differs among AX-12A: 0 in 2 servos, 250 in servo 3 (l3 j)"],
        ),
    ],
)  # fmt: skip
def test_what_is_said_of_registers(servos: list[Servo], lines: list[str]) -> None:
    said = compare(servos)
    assert len(said) == len(lines), said
    for line, part in zip(said, lines, strict=True):
        assert part in line


TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"
REPLACED = [
    ["1:AX-12A:at=0.4"],
    ["9:AX-12A:baud=57600"],
    ["9:AX-18A"],
    ["9:AX-12A:return_delay=250:moving_speed=300:lower_slope=64"],
]


def test_the_tutorial_says_of_a_replaced_servo_what_the_commands_say(bus: Serve) -> None:
    text = TUTORIAL.read_text(encoding="utf-8").split("## When a servo or a horn was replaced")[1]
    lines = [
        line.removeprefix("adaptive-contact: ").removeprefix("  - ")
        for line in text.split("\n## ")[0].splitlines()
        if line.startswith(("adaptive-contact: port", "adaptive-contact: CW", "  - port"))
        or (line.startswith("adaptive-contact: ") and " servo 9 " in line)
    ]
    assert len(lines) == 8
    names = ("lf", "lm", "lr", "rf", "rm", "rr")
    said = []
    for i, new in enumerate(REPLACED):
        device, _ = bus("1-8:AX-12A", "10-18:AX-12A", *new, where=f"bus{i}")
        legs = [
            f'[[leg]]\nid = "{name}"\njoints = ["coxa", "femur", "tibia"]\n'
            f"servos = {{ ids = [{3 * j + 1}, {3 * j + 2}, {3 * j + 3}] }}\n"
            for j, name in enumerate(names)
        ]
        described = parse_robot(
            '[robot]\nname = "t"\nperiod_s = 0.02\nquantum_rad = 0.005\n'
            f'[port.main]\ndevice = "{device}"\n' + "".join(legs),
            source="t",
        )
        described = msgspec.structs.replace(
            described, ports={"main": Port(device=str(device), timeout_ms=20)}
        )
        findings = check_ports(plan_ports(described), full=False)
        found = findings.errors + findings.advice
        if not findings.errors:
            found += compare(read_servos(plan_ports(described)))
        said += [line.replace(str(device), "/home/you/bus/port0") for line in found]
    for line in lines:
        assert line in said, said
