"""The virtual X-series servo, asked by the real DynamixelSDK: indirect addresses, and Clear."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from described import Serve
from dynamixel_sdk import COMM_SUCCESS, Protocol2PacketHandler
from dynamixel_sdk.port_handler import PortHandler


class Patient(PortHandler):  # type: ignore[misc]
    """The SDK's own port, that waits for longer, as this computer is busy."""

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(1000)


class Master:
    """The SDK as its examples use it: a port and a packet handler."""

    def __init__(self, device: Path) -> None:
        self.port = Patient(str(device))
        self.packets = Protocol2PacketHandler()

    def ask(self, servo: int, code: int, *parameters: int) -> tuple[bytes, int]:
        """Data and error of the answer to an instruction."""
        size = len(parameters) + 3
        packet = [0, 0, 0, 0, servo, size & 0xFF, size >> 8, code, *parameters, 0, 0]
        answer, result, error = self.packets.txRxPacket(self.port, packet)
        assert result == COMM_SUCCESS
        return bytes(answer[9 : 5 + answer[5] + (answer[6] << 8)]), error & 0x7F

    def put(self, servo: int, address: int, data: bytes) -> int:
        """The error of a write: 0 when it was done."""
        return self.ask(servo, 0x03, *address.to_bytes(2, "little"), *data)[1]

    def read(self, servo: int, address: int, size: int) -> tuple[bytes, int]:
        place = (*address.to_bytes(2, "little"), *size.to_bytes(2, "little"))
        return self.ask(servo, 0x02, *place)

    def get(self, servo: int, address: int, size: int) -> bytes:
        data, error = self.read(servo, address, size)
        assert (len(data), error) == (size, 0)
        return data

    def clear(self, servo: int, *parameters: int) -> int:
        return self.ask(servo, 0x10, *parameters)[1]


@contextlib.contextmanager
def master(device: Path) -> Iterator[Master]:
    made = Master(device)
    assert made.port.openPort()
    try:
        yield made
    finally:
        made.port.closePort()


@pytest.mark.parametrize(
    ("model", "addresses", "data"),
    [("XM430-W350", 168, 224), ("XM430-W350", 578, 634), ("XL330-M288", 168, 208),
     ("MX-64(2.0)", 168, 224)],
)  # fmt: skip
def test_indirect_addresses_stand_for_registers(
    bus: Serve, model: str, addresses: int, data: int
) -> None:
    device, [servo] = bus(f"1:{model}:at=0.5")
    with master(device) as line:
        assert line.get(1, data, 2) == b"\0\0"
        assert line.put(1, data, b"\x07") == 0  # stands for itself
        assert line.get(1, data, 1) == b"\x07"
        goal, position = (
            servo.model.registers[n].address for n in ("goal_position", "present_position")
        )
        places = [*range(position, position + 4), *range(goal, goal + 4), 64]
        table = b"".join(at.to_bytes(2, "little") for at in places)
        assert line.put(1, addresses, table) == 0
        assert line.get(1, addresses, len(table)) == table
        here = line.get(1, position, 4)
        assert here != bytes(4)
        assert line.get(1, data, 4) == here
        assert line.put(1, data + 8, b"\x01") == 0
        assert servo.torque
        assert line.put(1, data + 4, (2100).to_bytes(4, "little")) == 0
        assert line.get(1, goal, 4) == (2100).to_bytes(4, "little")
        # As the goal's own, a limit; and as the position's own, read only.
        assert line.put(1, data + 4, (5000).to_bytes(4, "little")) == 6
        assert line.put(1, data, b"\0\0\0\0") == 7
        assert line.get(1, goal, 4) == (2100).to_bytes(4, "little")


@pytest.mark.parametrize("place", [0, 36, 63, 662, 65535])
def test_an_indirect_address_that_cannot_be_is_refused(bus: Serve, place: int) -> None:
    device, _ = bus("1:XM430-W350")
    with master(device) as line:
        assert line.put(1, 170, place.to_bytes(2, "little")) == 4
        assert line.get(1, 170, 2) == (225).to_bytes(2, "little")


def test_an_xl330_ends_where_its_indirect_data_do(bus: Serve) -> None:
    device, _ = bus("1:XL330-M288")
    with master(device) as line:
        assert line.get(1, 227, 1) == b"\0"
        assert line.read(1, 228, 1) == (b"", 5)  # the length


KEY = (0x01, 0x44, 0x58, 0x4C, 0x22)


def test_clear_takes_whole_turns_away_and_moves_nothing(bus: Serve) -> None:
    device, [servo] = bus("1:XM430-W350:operating_mode=4")
    with master(device) as line:
        assert line.put(1, 64, b"\x01") == 0
        far = 2048 + 4096
        moving = servo.model.registers["moving"].address
        assert line.put(1, 116, far.to_bytes(4, "little")) == 0
        place = servo.model.registers["present_position"].address

        def position() -> int:
            return int.from_bytes(line.get(1, place, 4), "little")

        end = time.monotonic() + 60.0
        while position() != pytest.approx(far, abs=5) or line.get(1, moving, 1) != b"\0":
            assert time.monotonic() < end
        assert line.clear(1, 0x02, 0x44, 0x58, 0x4C, 0x22) == 4  # reserved
        assert line.clear(1, *KEY[:3]) == 4
        assert line.clear(1, *KEY) == 0
        assert position() == pytest.approx(2048, abs=5)  # a turn less, and where it was
        assert int.from_bytes(line.get(1, 116, 4), "little") == 2048
        assert line.put(1, 116, (2048).to_bytes(4, "little")) == 0
        assert position() == pytest.approx(2048, abs=5)


def test_clear_is_refused_while_a_horn_turns_and_by_an_xl320(bus: Serve) -> None:
    device, [servo, _] = bus("1:XM430-W350:operating_mode=4", "2:XL-320")
    with master(device) as line:
        assert line.put(1, 64, b"\x01") == 0
        assert line.put(1, 116, (100 * 4096).to_bytes(4, "little")) == 0
        moving = servo.model.registers["moving"].address
        end = time.monotonic() + 60.0
        while line.get(1, moving, 1) == b"\0":
            assert time.monotonic() < end
        assert line.clear(1, *KEY) == 1
        assert line.clear(2, *KEY) == 2
