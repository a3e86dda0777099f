"""Fuzz of the codec and the sample checks; a script, not a test (``make fuzz``).

    python tests/service/fuzz.py [inputs] [seed]

Inputs are honest payloads in which values, types, lengths or bytes were changed, cut or spliced,
and plain noise, as msgpack and as JSON.  Each must give a message or a refusal with a known reason
and one short line, never an exception; every sample that passes goes through the checks of its
leg's stream, whose answer must be a known one, too.  Every 100,000 inputs an honest source starts
anew and must be believed at once.
"""

from __future__ import annotations

import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec

from adaptive_contact.adapt.stream import Accepted, StreamGuard
from adaptive_contact.service.intake import Raw, read
from adaptive_contact.wire import (
    JSON,
    MAX_PAYLOAD_BYTES,
    MSGPACK,
    Command,
    ContactEvent,
    Drift,
    LearnerStatus,
    Reject,
    Rejected,
    ServoSample,
    decode,
    leg_of_key,
)

KINDS = (ServoSample, Command, Drift, ContactEvent, LearnerStatus)
NASTY: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2**31, 2**63 - 1, 2**63, 2**64 - 1, -(2**63)),
    *(0.0, -0.0, 1e308, -1e308, 5e-324, float("nan"), float("inf"), float("-inf")),
    *("", "swing", "x" * 5000, "\0", "\u202e", "1", b"", b"\xff" * 9),
    *([], {}, [[]], [None], [0.0] * 5000, {"a": {"b": {}}}, [[0.0, 0.1, 0.2]] * 3),
)
HONEST: dict[str, Any] = {
    "v": 1,
    "t_ns": 1_732_147_200_000_000_000,
    "seq": 1201,
    "measured": [0.102, -0.419, 0.967],
    "desired": [0.105, -0.425, 0.972],
    "preview": [[0.1, 0.2, 0.3]],
    "phase": "swing",
    "valid": [True, True, False],
    "run": 1_732_147_176,
}
KEYS = tuple(HONEST)
RUN = 10**12


def tree(rng: random.Random) -> dict[Any, Any]:
    """An honest sample with one to three faults."""
    fields = dict(HONEST)
    fields["t_ns"] += rng.randrange(-5, 10**9)
    fields["seq"] += rng.randrange(-2, 50)
    for _ in range(rng.randrange(4)):
        key = rng.choice(KEYS)
        what = rng.randrange(5)
        if what == 0:
            fields.pop(key, None)
        elif what == 1:
            fields[rng.choice((key, "more", ""))] = rng.choice(NASTY)
        elif isinstance(fields.get(key), list) and fields[key]:
            changed = list(fields[key])
            if what == 2:
                changed[rng.randrange(len(changed))] = rng.choice(NASTY)
            elif what == 3:
                changed = changed * rng.randrange(3)
            else:
                changed.pop()
            fields[key] = changed
        elif isinstance(fields.get(key), int):
            fields[key] = rng.choice(NASTY)
    return fields


def scramble(data: bytes, rng: random.Random) -> bytes:
    """Bytes with flips, a cut, a splice, or none of it left."""
    what = rng.randrange(6)
    if what == 0 or not data:
        return rng.randbytes(rng.randrange(200))
    at = rng.randrange(len(data))
    if what == 1:
        return data[:at]
    if what == 2:
        return data[at:] + data[:at]
    if what == 3:
        return data[:at] + rng.randbytes(rng.randrange(1, 9)) + data[at:]
    if what == 4:  # deep nesting
        return rng.choice((b"\x91", b"[", b'{"a":', b"\x81\xa1a")) * rng.randrange(1, 3000)
    changed = bytearray(data)
    for _ in range(rng.randrange(1, 5)):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def as_json(fields: dict[Any, Any]) -> bytes:
    return msgspec.json.encode(fields)


def fuzz(inputs: int, seed: int, say: Callable[[str], None]) -> Counter[str]:
    """Try so many inputs; raises on the first that is not handled."""
    rng = random.Random(seed)
    found: Counter[str] = Counter()
    guards = {joints: StreamGuard(joints) for joints in (1, 3)}
    pool: list[tuple[bytes, str]] = []
    for number in range(inputs):
        if number % 100_000 == 0:
            # Trees are dear to make: a fresh pool of them now and then, the bytes anew each time.
            fields = [tree(rng) for _ in range(5_000)]
            pool = [(msgspec.msgpack.encode(one), MSGPACK) for one in fields]
            pool += [(as_json(one), JSON) for one in fields]
            _believe(guards[3], number)
            if number % 1_000_000 == 0:
                say(f"{number} inputs")
        payload, encoding = pool[rng.randrange(len(pool))]
        if rng.randrange(4):
            payload = scramble(payload, rng)
        if not rng.randrange(50):
            encoding = rng.choice((JSON, MSGPACK, "", "text/plain", "application/json;charset=x"))
        if rng.randrange(8):
            message: Any = read(Raw(payload, encoding, 0, len(payload)))
        else:
            message = decode(payload, rng.choice(KINDS), encoding)
            leg_of_key(payload.decode("latin-1"))
        if isinstance(message, Rejected):
            assert isinstance(message.reason, Reject), message
            assert len(message.detail) <= 260, message
            assert "\n" not in message.detail, message
            found[message.reason] += 1
            continue
        found[type(message).__name__] += 1
        if isinstance(message, ServoSample):
            for guard in guards.values():
                answer = guard.admit(message)
                assert isinstance(answer, Accepted | Reject), answer
                found["accepted" if isinstance(answer, Accepted) else f"sample {answer}"] += 1
    oversized = read(Raw(b"", MSGPACK, 0, MAX_PAYLOAD_BYTES + 1))
    assert isinstance(oversized, Rejected)
    return found


def _believe(guard: StreamGuard, number: int) -> None:
    """An honest source that starts anew is believed, whatever came before."""
    for tick in range(3):
        answer = guard.admit(
            ServoSample(
                t_ns=tick + 1, seq=tick, measured=[0.0] * 3, desired=[0.0] * 3, run=RUN + number
            )
        )
        assert answer == Accepted(missed=0, restart=tick == 0), answer


def main(inputs: int, seed: int) -> None:
    began = time.monotonic()
    found = fuzz(inputs, seed, lambda line: print(line, flush=True))
    for what, count in found.most_common():
        print(f"{count:10d}  {what}")
    print(f"{inputs} inputs in {time.monotonic() - began:.0f} s, none unhandled")


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 else 10_000_000,
        int(sys.argv[2]) if len(sys.argv) > 2 else 1,
    )
