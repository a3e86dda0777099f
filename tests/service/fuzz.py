"""Fuzz of the codec and the sample checks; a script, not a test (``make fuzz``).

    python tests/service/fuzz.py [inputs] [seed]

Inputs are honest payloads in which values, types, lengths or bytes were changed, cut or spliced,
and plain noise, as msgpack and as JSON.  Each must give a sample or a refusal
with a known reason and one short line, never an exception; every sample that passes goes through
the checks of its leg's stream, whose answer must be a known one, too, and what it leaves there must
fit a status and a file.
"""

from __future__ import annotations

import json
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec

from adaptive_contact.core.detect.stream import (
    Accepted,
    StreamGuard,
)
from adaptive_contact.service.state import Identity, Record, pack
from adaptive_contact.wire import (
    JSON,
    MSGPACK,
    LearnerStatus,
    Reject,
    Rejected,
    ServoSample,
    decode,
    encode,
    leg_of_key,
)

# An honest sample.
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
WHO = Identity("mini", "rf", "servo", "0123456789abcdef")
# What msgpack can say, and what only JSON can.
NASTY: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2**31, 2**63 - 1, 2**63, 2**64 - 1, -(2**63)),
    *(0.0, -0.0, 1e308, -1e308, 5e-324, float("nan"), float("inf"), float("-inf")),
    *("", "swing", "x" * 5000, "\0", "\u202e", "1", b"", b"\xff" * 9),
    *([], {}, [[]], [None], [0.0] * 5000, {"a": {"b": {}}}, [[0.0, 0.1, 0.2]] * 3),
)
HUGE = (2**64, 2**70, -(2**63) - 1, -(2**70), 10**300)
FRESH = 100_000  # inputs after which there is a new pool
POOL = 5_000
STRETCH = 250  # samples of one publisher


def spoil(fields: dict[Any, Any], rng: random.Random, nasty: tuple[Any, ...]) -> None:
    """Put one fault into a sample, or into one of its lists."""
    key = rng.choice(list(fields))
    value = fields[key]
    what = rng.randrange(4)
    if what == 0 and len(fields) > 1:
        del fields[key]
    elif what == 1 or not isinstance(value, list):
        fields[rng.choice((key, "more", ""))] = rng.choice(nasty)
    elif what == 2:
        fields[key] = (value * rng.randrange(3))[1:]
    else:
        fields[key] = [rng.choice(nasty), *value[1:]]
        rng.shuffle(fields[key])


def stream(rng: random.Random, number: int, *, huge: bool) -> list[dict[Any, Any]]:
    """Honest samples one after the other, some with gaps, some out of order, some with faults."""
    nasty = NASTY + HUGE if huge else NASTY
    trees = []
    seq, t_ns = 1201, HONEST["t_ns"]
    for at in range(POOL):
        if at % STRETCH == 0:
            # A program tells its `run` always or never.  One wild `run` that comes again and again
            # is a newer publisher, and keeps all others out: only some stretches have them.
            who = {"run": HONEST["run"] + number + at} if rng.randrange(4) else {}
            wild_runs = not rng.randrange(4)
        gap = rng.choice((1, 1, 1, 1, 2, 7, -1, 0))
        seq, t_ns = seq + gap, t_ns + gap * 20_000_000 + rng.randrange(-5, 5)
        fields = {**HONEST, "t_ns": t_ns, "seq": seq}
        del fields["run"]
        for key in ("preview", "phase", "valid"):
            if not rng.randrange(8):
                del fields[key]
        if wild_runs:
            fields |= who
        if not rng.randrange(3):
            for _ in range(rng.randrange(1, 4)):
                spoil(fields, rng, nasty)
        trees.append(fields if wild_runs else fields | who)
    return trees


def pool_of(rng: random.Random, number: int) -> list[tuple[bytes, str]]:
    """Payloads as msgpack and as JSON."""
    plain, huge = stream(rng, number, huge=False), stream(rng, number + 1, huge=True)
    packed = [(msgspec.msgpack.encode(one), MSGPACK) for one in plain]
    return packed + [(as_json(one), JSON) for one in huge]


def scramble(data: bytes, rng: random.Random) -> bytes:
    """Bytes with flips, a cut, a splice, or none of it left."""
    if not data:
        return rng.randbytes(rng.randrange(200))
    at = rng.randrange(len(data))
    deep = rng.choice((b"\x91", b"[", b'{"a":', b"\x81\xa1a")) * rng.randrange(1, 3000)
    flipped = bytearray(data)
    flipped[at] ^= rng.randrange(1, 256)
    more = rng.randbytes(rng.randrange(1, 9))
    spliced = data[:at] + more + data[at:]
    return rng.choice(
        (rng.randbytes(at), data[:at], data[at:] + data[:at], spliced, deep, bytes(flipped))
    )


def as_json(fields: dict[Any, Any]) -> bytes:
    # Python's own: it writes integers of any size, and NaN as other programs do.
    return json.dumps(fields, default=lambda value: value.decode("latin-1")).encode()


def fuzz(inputs: int, seed: int, say: Callable[[str], None]) -> Counter[str]:
    """Try so many inputs; raises on the first that is not handled."""
    rng = random.Random(seed)
    found: Counter[str] = Counter()
    guards = {joints: StreamGuard(joints) for joints in (1, 3)}
    samples: list[tuple[bytes, str]] = []
    for number in range(inputs):
        if number % FRESH == 0:
            # Trees are dear to make: a fresh pool of them now and then, the bytes anew each time.
            samples = pool_of(rng, number)
            if number % 1_000_000 == 0:
                say(f"{number} inputs")
        # Mostly in their order, as a source sends them.
        at = number if rng.randrange(10) else rng.randrange(len(samples))
        payload, encoding = samples[at % len(samples)]
        if rng.randrange(2):
            payload = scramble(payload, rng)
        if not rng.randrange(50):
            encoding = rng.choice((JSON, MSGPACK, "", "text/plain", "application/json;charset=x"))
        message = decode(payload, ServoSample, encoding)
        leg_of_key(payload.decode("latin-1"))
        if isinstance(message, Rejected):
            assert isinstance(message.reason, Reject), message
            assert len(message.detail) <= 260, message
            assert "\n" not in message.detail, message
            found[message.reason] += 1
            continue
        for guard in guards.values():
            answer = guard.admit(message)
            if isinstance(answer, Accepted):
                found["accepted"] += 1
                _tell_and_keep(guard, message)
            else:
                assert isinstance(answer, Reject), answer
                found[f"sample {answer}"] += 1
    return found


def _tell_and_keep(guard: StreamGuard, sample: ServoSample) -> None:
    """What an accepted sample leaves must fit the wire, and a file."""
    status = LearnerStatus(
        leg="rf",
        t_ns=sample.t_ns,
        status="valid",
        model_version=1,
        residual_rms=[],
        noise_floor=[],
        missed=guard.missed,
    )
    encode(status)
    pack(
        Record(
            identity=WHO,
            saved_ns=1,
            package="",
            model_version=1,
            run=guard.run,
            seq=sample.seq,
            missed_down=guard.missed,
            body={"missed": guard.missed},
        )
    )


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
