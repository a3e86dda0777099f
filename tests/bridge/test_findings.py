"""What a handshake finds on buses as they are, and what it puts right with ``--configure``."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from anybus import any_servo
from described import Serve, robot, write

from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.errors import ConfigurationError
from waiting import until


def test_a_head_is_ignored_where_the_port_says_so(bus: Serve) -> None:
    device, servos = bus("1-3:AX-12A", "20-21:AX-12A")
    legs = ((1, 2, 3), "AX-12A")
    [one, other] = check_ports(plan_ports(robot(device, legs, timeout_ms=10))).errors
    assert "unexpected servo 20 (AX-12A); add it to a leg" in one
    assert "unexpected servo 21" in other
    assert "ignore = [20, 21] in [port.main]" in one
    aside = robot(device, legs, timeout_ms=10, ignore=[20, 21])
    assert check_ports(plan_ports(aside)).errors == []
    assert all(servo.writes == 0 for servo in servos)


def test_an_unexpected_servo_whose_answer_comes_late_is_told(rig: Any) -> None:
    r = rig(model="AX-12A", protocol=1, legs=1)
    r.ports[0].servos += (any_servo(20, "AX-12A", r.backend, 0),)
    r.fault("late:id=20,ms=60")
    [line] = check_ports(r.plans).errors
    assert "unexpected servo 20 (AX-12A)" in line


def test_all_servos_at_another_rate_and_protocol(bus: Serve) -> None:
    device, _ = bus("1-3:XL430-W250:baud=57600")
    described = robot(device, ((1, 2, 3), "AX-12A"), timeout_ms=20)
    [line] = check_ports(plan_ports(described), full=False).errors
    assert "no servo answers at 1000000 baud, protocol 1" in line
    assert "set baud = 57600 and protocol = 2 in [port.main]" in line


@pytest.mark.parametrize("model", ["AX-12A", "XL-320", "XL430-W250"])
def test_a_servo_that_answers_pings_only_is_told_and_put_right(bus: Serve, model: str) -> None:
    device, servos = bus(f"1-2:{model}", f"3:{model}:status_return=0")
    described = robot(device, ((1, 2, 3), model), protocol=servos[0].model.protocol)
    [line] = check_ports(plan_ports(described), full=False).errors
    assert "servo 3 answers to pings but not to reads" in line
    assert "--configure" in line
    assert servos[2].value("status_return") == 0
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert findings.errors == []
    assert findings.done == ["port main: servo 3: status return level set to 2"]
    assert [servo.value("status_return") for servo in servos] == [2, 2, 2]
    assert [servo.writes for servo in servos[:2]] == [0, 0]


def test_a_locked_register_is_told(bus: Serve) -> None:
    device, servos = bus("1:XL-320:status_return=0:torque_enable=1")
    described = robot(device, ((1,), "XL-320"), protocol=2)
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert "switch its torque off first" in findings.advice[0]
    assert servos[0].value("status_return") == 0


def test_a_servo_that_confirms_no_writes_is_configured(bus: Serve) -> None:
    """At a status return level of 1 what was written is read back."""
    device, servos = bus("1-3:AX-12A:status_return=1:return_delay=250")
    described = robot(device, ((1, 2, 3), "AX-12A"))
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert len(findings.done) == 3
    assert findings.errors == findings.advice == []
    assert [servo.value("return_delay") for servo in servos] == [0, 0, 0]
    assert all(servo.answers == 1 for servo in servos)


@pytest.mark.parametrize("model", ["AX-12A", "XL430-W250"])
def test_a_write_counts_that_is_in_the_register(bus: Serve, model: str) -> None:
    """Not one that is confirmed: a locked EEPROM may do that, and one with an alarm does less."""
    device, servos = bus(f"1-3:{model}:return_delay=250")
    write = servos[1].write

    def locked(address: int, data: bytes) -> object:
        return None if address < 24 else write(address, data)

    servos[1].write = locked  # type: ignore[method-assign,assignment]
    servos[2].store("shutdown", 0)
    execute = servos[2].set_errors
    servos[2].set_errors = lambda bits: execute(0x01)  # type: ignore[method-assign]
    described = robot(device, ((1, 2, 3), model), protocol=servos[0].model.protocol)
    plans = plan_ports(described)
    findings = check_ports(plans, full=False, configure=True)
    assert findings.errors == []
    assert [line.split(":")[1] for line in findings.done] == [" servo 1", " servo 3"]
    assert [line for line in findings.advice if "return delay" in line] == [
        "port main: servo 2 did not take a return delay of 0; its EEPROM may be locked: switch its "
        "power off and on, then run with --configure again"
    ]
    servos[1].write = write  # type: ignore[method-assign]
    again = check_ports(plans, full=False, configure=True)
    assert again.done == ["port main: servo 2: return delay set to 0"]


def test_a_configuration_that_is_interrupted_goes_on_where_it_ended(rig: Any) -> None:
    r = rig(model="AX-12A", protocol=1)
    servos = r.ports[0].servos
    for servo in servos:
        servo.store("return_delay", 250)
    write = servos[3].write

    def pulled(address: int, data: bytes) -> object:
        r.fault("hangup:@0+1000000")
        return write(address, data)

    servos[3].write = pulled
    [line] = check_ports(r.plans, full=False, configure=True).errors
    assert "is gone" in line
    servos[3].write = write
    r.fault()
    path = Path(r.plans[0].port.device)
    until(lambda: path.exists())
    findings = check_ports(r.plans, full=False, configure=True)
    assert findings.errors == findings.advice == []
    assert [servo.value("return_delay") for servo in servos] == [0] * 6
    assert len(findings.done) in (2, 3)  # whether the fourth took it before


def test_several_things_that_are_wrong_are_a_line_each(bus: Serve) -> None:
    device, _ = bus("1-2:AX-12A", "1:AX-12A:at=0.4", "252:AX-12A")
    path = write(device.parent / "robot.toml", robot(device, ((1, 2, 3), "AX-12A"), timeout_ms=10))
    words = [sys.executable, "-m", "adaptive_contact", "robot", "check", "--config", str(path)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 2
    first, *others = ended.stderr.splitlines()
    assert first == "adaptive-contact: 3 things stand in the way of the bridge:"
    assert [line[:4] for line in others] == ["  - "] * 3
    assert "missing servo 3 (l0 j2)" in others[0]


@pytest.mark.parametrize(
    ("port", "message"),
    [
        ({"ignore": [253]}, "[port.main] ignore has 253; ids are 0 to 252"),
        ({"ignore": [2]}, "servo id 2 is in ignore of [port.main], too"),
        ({"ignore": ["x"]}, "ignore"),
        ({"ignroe": [2]}, "did you mean"),
    ],
)
def test_an_ignore_that_cannot_be(port: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        robot(Path("/dev/x"), ((1, 2, 3), "AX-12A"), **port)


@pytest.mark.parametrize("model", [7, ["AX-12A", 7, "AX-12A"], [], True])
def test_a_model_that_is_no_name(model: object) -> None:
    with pytest.raises(ConfigurationError, match="model"):
        robot(Path("/dev/x"), ((1, 2, 3), model))


def test_fast_sync_read_is_not_for_an_xl320() -> None:
    with pytest.raises(ConfigurationError, match="XL-320 knows no fast sync read"):
        plan_ports(robot(Path("/dev/x"), ((1,), "XL-320"), protocol=2, fast=True))


@pytest.mark.parametrize(
    ("protocol", "models"),
    [(1, ["AX-12A", "MX-28", "MX-106"]), (2, ["XL-320", "XL430-W250", "MX-28(2.0)"])],
)
def test_a_leg_of_different_control_tables_is_read_and_driven(
    run: Callable, protocol: int, models: list[str]
) -> None:
    """Each servo's own registers, in one tick: positions, goals and torque."""
    r = run("drive", model=models, protocol=protocol, legs=1)
    for index, angle in enumerate((0.3, -0.2, 0.1)):
        r.rig.backend.place(index, angle)
    feed = r.commanding([0.5, -0.4, 0.2])
    r.catcher.wait(
        feed(
            lambda c: (
                c.ticks
                and c.ticks[-1]["l0"].measured == pytest.approx([0.5, -0.4, 0.2], abs=0.006)
                and c.ticks[-1]["l0"].desired == pytest.approx([0.5, -0.4, 0.2], abs=0.006)
            )
        )
    )
    assert all(r.rig.servo(servo).torque for servo in (1, 2, 3))
