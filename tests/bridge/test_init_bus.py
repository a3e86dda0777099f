"""``robot init`` on buses as they are: a head, mixed models, servos that are mute or astray."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import pytest
from described import Serve, init, robot

from adaptive_contact.bridge import handshake
from adaptive_contact.bridge.bus import Bus, Pong
from adaptive_contact.bridge.discovery import find_servos, wanted_legs
from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.errors import BusError, ConfigurationError
from adaptive_contact.robot import load_robot
from programs import invoke, tried


def test_legs_of_any_ids_and_the_rest_ignored(bus: Serve) -> None:
    device, _ = bus("1-12:AX-12A", "13:MX-28", "14:AX-12A:number=999")
    said, found = init(device, "--ids", "2,4,6/8,10,12", "--legs", "right,left")
    assert "servo 1, 3, 5, 7, 9, 11, 13, 14 is no leg's: ignored" in said
    assert [leg.servos.ids for leg in found.legs] == [(2, 4, 6), (8, 10, 12)]
    assert found.leg_ids == ("right", "left")
    assert found.ports["main"].ignore == (1, 3, 5, 7, 9, 11, 13, 14)
    assert check_ports(plan_ports(found), full=False).errors == []


def test_a_servo_that_follows_another_is_named_and_no_joint(bus: Serve) -> None:
    device, servos = bus("1-4:XL430-W250")
    servos[3].store("secondary_id", 2)
    said, found = init(device)
    assert "servo 4 follows servo 2 by its secondary id" in said
    assert [leg.servos.ids for leg in found.legs] == [(1, 2, 3)]
    assert found.ports["main"].ignore == (4,)
    told = msgspec.structs.replace(found.ports["main"], ignore=())
    (line,) = check_ports(plan_ports(msgspec.structs.replace(found, ports={"main": told}))).errors
    assert "unexpected servo 4 (XL430-W250), which follows servo 2 by its secondary id; " in line
    servos[2].store("secondary_id", 2)  # of a joint
    (line,) = check_ports(plan_ports(found), full=False).advice
    assert "servo 3 has secondary id 2, expected 255 (none): it would follow" in line


def test_legs_of_several_sizes(bus: Serve) -> None:
    device, _ = bus("1-5:AX-12A")
    said, found = init(device, "--ids", "5,4/3,2,1")
    assert "2 legs of 2 and 3 joints" in said
    assert [leg.joints for leg in found.legs] == [("hip", "knee"), ("coxa", "femur", "tibia")]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--ids", "1,2,x"), "'1,2,x' is no list of ids"),
        (("--ids", "1,2,3/"), "'' is no list of ids"),
        (("--ids", "1,2/3,2"), "servo id 2 is used twice"),
        (("--ids", "1,2/3", "--joints", "hip,knee"), "servos.ids has 1 values for 2 joints"),
        (("--lengths", "52,66,138"), "lengths_m[0] is 52.0; expected at most 5 m"),
        (("--lengths", "0.1,0.1"), "lengths_m has 2 values for 3 joints"),
        (("--ids", "head:1,2,3"), "--ids names port 'head'; --device gives main"),
        (("--ids", "1,2,3", "--legs", "a,b"), "2 legs are named, but the servos make 1"),
        (("--ids", "1,2,9"), "port main has no servo 9 (ids there are 1-3)"),
    ],
)
def test_ids_that_cannot_be(bus: Serve, words: tuple[str, ...], message: str) -> None:
    device, _ = bus("1-3:AX-12A")
    with pytest.raises((BusError, ConfigurationError), match=re.escape(message)) as caught:
        init(device, *words)
    assert "\n" not in str(caught.value)
    assert not (device.parent / "robot.toml").exists()


def test_servos_of_another_protocol_make_no_robot(bus: Serve) -> None:
    """An X servo whose Protocol Type is 1 answers, and no bridge would read it."""
    device, _ = bus("1-3:AX-12A", "4-6:XM430-W350")
    with pytest.raises(BusError, match=r"servo 4 \(XM430-W350\), 5 .* answers in protocol 1, and"):
        init(device)
    assert not (device.parent / "robot.toml").exists()
    assert init(device, "--ids", "1,2,3")[1].ports["main"].ignore == (4, 5, 6)


@pytest.mark.slow
def test_ids_that_two_ports_have(bus: Serve) -> None:
    left, _ = bus("1-3:AX-12A", where="left")
    right, _ = bus("1-3:AX-12A", where="right")
    devices = ("--device", f"left={left}", "--device", f"right={right}")
    out = left.parent / "robot.toml"
    with pytest.raises(BusError, match="ports left, right all have these servos; name the port"):
        invoke("robot", "init", *devices, "--out", out, "--ids", "1,2,3")
    invoke("robot", "init", *devices, "--out", out, "--ids", "right:1,2,3/left:3,2,1")
    legs = load_robot(out).legs
    assert [(leg.servos.port, leg.servos.ids) for leg in legs] == [
        ("right", (1, 2, 3)), ("left", (3, 2, 1)),
    ]  # fmt: skip
    assert [leg.port for leg in wanted_legs("1/b:2")] == [None, "b"]


def test_an_ax18_in_a_leg_of_ax12(bus: Serve) -> None:
    device, _ = bus("1-2:AX-12A", "3:AX-18A")
    said, found = init(device)
    assert "2 x AX-12A, ids 1-2; 1 x AX-18A, ids 3" in said
    assert found.legs[0].servos.models == ("AX-12A", "AX-12A", "AX-18A")
    right = robot(device, ((1, 2, 3), ["AX-12A", "AX-12A", "AX-18A"]))
    assert check_ports(plan_ports(right), full=False).errors == []
    wrong = robot(device, ((1, 2, 3), ["AX-12A", "AX-18A", "AX-18A"]))
    [line] = check_ports(plan_ports(wrong), full=False).errors
    assert "servo 2 (l0 j1) is AX-12A, expected AX-18A" in line
    with pytest.raises(ConfigurationError, match=r"servos\.model has 2 values for 3 joints"):
        robot(device, ((1, 2, 3), ["AX-12A", "AX-18A"]))


def test_a_servo_at_another_rate_is_looked_for_and_told(bus: Serve) -> None:
    device, servos = bus("1-5:AX-12A", "6:AX-12A:baud=57600")
    out = device.parent / "robot.toml"
    for words, why in [
        ((), "5 servos do not make legs"),
        (("--ids", "1,2,3/4,5,6"), "port main has no servo 6"),
    ]:
        ended = tried("robot", "init", "--device", device, "--out", out, *words)
        assert why in str(ended.exception)
        assert "servo 6 answers at 57600 baud, protocol 1" in ended.output
    described = robot(device, ((1, 2, 3), "AX-12A"), ((4, 5, 6), "AX-12A"), timeout_ms=20)
    [line] = check_ports(plan_ports(described), full=False).errors
    assert "servo 6 answers at 57600 baud, protocol 1, not at 1000000 baud, protocol 1" in line
    assert "set its baud rate with DYNAMIXEL Wizard" in line
    assert "missing" not in line
    assert all(servo.writes == 0 for servo in servos)


@pytest.mark.parametrize("late", [(4, 5, 6), (1, 2, 3, 4, 5, 6)])
def test_servos_whose_answers_come_late_are_found(
    rig: Callable, tmp_path: Path, late: tuple[int, ...]
) -> None:
    """As on a busy computer: later than the first look waits, and more than it looks beyond."""
    r = rig(model="AX-12A", protocol=1)
    r.fault(*(f"late:id={servo},ms=20" for servo in late))
    found = find_servos("p0", str(tmp_path / "p0"), (57_600, 1_000_000))
    assert sorted(found.servos) == [1, 2, 3, 4, 5, 6]
    assert (found.port.baud, found.port.protocol) == (1_000_000, 1)


def test_a_servo_that_is_never_heard_in_time_is_told_and_not_left_out(
    rig: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    patient = handshake.scan_again

    def in_vain(bus: Bus, found: dict[int, Pong], ids: Iterable[int]) -> dict[int, Pong]:
        again = patient(bus, found, [servo for servo in ids if servo != 6])
        return {servo: pong for servo, pong in again.items() if servo != 6}

    monkeypatch.setattr(handshake, "scan_again", in_vain)
    # The look at all ids goes on for much longer than servo 6 is late.
    monkeypatch.setattr(handshake, "ALL_IDS", range(61))
    r = rig(model="AX-12A", protocol=1)
    r.fault("late:id=6,ms=200")
    where = str(tmp_path / "p0")
    with pytest.raises(BusError, match="answers of servo 6 come too late: this computer is too"):
        find_servos("p0", where, (1_000_000,))
    found = find_servos("p0", where, (1_000_000,), ids=(1, 2, 3, 4, 5))
    assert 6 not in found.servos  # it is no leg's


def test_the_rate_of_most_servos_is_the_ports(bus: Serve) -> None:
    """A new servo at its own rate is the odd one, though it is heard first."""
    device, _ = bus("1:AX-12A:at=0.2", "2-4:AX-12A:baud=115200")
    out = device.parent / "robot.toml"
    said = tried("robot", "init", "--device", device, "--out", out, "--force").output
    assert "ids 2-4; 115200 baud, protocol 1" in said
    assert "servo 1 answers at 1000000 baud, protocol 1" in said
    assert load_robot(out).ports["main"].baud == 115200
    found = find_servos("main", str(device), (1_000_000,))
    assert sorted(found.servos) == [1]


def test_init_lets_a_mute_servo_answer(bus: Serve) -> None:
    device, servos = bus("1-2:AX-12A", "3:AX-12A:status_return=0")
    said, found = init(device, "--configure")
    assert "port main: servo 3: status return set to 2" in said
    assert found.legs[0].servos.ids == (1, 2, 3)
    assert servos[2].answers == 2


@pytest.mark.slow
def test_init_leaves_a_mute_head_alone(bus: Serve) -> None:
    device, servos = bus("1-2:AX-12A", "3,20:AX-12A:status_return=0")
    _, found = init(device, "--configure", "--ids", "1,2,3")
    assert [servo.answers for servo in servos] == [2, 2, 2, 0]
    assert found.ports["main"].ignore == (20,)


def test_the_other_firmware_of_an_mx(bus: Serve) -> None:
    device, _ = bus("1-3:MX-28(2.0)")
    with pytest.raises(ConfigurationError, match=r'or model = "MX-28\(2\.0\)" if it has that'):
        plan_ports(robot(device, ((1,), "MX-28"), protocol=2))
    said, found = init(device)
    assert "3 x MX-28(2.0), ids 1-3" in said
    assert found.legs[0].servos.model == "MX-28(2.0)"
    described = robot(device, ((1, 2, 3), "MX-28(2.0)"), protocol=2)
    assert check_ports(plan_ports(described), full=False, drive=True).errors == []


def test_feetech_servos_among_dynamixel_servos(bus: Serve) -> None:
    """Those of which there are more are the port's."""
    device, servos = bus("1-3:AX-12A", "4:STS3215")
    with pytest.raises(BusError, match=r"servo 4 \(model number \d+\) is of no known model"):
        init(device)
    assert all(servo.writes == 0 for servo in servos)


def test_two_names_of_one_port(bus: Serve) -> None:
    device, _ = bus("1-3:AX-12A")
    (device.parent / "link").symlink_to(device.name)
    with pytest.raises(ConfigurationError, match=r"\[port.q\] and \[port.main\] are one device"):
        init(device, "--device", f"q={device.parent / 'link'}")
