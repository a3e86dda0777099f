"""The bus over the real DynamixelSDK and a pseudo-terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from described import AX, SCS, STS, XL
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.tables import Block
from adaptive_contact.errors import BusError
from adaptive_contact_sim.virtual import VirtualServo

FAST = {**XL, "fast": True}


@pytest.mark.parametrize("kind", [XL, FAST])
@pytest.mark.parametrize("alone", [True, False])
def test_data_that_look_like_a_header_are_read(
    rig: Callable, opened: Callable, kind: dict, alone: bool
) -> None:
    r = rig(**kind)
    for servo in r.port.servos:
        servo.store("profile_velocity", 2**32 - 1)
        servo.store("goal_position", -3)  # FF FF FF FF FD FF FF FF
    bus, servos = opened(r), [1] if alone else [1, 2, 3, 4, 5, 6]
    for more in range(3):
        readings = bus.read(servos, Block(112, 8 + more))
        assert {readings[i].data[:8] for i in servos} == {b"\xff\xff\xff\xff\xfd\xff\xff\xff"}
        assert [reading.fault for reading in readings.values()] == [None] * len(servos)


@pytest.mark.parametrize("kind", [AX, XL, FAST, STS, SCS])
def test_flipped_bits_are_never_taken_for_data(rig: Callable, opened: Callable, kind: dict) -> None:
    r = rig(**kind)
    for i in range(6):
        r.backend.place(i, 0.3)
    bus, joints = opened(r), r.plans[0].joints
    register, block = joints[0].model.registers["present_position"], joints[0].model.goal_and_motion
    r.fault("flip:p=0.3")
    good = faulty = 0
    for _ in range(30):
        for reading in bus.read([j.servo for j in joints], block, time.monotonic() + 1).values():
            faulty += reading.fault is not None
            if reading.data is not None:
                good += 1
                steps = block.part(reading.data, register)
                # Protocol 1.0's one-byte sum lets no single flipped bit pass.
                assert joints[0].angle(steps) == pytest.approx(0.3, abs=0.01)
    assert good > 100
    assert faulty > 10


def last_byte(packet: bytes) -> bytes:
    return packet[:-1] + bytes((packet[-1] ^ 1,))


def first_byte(packet: bytes) -> bytes:
    return bytes((packet[0] ^ 1,)) + packet[1:]


@pytest.mark.parametrize("broken", [last_byte, first_byte])
@pytest.mark.parametrize("kind", [XL, FAST, STS])
def test_every_wrong_checksum_of_a_common_answer_is_counted(
    rig: Callable, opened: Callable, kind: dict, broken: Callable[[bytes], bytes]
) -> None:
    r = rig(**kind)
    bus, joints = opened(r), r.plans[0].joints
    ids = [j.servo for j in joints]
    r.faults.flip = broken
    counted = 0
    for _ in range(20):
        struck = []

        def once(name: str, servo: int, _: float, struck: list[int] = struck) -> object:
            if name != "flip" or servo != 3 or struck:
                return None
            struck.append(servo)
            return object()

        r.faults.strike = once
        readings = bus.read(ids, joints[0].model.goal_and_motion, time.monotonic() + 1)
        assert struck
        corrupt = [i for i, reading in readings.items() if reading.fault == "corrupt"]
        # Where this computer stood still, answers came too late to be seen to be broken.
        broken_ids = ids if kind is FAST else [3]
        assert set(corrupt) <= set(broken_ids)
        counted += corrupt == broken_ids
        assert all(reading.data is not None for reading in readings.values())
    assert counted >= 16


@pytest.mark.parametrize("kind", [AX, XL, FAST, STS, SCS])
def test_silent_servos_hide_no_other_and_take_no_longer_than_there_is_time(
    rig: Callable, opened: Callable, kind: dict
) -> None:
    r = rig(**kind, timeout_ms=100)
    bus, joints = opened(r), r.plans[0].joints
    r.fault("silent:id=2")
    readings = bus.read([j.servo for j in joints], joints[0].model.goal_and_motion)
    assert readings[2].fault == "no_answer"
    assert all(readings[j.servo].data is not None for j in joints if j.servo != 2)
    r.fault("silent:")
    began = time.monotonic()
    readings = bus.read(
        [j.servo for j in joints], joints[0].model.goal_and_motion, end=began + 0.25
    )
    assert 1 <= len(readings) < 6  # at 100 ms each there is no time to ask them all
    assert all(reading.fault == "no_answer" for reading in readings.values())
    r.fault()
    readings = bus.read([j.servo for j in joints], joints[0].model.goal_and_motion)
    assert all(reading.data is not None for reading in readings.values())


def test_an_error_without_data_is_no_index_error(rig: Callable, opened: Callable) -> None:
    r = rig(**AX)
    bus = opened(r)
    reading = bus.read([1], Block(48, 40))[1]  # beyond the table: error status without data
    assert reading.fault == "refused"
    assert "range" in reading.alarms


@pytest.mark.parametrize("kind", [AX, XL, STS], ids=["AX", "XL", "STS"])
def test_a_late_answer_is_counted_for_the_servo_that_gave_it(
    rig: Callable, opened: Callable, kind: dict
) -> None:
    """A dead one has none, whatever comes late of others: it would pass for the computer's."""
    r = rig(**kind)
    bus, joints = opened(r), r.plans[0].joints
    r.fault("late:id=2,ms=130", "silent:id=5")
    block, deadline = joints[0].model.goal_and_motion, time.monotonic() + 30
    while bus.late[2] < 3 and time.monotonic() < deadline:
        for servo in (5, 2, 4):
            bus.read([servo], block)
    assert bus.late[2] >= 3
    assert bus.late[5] == 0


def test_two_servos_of_one_id_that_answer_one_after_the_other_are_seen(
    rig: Callable, opened: Callable
) -> None:
    r = rig(**AX, wire_time=True)
    slow = VirtualServo(3, r.servo(3).model, r.backend, 3, np.random.default_rng(1))
    slow.store("return_delay", 250)
    r.port.servos = (*r.port.servos, slow)
    bus = opened(r)
    pongs = [bus.ping(3) for _ in range(5)]
    assert any(pong is not None and pong.doubled for pong in pongs)


class OldHandler(Protocol2PacketHandler):
    """DynamixelSDK 3.7.31's: two of its calls take one argument less."""

    def rxPacket(self, port: Any, *rest: Any) -> Any:
        return super().rxPacket(port, False)

    def syncReadTx(self, port: Any, at: int, size: int, ids: list[int], count: int) -> Any:
        return super().syncReadTx(port, at, size, ids, count, False)


def test_an_sdk_without_fast_reads_does_all_the_rest(
    rig: Callable, opened: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dynamixel_sdk.PacketHandler", lambda _: OldHandler())
    r = rig(**XL)
    bus, joints = opened(r), r.plans[0].joints
    readings = bus.read([j.servo for j in joints], joints[0].model.goal_and_motion)
    assert [reading.fault for reading in readings.values()] == [None] * len(joints)
    asked = r.port.requests
    bus.read([j.servo for j in joints], joints[0].model.goal_and_motion)
    assert r.port.requests == asked + 1  # one sync read
    fast = Bus("p0", msgspec.structs.replace(r.plans[0].port, fast=True))
    with pytest.raises(BusError, match=r"fast needs dynamixel-sdk 3\.8 or newer; update it, or"):
        fast.open()


def test_a_late_common_answer_is_asked_for_again(rig: Callable, opened: Callable) -> None:
    r = rig(**FAST)
    bus, joints = opened(r), r.plans[0].joints
    ids = [j.servo for j in joints]
    r.fault("late:id=3,ms=400")
    asked = r.port.requests
    readings = bus.read(ids, joints[0].model.goal_and_motion)
    assert r.port.requests == asked + 1 + len(ids)  # all together, then each alone
    assert {i for i in ids if readings[i].data is None} == {3}
