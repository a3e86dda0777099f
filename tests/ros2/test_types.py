"""Hashes against those that rosidl generated; damaged bytes are refused, whatever they are."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.ros2.problems import CdrError, UnknownHashError
from adaptive_contact.ros2.rmw import NO_HASH, RosType
from adaptive_contact.ros2.types import (
    Types,
    typestore,
)
from ros_messages import Messages

# From C sources that rosidl_generator_c wrote (Iron and Kilted).
GENERATED = {
    RosType.CONTROLLER_STATE: "RIHS01_"
    "6cb9ac0858fc11b54bd6c0a46f032ea243c16856182276d8eb0875f6ce6a8335",
    RosType.JOINT_VALUES: "RIHS01_18024c98a62697680f581108eeed40b28fb4542fa0ac5a8e36f56c62b6813d26",
    RosType.JOINT_STATE: "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
}


@pytest.mark.parametrize("name", GENERATED)
def test_hashes_are_rosidls(name: str) -> None:
    assert typestore("2023").hash_rihs01(name) == GENERATED[name]


@pytest.mark.parametrize("state", ["jazzy", "2023", "humble", "old"])
def test_each_definition_is_read_by_its_hash(state, joints) -> None:
    made = Messages(state)
    sent = made.state(joints, [0.1] * 6, [0.2] * 6)
    hash_ = made.store.hash_rihs01(RosType.CONTROLLER_STATE)
    read = Types().decode(RosType.CONTROLLER_STATE, hash_, made.cdr(sent))
    assert list(read.joint_names) == joints
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (1, 0)
    assert list(read.feedback.positions) == [0.1] * 6
    assert list(read.reference.positions) == [0.2] * 6


@pytest.mark.parametrize("state", ["humble", "old"])
def test_without_hashes_the_layout_decides(state, joints) -> None:
    made = Messages(state)
    sent = made.state(joints, [0.1] * 6, [0.2] * 6)
    read = Types("humble").decode(RosType.CONTROLLER_STATE, NO_HASH, made.cdr(sent))
    assert read.feedback.positions[5] == 0.1


def test_a_bool_is_five_bytes_and_humble_writes_no_hashes() -> None:
    types = Types()
    assert types.encode(types.types[RosType.BOOL](data=True)) == b"\x00\x01\x00\x00\x01"
    assert Types("humble").hash_of(RosType.BOOL) == NO_HASH
    assert Types("jazzy").hash_of(RosType.BOOL).startswith("RIHS01_")


def test_an_unknown_hash_is_named() -> None:
    with pytest.raises(UnknownHashError, match="RIHS01_"):
        Types().decode(RosType.JOINT_STATE, "RIHS01_" + 64 * "0", b"")


def test_every_cut_is_refused_and_other_damage_is_or_is_read(joints) -> None:
    made = Messages()
    whole = made.cdr(made.state(joints, [0.1] * 6, [0.2] * 6))
    hash_ = made.store.hash_rihs01(RosType.CONTROLLER_STATE)
    types, rng, refused = Types(), np.random.default_rng(3), 0
    for length in range(len(whole)):
        with pytest.raises(CdrError):
            types.decode(RosType.CONTROLLER_STATE, hash_, whole[:length])
    for _ in range(3000):
        damaged = np.frombuffer(whole, dtype=np.uint8).copy()
        at = rng.integers(len(damaged), size=rng.integers(1, 6))
        damaged[at] = rng.integers(256, size=len(at))
        try:
            types.decode(RosType.CONTROLLER_STATE, hash_, damaged.tobytes())
        except CdrError:
            refused += 1
    assert refused > 300
