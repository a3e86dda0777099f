"""What a handshake finds on buses as they are, and what it puts right with ``--configure``."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from anybus import any_servo
from described import AX, SCS, STS, Serve, robot, write

from adaptive_contact.bridge.discovery import find_servos
from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.errors import BusError, ConfigurationError
from adaptive_contact.robot import parse_robot
from adaptive_contact_sim.virtual import VirtualServo

XL = {"model": "XL-330", "protocol": 2}


@pytest.mark.parametrize("kind", [AX, XL])
def test_two_of_one_id_that_answer_at_the_same_moment(
    rig: Callable, kind: dict, tmp_path: Path
) -> None:
    """Alike to the last bit in what a ping and the model number tell; not in what they measure."""
    r = rig(**kind)
    port, one = r.port, r.servo(1)
    r.backend.place(4, 0.7)
    port.servos = (
        *port.servos,
        VirtualServo(1, one.model, r.backend, 4, np.random.default_rng(1), noise_steps=0.0),
    )
    findings = check_ports(r.plans)
    assert any("several servos answer to id 1" in line for line in findings.errors)
    with pytest.raises(BusError, match="several servos answer to id 1"):
        find_servos("p0", str(tmp_path / "p0"))


def test_a_disturbed_line_makes_no_doubles(rig: Callable) -> None:
    r = rig(**AX)
    r.fault("flip:p=0.05")
    assert check_ports(r.plans, full=False).errors == []


@pytest.mark.parametrize(
    ("kind", "bits", "words"),
    [
        (AX, 0x20, "write 1023 to its torque limit (34)"),
        (XL, 0x20, "reboot it"),
        ({"model": "XL-320", "protocol": 2}, 0x01, "write 1023 to its torque limit (35)"),
        ({"model": "STS3215", "protocol": "sts"}, 0x20, "write 0 to its torque enable (40)"),
    ],
)
def test_a_servo_that_has_shut_itself_down(
    rig: Callable, kind: dict, bits: int, words: str
) -> None:
    r = rig(**kind)
    r.servo(2).set_errors(bits)
    findings = check_ports(r.plans, full=False)
    assert findings.errors == []
    # A computer that is too busy advises of late answers, too.
    [line] = [line for line in findings.advice if "come too late" not in line]
    assert "servo 2: shut down" in line
    assert "power off and on" in line
    assert words in line


@pytest.mark.parametrize("kind", [AX, XL, STS, SCS])
def test_nothing_is_written_unless_asked_for(rig: Callable, kind: dict) -> None:
    r = rig(**kind)
    servos = r.port.servos
    for servo in servos:
        servo.store("return_delay", 250)
    findings = check_ports(r.plans, full=False)
    assert "return delay of servo 1, 2, 3, 4, 5, 6 is 500 us" in findings.advice[0]
    assert "--configure" in findings.advice[0]
    assert [servo.writes for servo in servos] == [0] * 6
    assert len(check_ports(r.plans, full=False, configure=True).advice) == 6
    for servo in servos:
        assert kind in (AX, XL) or servo.value("eeprom_lock") == 1
        servo.reboot()  # what is written while an EEPROM is locked would be gone
    assert [servo.value("return_delay") for servo in servos] == [0] * 6


def test_a_driving_x_servo_is_not_let_go(rig: Callable) -> None:
    r = rig(**XL)
    r.servo(1).store("return_delay", 250)
    r.servo(1).store("torque_enable", 1)
    findings = check_ports(r.plans, full=False, configure=True)
    assert "that drives: switch its torque off" in findings.advice[0]
    assert r.servo(1).torque


BASE = """
[robot]
name = "r"
period_s = 0.02
quantum_rad = 0.005
[port.a]
device = "/dev/ttyA"
[[leg]]
id = "l"
joints = ["x", "y"]
servos = { ids = [1, 2] }
"""


LEG = BASE[BASE.index("[[leg]]") :]


def planned(text: str):
    return plan_ports(parse_robot(text, source="r.toml"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ids = [1, 2]", "ids = [1, 1]", "servo id 1 is used twice"),
        ("ids = [1, 2]", "ids = [1, 300]", "is 300; expected at most 252"),
        ("ids = [1, 2]", 'ids = [1, 2], model = "AX-21A"', "did you mean 'AX-1"),
        ("ids = [1, 2]", 'ids = [1, 2], model = "XL-330"', "uses protocol 2"),
        ("ids = [1, 2]", 'ids = [1, 2], port = "b"', "no such \\[port.NAME\\] \\(a\\)"),
        ("ids = [1, 2]", "ids = [1, 2], max_step_rad = 9", "max_step_rad is 9"),
        ('"/dev/ttyA"', '"/dev/ttyA"\nbaud = 12', "baud is 12; expected at least 1200"),
        ('"/dev/ttyA"', '"/dev/ttyA"\nfast = true', "fast is for protocol 2"),
        (
            "servos =",
            "limits = { lower_rad = [6, -1], upper_rad = [6.2, 1] }\nservos =",
            "'x' cannot move: .* do not meet",
        ),
        ("servos =", "#", "has no servos"),
        (
            LEG,
            LEG + LEG.replace('"l"', '"m"').replace("[1, 2]", '[2, 3], port = "a"'),
            r"servo id 2 is used twice on a port \(by leg",
        ),
    ],
)  # fmt: skip
def test_bad_descriptions_are_told_in_one_line(old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        planned(BASE.replace(old, new))


def test_two_ports_on_one_device(tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to("/dev/ttyA")
    text = BASE.replace("ids = [1, 2]", 'ids = [1, 2], port = "a"') + (
        f'[port.b]\ndevice = "{tmp_path / "by-id"}"\n'
    )
    with pytest.raises(ConfigurationError, match=r"\[port.b\] and \[port.a\] are one device"):
        planned(text)


def test_a_device_from_the_command_line() -> None:
    robot = parse_robot(BASE, source="r.toml")
    [plan] = plan_ports(robot, {"a": "/dev/other"})
    assert plan.port.device == "/dev/other"
    bare = msgspec.structs.replace(robot, ports={})
    with pytest.raises(ConfigurationError, match="has no port; add"):
        plan_ports(bare)
    assert plan_ports(bare, {"main": "/dev/x"})[0].name == "main"
    with pytest.raises(ConfigurationError, match="no port 'b'"):
        plan_ports(robot, {"b": "/dev/x"})


@pytest.mark.parametrize("direction", [1, -1])
def test_angles_and_steps_agree(direction: int) -> None:
    text = BASE.replace(
        "ids = [1, 2]", f"ids = [1, 2], directions = [{direction}, 1], offsets_rad = [0.3, 0]"
    )
    joint = planned(text)[0].joints[0]
    assert joint.angle(joint.model.centre) == pytest.approx(0.3)
    assert (joint.angle(600) - 0.3) * direction > 0
    for steps in range(0, 1024, 7):
        assert joint.steps(joint.angle(steps)) == steps
    # No clamp hides a wish that cannot be met: what writes a goal limits it.
    assert abs(joint.steps(99.0)) > joint.model.highest


# -- What a handshake finds on buses as they are, and what it puts right with ``--configure``


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
    r.port.servos += (any_servo(20, "AX-12A", r.backend, 0),)
    r.fault("late:id=20,ms=60")
    [line] = check_ports(r.plans).errors
    assert "unexpected servo 20 (AX-12A)" in line


def test_all_servos_at_another_rate_and_protocol(bus: Serve) -> None:
    device, _ = bus("1-3:XL430-W250:baud=57600")
    described = robot(device, ((1, 2, 3), "AX-12A"), timeout_ms=20)
    [line] = check_ports(plan_ports(described), full=False).errors
    assert "servo 1, 2, 3 answer at 57600 baud, protocol 2, not at 1000000 baud" in line
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
    assert findings.advice == ["port main: servo 3: status return set to 2"]
    assert [servo.value("status_return") for servo in servos] == [2, 2, 2]
    assert [servo.writes for servo in servos[:2]] == [0, 0]


def test_a_locked_register_is_told(bus: Serve) -> None:
    device, servos = bus("1:XL-320:status_return=0:torque_enable=1")
    described = robot(device, ((1,), "XL-320"), protocol=2)
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert "switch its torque off (the leg will go limp)" in findings.advice[0]
    assert servos[0].value("status_return") == 0


def test_a_servo_that_confirms_no_writes_is_configured(bus: Serve) -> None:
    """At a status return level of 1 what was written is read back."""
    device, servos = bus("1-3:AX-12A:status_return=1:return_delay=250")
    described = robot(device, ((1, 2, 3), "AX-12A"))
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert findings.errors == []
    assert len(findings.advice) == 3
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
    one, two, three = [line for line in findings.advice if "return delay" in line]
    assert one == "port main: servo 1: return delay set to 0"
    assert "servo 2: did not take a return delay of 0; its EEPROM may be locked" in two
    assert "servo 3: return delay set to 0" in three
    servos[1].write = write  # type: ignore[method-assign]
    again = check_ports(plans, full=False, configure=True)
    assert "port main: servo 2: return delay set to 0" in again.advice


def test_several_things_that_are_wrong_are_a_line_each(bus: Serve, start: Callable) -> None:
    device, _ = bus("1-2:AX-12A", "1:AX-12A:at=0.4", "252:AX-12A")
    path = write(device.parent / "robot.toml", robot(device, ((1, 2, 3), "AX-12A"), timeout_ms=10))
    check = start("robot", "check", "--config", str(path))
    assert check.wait(600) == 2
    first, *others = check.lines
    assert first == "adaptive-contact: 3 things stand in the way of the bridge:"
    assert [line[:4] for line in others] == ["  - "] * 3
    assert "missing servo 3 (l0 j2)" in others[0]


@pytest.mark.parametrize(
    ("model", "port", "message"),
    [
        ("AX-12A", {"ignore": [253]}, "port.ignore[0] is 253; expected at most 252"),
        ("AX-12A", {"ignore": [2]}, "servo id 2 is in ignore of [port.main], too"),
        ("AX-12A", {"ignore": ["x"]}, "ignore"),
        ("AX-12A", {"ignroe": [2]}, "did you mean"),
        *((model, {}, "model") for model in (7, ["AX-12A", 7, "AX-12A"], [], True)),
        ("XL-320", {"protocol": 2, "fast": True}, "XL-320 knows no fast sync read"),
    ],
)
def test_settings_that_cannot_be(model: object, port: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(message)):
        plan_ports(robot(Path("/dev/x"), ((1, 2, 3), model), **port))


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
