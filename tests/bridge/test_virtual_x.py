"""The virtual X-series servo, asked by the real DynamixelSDK: indirect addresses, and Clear."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from described import Serve

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.robot import Port


def master(device: Path, protocol: int = 2) -> Any:
    made = Bus("main", Port(device=str(device), protocol=protocol, timeout_ms=200.0))  # type: ignore[arg-type]
    made.open()
    return made


def put(bus: Any, servo: int, address: int, data: bytes) -> int:
    """The error of a write: 0 when it was done."""
    result, error = bus._packets.writeTxRx(bus._port, servo, address, len(data), list(data))
    assert result == 0
    return int(error) & 0x7F


def get(bus: Any, servo: int, address: int, size: int) -> bytes:
    from adaptive_contact.bridge.tables import Block

    data = bus._read_one(servo, Block(address, size)).data
    assert data is not None
    return bytes(data)


@pytest.mark.parametrize(
    ("model", "addresses", "data"),
    [("XM430-W350", 168, 224), ("XM430-W350", 578, 634), ("XL330-M288", 168, 208),
     ("MX-64(2.0)", 168, 224)],
)  # fmt: skip
def test_indirect_addresses_stand_for_registers(
    bus: Serve, model: str, addresses: int, data: int
) -> None:
    device, [servo] = bus(f"1:{model}:at=0.5")
    line = master(device)
    assert get(line, 1, data, 2) == b"\0\0"
    assert put(line, 1, data, b"\x07") == 0  # stands for itself
    assert get(line, 1, data, 1) == b"\x07"
    goal, position = (
        servo.model.registers[n].address for n in ("goal_position", "present_position")
    )
    places = [*range(position, position + 4), *range(goal, goal + 4), 64]
    table = b"".join(at.to_bytes(2, "little") for at in places)
    assert put(line, 1, addresses, table) == 0
    assert get(line, 1, addresses, len(table)) == table
    here = get(line, 1, position, 4)
    assert here != bytes(4)
    assert get(line, 1, data, 4) == here
    assert put(line, 1, data + 8, b"\x01") == 0
    assert servo.torque
    assert put(line, 1, data + 4, (2100).to_bytes(4, "little")) == 0
    assert get(line, 1, goal, 4) == (2100).to_bytes(4, "little")
    assert put(line, 1, data + 4, (5000).to_bytes(4, "little")) == 6  # as the goal's own: a limit
    assert put(line, 1, data, b"\0\0\0\0") == 7  # as the position's own: read only
    assert get(line, 1, goal, 4) == (2100).to_bytes(4, "little")
    line.close()


@pytest.mark.parametrize("place", [0, 36, 63, 662, 65535])
def test_an_indirect_address_that_cannot_be_is_refused(bus: Serve, place: int) -> None:
    device, _ = bus("1:XM430-W350")
    line = master(device)
    assert put(line, 1, 170, place.to_bytes(2, "little")) == 4
    assert get(line, 1, 170, 2) == (225).to_bytes(2, "little")
    line.close()


def test_an_xl330_ends_where_its_indirect_data_do(bus: Serve) -> None:
    device, _ = bus("1:XL330-M288")
    line = master(device)
    assert get(line, 1, 227, 1) == b"\0"
    from adaptive_contact.bridge.tables import Block

    assert line._read_one(1, Block(228, 1)).data is None
    line.close()


def clear(bus: Any, servo: int, *parameters: int) -> int:
    size = len(parameters) + 3
    packet = [0, 0, 0, 0, servo, size & 0xFF, size >> 8, 0x10, *parameters, 0, 0]
    _, result, error = bus._packets.txRxPacket(bus._port, packet)
    assert result == 0
    return int(error) & 0x7F


KEY = (0x01, 0x44, 0x58, 0x4C, 0x22)


def test_clear_takes_whole_turns_away_and_moves_nothing(bus: Serve) -> None:
    device, [servo] = bus("1:XM430-W350:operating_mode=4")
    place = servo._backend
    line = master(device)
    assert put(line, 1, 64, b"\x01") == 0
    far = 2048 + 4096
    assert put(line, 1, 116, far.to_bytes(4, "little")) == 0
    moving = servo.model.registers["moving"].address
    end = time.monotonic() + 60.0
    while get(line, 1, moving, 1) != b"\0":
        assert time.monotonic() < end
    angle = place.angle(0)
    assert clear(line, 1, 0x02, 0x44, 0x58, 0x4C, 0x22) == 4  # reserved
    assert clear(line, 1, *KEY[:3]) == 4
    assert clear(line, 1, *KEY) == 0
    position = servo.model.registers["present_position"].address
    assert 0 <= int.from_bytes(get(line, 1, position, 4), "little") <= 4095
    assert int.from_bytes(get(line, 1, 116, 4), "little") == 2048
    assert put(line, 1, 116, (2048).to_bytes(4, "little")) == 0
    assert place.angle(0) == pytest.approx(angle, abs=2 * servo.model.step_rad)
    line.close()


def test_clear_is_refused_while_a_horn_turns_and_by_an_xl320(bus: Serve) -> None:
    device, [servo, _] = bus("1:XM430-W350", "2:XL-320")
    servo._backend.speed = lambda index: 1.0  # type: ignore[method-assign]
    line = master(device)
    assert clear(line, 1, *KEY) == 1
    assert clear(line, 2, *KEY) == 2
    line.close()
