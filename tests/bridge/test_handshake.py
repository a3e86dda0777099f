from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from adaptive_contact.bridge.discovery import find_servos
from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.errors import BusError, ConfigurationError
from adaptive_contact.robot import parse_robot
from adaptive_contact_sim.virtual import VirtualServo

AX = {"model": "AX-12A", "protocol": 1}
XL = {"model": "XL-330", "protocol": 2}


@pytest.mark.parametrize("kind", [AX, XL])
def test_two_of_one_id_that_answer_at_the_same_moment(
    rig: Callable, kind: dict, tmp_path: Path
) -> None:
    """Alike to the last bit in what a ping and the model number tell; not in what they measure."""
    r = rig(**kind)
    port, one = r.ports[0], r.servo(1)
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


@pytest.mark.parametrize("kind", [AX, XL])
def test_nothing_is_written_unless_asked_for(rig: Callable, kind: dict) -> None:
    r = rig(**kind)
    servos = r.ports[0].servos
    for servo in servos:
        servo.store("return_delay", 250)
    findings = check_ports(r.plans, full=False)
    assert "return delay of servo 1, 2, 3, 4, 5, 6 is 500 us" in findings.advice[0]
    assert "--configure" in findings.advice[0]
    assert [servo.writes for servo in servos] == [0] * 6
    assert len(check_ports(r.plans, full=False, configure=True).done) == 6
    assert [servo.value("return_delay") for servo in servos] == [0] * 6


def test_a_driving_x_servo_is_not_let_go(rig: Callable) -> None:
    r = rig(**XL)
    r.servo(1).store("return_delay", 250)
    r.servo(1).store("torque_enable", 1)
    findings = check_ports(r.plans, full=False, configure=True)
    assert "servo 1 drives" in findings.advice[0]
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


def planned(text: str):
    return plan_ports(parse_robot(text, source="r.toml"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ids = [1, 2]", "ids = [1, 1]", "servo id 1 is used twice"),
        ("ids = [1, 2]", "ids = [1, 300]", "ids are 0 to 252"),
        ("ids = [1, 2]", 'ids = [1, 2], model = "AX-21A"', "did you mean 'AX-1"),
        ("ids = [1, 2]", 'ids = [1, 2], model = "XL-330"', "uses protocol 2"),
        ("ids = [1, 2]", 'ids = [1, 2], port = "b"', "no such \\[port.NAME\\] \\(a\\)"),
        ("ids = [1, 2]", "ids = [1, 2], max_step_rad = 9", "max_step_rad is 9"),
        ('"/dev/ttyA"', '"/dev/ttyA"\nbaud = 250000', "baud 250000 is not supported"),
        ('"/dev/ttyA"', '"/dev/ttyA"\nfast = true', "fast is for protocol 2"),
        (
            "servos =",
            "limits = { lower_rad = [6, -1], upper_rad = [6.2, 1] }\nservos =",
            "'x' cannot move: .* do not meet",
        ),
        ("servos =", "#", "has no servos"),
    ],
)  # fmt: skip
def test_bad_descriptions_are_told_in_one_line(old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        planned(BASE.replace(old, new))


def test_a_servo_of_two_legs_though_one_leaves_the_only_port_out() -> None:
    other = BASE[BASE.index("[[leg]]") :].replace('"l"', '"m"').replace("[1, 2]", "[2, 3]")
    with pytest.raises(ConfigurationError, match=r"servo id 2 is used twice on a port \(by leg"):
        planned(BASE + other.replace("[2, 3]", '[2, 3], port = "a"'))


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
