"""Fuzz of the codec and the sample checks; a script, not a test (``make fuzz``).

    python tests/service/fuzz.py [inputs] [seed]

Inputs are honest payloads in which values, types, lengths or bytes were changed, cut or spliced,
and plain noise, as msgpack and as JSON, of every kind of message.  Each must give a message or a
refusal with a known reason and one short line, never an exception; every sample that passes goes
through the checks of its leg's stream, whose answer must be a known one, too, and what it leaves
there must fit a status and a file.  Every 100,000 inputs an honest source starts anew and must be
believed within a second (48 samples of its own), however many runs came that did not last.
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
    CONFIRM_SAMPLES,
    MOST_SHORT_LIVED,
    Accepted,
    StreamGuard,
)
from adaptive_contact.service.sample_queue import Raw, read
from adaptive_contact.service.state import Identity, Record, pack
from adaptive_contact.status import LatencyMs, LegFacts, ServiceStatus, StateFacts
from adaptive_contact.wire import (
    JSON,
    MAX_SAMPLE_BYTES,
    MSGPACK,
    BridgeStatus,
    Command,
    ContactEvent,
    ContactTruth,
    Drift,
    LearnerStatus,
    Message,
    ModelReport,
    ModelTerm,
    Quantiles,
    Reject,
    Rejected,
    ServoSample,
    decode,
    encode,
    leg_of_key,
)

# Each kind with an honest one of it.
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
OTHERS: tuple[Message, ...] = (
    Command(desired=[0.1, 0.2, 0.3], preview=[[0.1, 0.2, 0.3]]),
    Drift(kind="friction", value=2.0, leg="rf", joint="femur", shape="ramp", duration_s=3.0),
    ContactTruth(t_ns=5, contact=True, force=3.0, speed_m_s=0.2, surface="hard", part="foot"),
    ContactEvent(
        leg="rf",
        t_ns=5,
        seq=3,
        onset_ns=4,
        contact=True,
        status="valid",
        score=2.0,
        residual=[0.1, 0.0, 0.0],
        model_version=2,
    ),
    ModelReport(
        leg="rf",
        model_version=2,
        joints=["coxa"],
        terms=[[ModelTerm(name="q0", coefficient=1.0)]],
        equations=["q0' = q0"],
    ),
    LearnerStatus(
        leg="rf",
        t_ns=5,
        status="valid",
        model_version=2,
        residual_rms=[0.001] * 3,
        noise_floor=[0.001] * 3,
        rejects={"malformed": 2},
        note="a word",
    ),
    ServiceStatus(
        version="1",
        robot="mini",
        period_s=0.02,
        baseline=None,
        legs={"rf": LegFacts(joints=["coxa"])},
        uptime_s=3.0,
        tick_latency=LatencyMs(p50=0.1, p99=0.2, max=0.3, count=9),
        state=StateFacts(folder="/x", restored=["rf"], refused=[], saved=1, failed=0, error=None),
    ),
    BridgeStatus(
        port="ttyUSB0",
        t_ns=5,
        mode="drive",
        state="running",
        rate_hz=50.0,
        wanted_hz=50.0,
        cycle_ms=Quantiles(p50=1.0, p99=2.0, max=3.0),
        jitter_ms=Quantiles(p50=1.0, p99=2.0, max=3.0),
        cycles=9,
        missed=0,
    ),
)
KINDS: dict[type[Message], dict[str, Any]] = {
    ServoSample: HONEST,
    **{type(one): msgspec.to_builtins(one) for one in OTHERS},
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
MOST_SAMPLES = CONFIRM_SAMPLES << (MOST_SHORT_LIVED - 1)
RUN = 10**12
FRESH = 100_000  # inputs after which there is a new pool, and a source that starts anew
POOL = 5_000
STRETCH = 250  # samples of one publisher


def spoil(fields: dict[Any, Any], rng: random.Random, nasty: tuple[Any, ...]) -> None:
    """Put one fault into a tree, at any depth."""
    keys = list(fields)
    if not keys:
        return
    key = rng.choice(keys)
    value = fields[key]
    what = rng.randrange(5)
    if what == 0:
        fields.pop(key)
    elif what == 1:
        fields[rng.choice((key, "more", ""))] = rng.choice(nasty)
    elif isinstance(value, dict) and value:
        inner = dict(value)
        spoil(inner, rng, nasty)
        fields[key] = inner
    elif isinstance(value, list) and value:
        changed = list(value)
        if what == 2:
            changed[rng.randrange(len(changed))] = rng.choice(nasty)
        elif what == 3:
            changed = changed * rng.randrange(3)
        else:
            changed.pop()
        fields[key] = changed
    elif isinstance(value, int):
        fields[key] = rng.choice(nasty)


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


def pool_of(rng: random.Random, number: int) -> dict[type[Message], list[tuple[bytes, str]]]:
    """Payloads of every kind, as msgpack and as JSON."""
    plain, huge = stream(rng, number, huge=False), stream(rng, number + 1, huge=True)
    pool = {ServoSample: [(msgspec.msgpack.encode(one), MSGPACK) for one in plain]}
    pool[ServoSample] += [(as_json(one), JSON) for one in huge]
    for kind, honest in KINDS.items():
        if kind is ServoSample:
            continue
        pool[kind] = []
        for k in range(POOL // 10):
            fields = dict(honest)
            for _ in range(rng.randrange(3)):
                spoil(fields, rng, NASTY + HUGE if k % 2 else NASTY)
            pool[kind].append(
                (as_json(fields), JSON) if k % 2 else (msgspec.msgpack.encode(fields), MSGPACK)
            )
    return pool


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
    # Python's own: it writes integers of any size, and NaN as other programs do.
    return json.dumps(fields, default=lambda value: value.decode("latin-1")).encode()


def fuzz(inputs: int, seed: int, say: Callable[[str], None]) -> Counter[str]:
    """Try so many inputs; raises on the first that is not handled."""
    rng = random.Random(seed)
    found: Counter[str] = Counter()
    guards = {joints: StreamGuard(joints) for joints in (1, 3)}
    pool: dict[type[Message], list[tuple[bytes, str]]] = {}
    samples: list[tuple[bytes, str]] = []
    others = [kind for kind in KINDS if kind is not ServoSample]
    for number in range(inputs):
        if number % FRESH == 0:
            # Trees are dear to make: a fresh pool of them now and then, the bytes anew each time.
            pool = pool_of(rng, number)
            samples = pool[ServoSample]
            _believe(guards[3], number)
            if number % 1_000_000 == 0:
                say(f"{number} inputs")
        kind: type[Message] = ServoSample
        if rng.randrange(8):
            # Mostly in their order, as a source sends them.
            at = number if rng.randrange(10) else rng.randrange(len(samples))
            payload, encoding = samples[at % len(samples)]
        else:
            kind = rng.choice(others)
            payload, encoding = rng.choice(pool[kind])
        if rng.randrange(2):
            payload = scramble(payload, rng)
        if not rng.randrange(50):
            encoding = rng.choice((JSON, MSGPACK, "", "text/plain", "application/json;charset=x"))
        if kind is ServoSample:
            message: Any = read(Raw(payload, encoding, 0, len(payload)))
        else:
            asked = kind if rng.randrange(4) else rng.choice(others)
            message = decode(payload, asked, encoding)
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
                if isinstance(answer, Accepted):
                    found["accepted"] += 1
                    _tell_and_keep(guard, message)
                else:
                    assert isinstance(answer, Reject), answer
                    found[f"sample {answer}"] += 1
    oversized = read(Raw(b"", MSGPACK, 0, MAX_SAMPLE_BYTES + 1))
    assert isinstance(oversized, Rejected)
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


def _believe(guard: StreamGuard, number: int) -> None:
    """An honest source that starts anew is believed after 48 samples, whatever came before."""
    answers = [
        guard.admit(
            ServoSample(
                t_ns=tick + 1, seq=tick, measured=[0.0] * 3, desired=[0.0] * 3, run=RUN + number
            )
        )
        for tick in range(MOST_SAMPLES + 3)
    ]
    first = answers.index(Accepted(missed=0, restart=True))
    assert first < MOST_SAMPLES, answers
    assert set(answers[:first]) <= {Reject.OTHER_PUBLISHER}, answers
    assert set(answers[first + 1 :]) == {Accepted(missed=0, restart=False)}, answers


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
