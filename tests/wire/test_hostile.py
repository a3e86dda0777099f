"""The worst payload of the largest size is decoded and judged in few steps per byte."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable

import msgpack
import pytest

from adaptive_contact.core.detect.stream import Accepted, StreamGuard
from adaptive_contact.wire import (
    JSON,
    MAX_PREVIEW_TICKS,
    MAX_SAMPLE_BYTES,
    MSGPACK,
    Reject,
    Rejected,
    ServoSample,
    decode,
    encode,
)

JOINTS = 3
ROOM = MAX_SAMPLE_BYTES - 200
# A step of plain Python is some 10 ns.  Three times what the worst of these takes, and a tenth of
# what a preview took while its rows were put together one by one.
STEPS_PER_BYTE = 50
TRIES = 20


def as_json(**fields: str) -> bytes:
    table = {"measured": "[0,0,0]", "desired": "[0,0,0]", **fields}
    text = ",".join(f'"{name}":{value}' for name, value in table.items())
    return f'{{"v":1,"t_ns":1,"seq":1,{text}}}'.encode()


def as_msgpack(**fields: object) -> bytes:
    table = {"v": 1, "t_ns": 1, "seq": 1, "measured": [0.0] * 3, "desired": [0.0] * 3, **fields}
    return bytes(msgpack.packb(table))


def many(item: str, around: str = "[]") -> str:
    """A JSON list of as many items as a payload holds."""
    return f"{around[0]}{','.join([item] * (ROOM // (len(item) + 1)))}{around[-1]}"


def nested(depth: int) -> list[object]:
    found: list[object] = []
    for _ in range(depth):
        found = [found]
    return found


HOSTILE = {
    "a long preview": (as_json(preview=many("[0,0,0]")), JSON),
    "a preview of empty rows": (as_json(preview=many("[]")), JSON),
    "a wide preview": (as_json(preview=f"[{many('0')}]"), JSON),
    "a long reading": (as_json(measured=many("0")), JSON),
    "a long command": (as_json(desired=many("0.25")), JSON),
    "long validity": (as_json(valid=many("true")), JSON),
    "one number": (as_json(measured=f"[{'1' * ROOM}]"), JSON),
    "one fraction": (as_json(measured=f"[0.{'1' * ROOM}]"), JSON),
    "long numbers": (as_json(x=many("1" * 4000)), JSON),
    "one text": (as_json(phase=f'"{"x" * ROOM}"'), JSON),
    "many fields": (as_json(**{f"k{k}": "0" for k in range(ROOM // 12)}), JSON),
    "deep": (as_json(x="[" * (ROOM // 2) + "]" * (ROOM // 2)), JSON),
    "often deep": (as_json(x=many("[" * 900 + "]" * 900)), JSON),
    "a long preview in msgpack": (as_msgpack(preview=[[0] * JOINTS] * 4096), MSGPACK),
    "a wide preview in msgpack": (as_msgpack(preview=[[0] * 4096] * 7), MSGPACK),
    "a long reading in msgpack": (as_msgpack(measured=[0] * 4096), MSGPACK),
    "long validity in msgpack": (as_msgpack(valid=[True] * 4096), MSGPACK),
    "many lists in msgpack": (as_msgpack(x=[[[]] * 4095] * 3), MSGPACK),
    "many fields in msgpack": (as_msgpack(**{f"k{k}": 0 for k in range(4000)}), MSGPACK),
    "often deep in msgpack": (as_msgpack(x=[nested(400)] * 75), MSGPACK),
    # Without an end, which the parser does not come to see.
    "deep in msgpack": (as_msgpack(x=0)[:-1] + b"\x91" * ROOM, MSGPACK),
}


def shortest(work: Callable[[], object]) -> float:
    """The best of three, s; without the collector, whose passes depend on what else there is."""
    gc.collect()
    gc.disable()
    try:
        times = []
        for _ in range(3):
            began = time.perf_counter()
            work()
            times.append(time.perf_counter() - began)
    finally:
        gc.enable()
    return min(times)


@pytest.mark.parametrize("what", HOSTILE)
def test_the_largest_payload_takes_few_steps_per_byte(what: str) -> None:
    payload, encoding = HOSTILE[what]
    assert len(payload) <= MAX_SAMPLE_BYTES

    def judge() -> None:
        found = decode(payload, ServoSample, encoding)
        if isinstance(found, ServoSample):
            StreamGuard(JOINTS).admit(found)

    def step() -> None:
        for _ in payload:
            pass

    # A computer that is busy may take its time in some tries; what is not linear does in all.
    assert any(shortest(judge) < STEPS_PER_BYTE * shortest(step) for _ in range(TRIES))


@pytest.mark.parametrize("encoding", [JSON, MSGPACK])
def test_a_preview_is_as_long_as_a_model_can_look_ahead(encoding: str) -> None:
    for ticks, answer in (
        (MAX_PREVIEW_TICKS, Accepted(0, restart=True)),
        (MAX_PREVIEW_TICKS + 1, Reject.OUT_OF_RANGE),
    ):
        row = [0.1] * JOINTS
        sample = ServoSample(t_ns=1, seq=1, measured=row, desired=row, preview=[row] * ticks)
        read = decode(encode(sample, encoding), ServoSample, encoding)
        assert StreamGuard(JOINTS).admit(read) == answer


def test_lists_in_json_are_counted_before_they_are_made() -> None:
    found = decode(as_json(x=f"[{','.join(['[]'] * 4096)}]"), ServoSample, JSON)
    assert found == Rejected(Reject.MALFORMED, "4100 lists and maps, at most 4096")
    fits = decode(as_json(x=f"[{','.join(['[]'] * 4092)}]"), ServoSample, JSON)
    assert isinstance(fits, ServoSample)
