"""Feetech's servos over their own SDK: registers, observing, driving, what goes wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest
import scservo_sdk as sdk
from described import SCS, STS, Serve, init, robot

from adaptive_contact.bridge import discovery
from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.errors import ConfigurationError, MissingExtraError
from adaptive_contact.robot import Port, ServoLaw


@pytest.mark.parametrize(
    ("kind", "end", "number", "raw"),
    # Half a rad below the centre; beyond zero in multi-turn mode, sign and magnitude.
    [("STS3215", 0, 777, 2048 - 326), ("SCS0009", 1, 1284, 512 - 98),
     ("STS3215:lower_limit=0:upper_limit=0:homing_offset=2000", 0, 777, 278 | 0x8000)],
)  # fmt: skip
def test_the_sdk_reads_what_the_servo_means(
    bus: Serve, kind: str, end: int, number: int, raw: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scservo_sdk.port_handler.LATENCY_TIMER", 200)  # on a busy computer
    device, _ = bus(f"1-3:{kind}:at=-0.5")
    packets, port = sdk.PacketHandler(end), sdk.PortHandler(str(device))
    assert port.setBaudRate(1_000_000)
    try:
        assert packets.ping(port, 2)[:2] == (number, sdk.COMM_SUCCESS)
        assert packets.read2ByteTxRx(port, 2, 56) == (raw, sdk.COMM_SUCCESS, 0)
        group = sdk.GroupSyncRead(port, packets, 56, 4)
        assert all(group.addParam(servo) for servo in (1, 2, 3))
        result = group.txRxPacket()
        if end:  # the SCS series knows no sync read
            assert result == sdk.COMM_RX_TIMEOUT
        else:
            assert result == sdk.COMM_SUCCESS
            assert [group.getData(servo, 56, 2) for servo in (1, 2, 3)] == [raw] * 3
    finally:
        port.closePort()


@pytest.mark.parametrize(("kind", "questions"), [(STS, 1), (SCS, 6)])
def test_the_sts_series_is_asked_in_common(rig: Callable, kind: dict, questions: int) -> None:
    r = rig(**kind, timeout_ms=100)
    plan = r.plans[0]
    bus = Bus(plan.name, plan.port)
    bus.open()
    readings = bus.read([joint.servo for joint in plan.joints], plan.joints[0].model.watched)
    bus.close()
    assert [reading.fault for reading in readings.values()] == [None] * 6
    assert r.port.requests == questions


@pytest.mark.parametrize("kind", [STS, SCS])
def test_a_moving_robot_is_let_through(rig: Callable, kind: dict) -> None:
    """What is read twice alike must not hold what changes with every reading."""
    r = rig(noise_steps=20.0, **kind)
    assert check_ports(r.plans, full=False).errors == []


def test_servos_of_the_other_byte_order_are_named(bus: Serve) -> None:
    device, _ = bus("1-2:STS3215", "3:SCS0009")
    mixed = robot(device, ((1, 2, 3), "STS3215"), protocol="sts")
    (line,) = check_ports(plan_ports(mixed), full=False).errors
    assert "servo 3 (l0 j2) is model number 1029, expected STS3215" in line
    with pytest.raises(ConfigurationError, match=r"uses protocol scs, .* set protocol = 'scs'"):
        plan_ports(robot(device, ((1, 2, 3), "SCS0009"), protocol="sts"))


@pytest.mark.parametrize(("model", "protocol"), [("STS3215", "sts"), ("SCS0009", "scs")])
@pytest.mark.parametrize("dynamixel", [True, False])
def test_init_finds_the_series(
    bus: Serve, model: str, protocol: str, dynamixel: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    device, servos = bus(f"1-3:{model}:position_p=16")
    if not dynamixel:
        monkeypatch.setattr(discovery, "find_spec", "scservo_sdk".__eq__)
    said, found = init(device)
    assert f"3 x {model}, ids 1-3; 1000000 baud, protocol {protocol}" in said
    assert found.ports["main"].protocol == protocol
    assert found.servo.slope_rad == pytest.approx(
        0.377 if protocol == "sts" else ServoLaw().slope_rad, abs=1e-3
    )
    assert check_ports(plan_ports(found), full=False, drive=True).errors == []
    assert all(servo.writes == 0 for servo in servos)


@pytest.mark.parametrize(("present", "why"), [(False, "is not installed"), (True, "cannot be")])
def test_a_missing_sdk_is_told_with_its_extra(
    present: bool, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # None: not to be found; a module without its handler: Feetech's own package of the name.
    monkeypatch.setitem(sys.modules, "scservo_sdk", type(sys)("scservo_sdk") if present else None)
    with pytest.raises(MissingExtraError, match=rf"{why}.*\[feetech\]") as caught:
        Bus("p", Port(device="/dev/null", protocol="sts"))
    assert caught.value.extra == "feetech"
