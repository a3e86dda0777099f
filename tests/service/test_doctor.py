from __future__ import annotations

import functools
import json
import math
import random
from collections.abc import Callable
from typing import Any, TypeVar

import msgspec
import pytest
import views
from views import status as learner

from adaptive_contact.checks.findings import Fault, Finding
from adaptive_contact.checks.legcheck import check_leg
from adaptive_contact.service.doctor import Diagnosis, Examination, diagnose
from adaptive_contact.status import SERVICE_STATUS, LegFacts
from adaptive_contact.wire import (
    MSGPACK,
    Reject,
    Rejected,
    ServoSample,
    Status,
    encode,
    learner_key,
    servo_key,
)
from adaptive_contact.wire.received import Received
from programs import tried
from waiting import free_address

FACTS = LegFacts(joints=["coxa", "femur", "tibia"], lengths=True)


def stream(n: int = 150, **fields: Any) -> list[ServoSample]:
    """Three seconds of a leg that swings, the servos 0.03 rad behind their commands, and noise."""
    rng = random.Random(1)
    return [
        ServoSample(
            **{
                "t_ns": k * 20_000_000,
                "seq": k,
                "measured": [
                    0.4 * math.sin(0.2 * k - 0.1 * j) + rng.gauss(0.0, 0.004) for j in range(3)
                ],
                "desired": [0.4 * math.sin(0.2 * k - 0.1 * j + 0.08) for j in range(3)],
                "phase": "swing" if k % 50 < 30 else "stance",
                "run": 1,
                **fields,
            }
        )
        for k in range(n)
    ]


def change(samples: list[ServoSample], **fields: Callable[[ServoSample], Any]) -> list[ServoSample]:
    return [
        msgspec.structs.replace(s, **{name: value(s) for name, value in fields.items()})
        for s in samples
    ]


def judge(samples: list[ServoSample], **settings: Any) -> list[Fault]:
    return check_leg(
        "rf",
        samples,
        settings.pop("refused", []),
        **{"seconds": 3.0, "period_s": 0.02, "facts": FACTS, **settings},
    )


Found = TypeVar("Found", Finding, Fault)


def only(findings: list[Found]) -> Found:
    assert len(findings) == 1, findings
    assert findings[0].remedy
    return findings[0]


def text(fault: Fault) -> str:
    return fault.what if fault.detail is None else f"{fault.what}: {fault.detail}"


def test_only_unreadable_payloads() -> None:
    refused = [Rejected(Reject.MISSING_FIELD, "missing required field `seq`")] * 7
    found = only(judge([], refused=refused))
    assert found.cause == "unreadable"
    assert "7 refused; missing_field 7 times" in text(found)


def joint(j: int, value: Callable[[float, int], float]) -> Callable[[ServoSample], list[float]]:
    return lambda s: [value(x, s.seq) if i == j else x for i, x in enumerate(s.measured)]


@pytest.mark.parametrize(
    ("samples", "what", "level"),
    [
        ([], "no usable sample on robot/leg/LEG/servo", "error"),
        (change(stream(), measured=joint(1, lambda x, k: 0.1)), "femur reads 0.100 rad", "error"),
        (change(stream(), measured=joint(2, lambda x, k: x + 0.9)), "tibia by 0.90 rad", "error"),
        (
            change(stream(), measured=joint(0, lambda x, k: -x)),
            "moves against its command: coxa",
            "error",
        ),
        (
            change(stream(), measured=joint(0, lambda x, k: math.degrees(x))),
            "look like degrees: coxa reaches 22.9",
            "error",
        ),
        (
            change(stream(), measured=joint(0, lambda x, k: math.nan if k < 20 else x)),
            "NaN or infinity: 20 of 150",
            "error",
        ),
        (change(stream(), t_ns=lambda s: s.seq * 25_000_000), "found 25.0 ms (40.0 Hz)", "error"),
        (change(stream(), t_ns=lambda s: s.seq * 20), "seems to be in milliseconds", "error"),
        (stream()[:70] + stream()[75:], "samples are lost, by gaps in seq: 5 (3.3%)", "warning"),
        (
            change(stream(), run=lambda s: s.seq % 2 + 1, seq=lambda s: s.seq // 2),
            "2 publishers take turns",
            "error",
        ),
        (
            change(stream(), run=lambda s: s.seq),
            "changes repeatedly: 149 times in 150",
            "error",
        ),
        (
            change(stream(), run=lambda s: s.seq // 30),
            "changes repeatedly: 4 times in 150",
            "error",
        ),
        (change(stream(), t_ns=lambda s: -s.t_ns), "t_ns does not increase", "error"),
        (
            change(stream(), seq=lambda s: s.seq - (s.seq % 10 == 3)),
            "repeat the seq before them: 15 of 149",
            "error",
        ),
        (
            change(stream(), seq=lambda s: (s.seq + 200) % 256),
            "seq wraps at 256: the samples that follow count as repeated",
            "warning",
        ),
        (change(stream(), seq=lambda s: s.seq % 60), "seq wraps at 60: ", "warning"),
        (
            change(stream(), seq=lambda s: 4 * s.seq + 1),
            "seq goes up by 4 from sample to sample: 3 of 4 count as lost",
            "error",
        ),
        (
            change(stream()[:70] + stream()[75:], seq=lambda s: 4 * s.seq),
            "samples are lost, by gaps in seq: 5 (3.3%)",
            "warning",
        ),
        (
            change(stream(), seq=lambda s: 4 * s.seq, t_ns=lambda s: s.seq * 25_000_000),
            "found 25.0 ms (40.0 Hz)",
            "error",
        ),
        (
            change(stream(), valid=lambda s: [True, s.seq % 4 > 0, True]),
            "readings marked invalid: 25% of them",
            "warning",
        ),
    ],
)
def test_what_is_wrong_with_a_stream(samples: list[ServoSample], what: str, level: str) -> None:
    found = [finding for finding in judge(samples) if what in text(finding)]
    assert len(found) == 1, judge(samples)
    assert found[0].level == level
    assert found[0].remedy


def test_joints_phase_and_unknown_legs_are_held_against_robot_toml() -> None:
    four = LegFacts(joints=["a", "b", "c", "d"], lengths=True)
    assert "3 joints, robot.toml has 4 (a, b, c, d)" in only(judge(stream(), facts=four)).what
    bare = LegFacts(joints=FACTS.joints, lengths=False)
    assert "no phase" in only(judge(stream(phase=None), facts=bare)).what
    unknown = LegFacts(joints=["joint 1"], lengths=True, described=False)
    assert (
        "the leg is not in the robot.toml that is served"
        in only(judge(stream(), facts=unknown)).what
    )
    told = only(judge(stream(), facts=None, period_s=None))
    assert (told.level, told.detail) == ("note", "samples come every 20.0 ms (50.0 Hz)")


@pytest.mark.parametrize(
    "samples",
    [
        stream(75) + stream(75, run=2),  # a restart of the source
        stream(measured=[0.1, 0.2, 0.3], desired=[0.12, 0.2, 0.3]),  # it hangs still
    ],
)
def test_what_is_no_fault(samples: list[ServoSample]) -> None:
    assert judge(samples) == []


# -- the whole wire ---------------------------------------------------------------------------


service = functools.partial(views.service, baseline="b.json", legs={"rf": FACTS})


def receive(*messages: tuple[str, bytes], encoding: str = MSGPACK) -> Examination:
    received = Examination()
    for key, payload in messages:
        received.process_message(Received(key, payload, encoding, 0, None))
    return received


def good() -> list[tuple[str, bytes]]:
    return [
        (SERVICE_STATUS, encode(service())),
        (learner_key("rf"), encode(learner())),
        *((servo_key("rf"), encode(sample)) for sample in stream()),
    ]


def whats(diagnosis: Diagnosis) -> list[str]:
    return [f"{f.level}: {f.what}" for f in diagnosis.findings]


def test_all_is_well() -> None:
    others = ("weather/today", b"sun")
    diagnosis = diagnose(receive(*good(), others), 3.0, alive=True)
    assert (diagnosis.findings, diagnosis.exit_code) == ([], 0)
    (traffic,) = [key for key in diagnosis.keys if key.key == servo_key("rf")]
    assert traffic.rate_hz == 50.0
    assert traffic.encodings == [MSGPACK]
    assert traffic.bytes_per_s == pytest.approx(50 * traffic.mean_bytes)


def test_a_stranger_that_published_once_is_a_note() -> None:
    """The service keeps a learner of it until it ends, whose status is `silent`."""
    facts = {"rf": FACTS, "RF": LegFacts(joints=FACTS.joints, lengths=False, described=False)}
    received = receive(
        *good(),
        (SERVICE_STATUS, encode(service(legs=facts))),
        (learner_key("RF"), encode(learner(leg="RF", status="silent"))),
    )
    diagnosis = diagnose(received, 3.0, alive=True)
    assert diagnosis.exit_code == 0, diagnosis.findings
    (note,) = diagnosis.findings
    assert (note.level, note.cause, note.legs) == ("note", "silent", ["RF"])


@pytest.mark.parametrize(
    ("messages", "alive", "told"),
    [
        (good(), False, ["error: a router is there, but no service"]),
        (
            [],
            False,
            ["error: a router is there, but no service", "error: nobody publishes servo samples"],
        ),
        (good()[1:], True, ["warning: a service runs, but has published no status"]),
        (
            [(SERVICE_STATUS, encode(service(note="compiling: wait"))), *good()[2:]],
            True,
            ["error: note of the service: compiling: wait"],
        ),
    ],
)
def test_what_is_not_there(messages: list[tuple[str, bytes]], alive: bool, told: list[str]) -> None:
    diagnosis = diagnose(receive(*messages), 3.0, alive=alive)
    assert [line for line in whats(diagnosis) if not line.startswith("note: ")] == told
    assert diagnosis.exit_code == 1


def test_refusals_of_old_are_notes_and_new_ones_warnings() -> None:
    def status(n: int) -> tuple[str, bytes]:
        return learner_key("rf"), encode(learner(rejects={"not_finite": n}))

    def whole(n: int) -> tuple[str, bytes]:
        return SERVICE_STATUS, encode(service(rejects={"unknown_leg": n}, samples=100 * n))

    old = diagnose(receive(*good(), whole(3), whole(3), status(2), status(2)), 3.0, alive=True)
    assert old.exit_code == 1, "the first status had no refusals"
    old = diagnose(receive(*good()[2:], whole(3), whole(3), status(2), status(2)), 3.0, alive=True)
    assert old.exit_code == 0
    assert len(old.findings) == 2
    for more, level in ((9, "warning"), (4, "note")):  # one or two are what any bus has
        now = whole(3), whole(more), status(2), status(more - 1)
        new = diagnose(receive(*good()[2:], *now), 3.0, alive=True)
        assert [finding.level for finding in new.findings] == [level, level]
        assert new.exit_code == (level == "warning")


@pytest.mark.parametrize(
    ("status", "remedy"),
    [
        ("ambiguous", "look at the foot and its servos"),
        ("learning", "until the leg is known, let it swing"),
        ("valid", "docs/operating.md lists what to do for each note"),
    ],
)
def test_a_legs_own_note_comes_with_what_to_do(status: Status, remedy: str) -> None:
    told = learner(status=status, note="the foot came 40 % of its command's way")
    received = receive(*good(), *2 * [(learner_key("rf"), encode(told))])
    finding = only(diagnose(received, 3.0, alive=True).findings)
    assert finding.what.startswith(f"{status}: ")
    assert finding.what.endswith(": the foot came 40 % of its command's way")
    assert remedy in finding.remedy


@pytest.mark.parametrize(
    ("key", "what", "remedy"),
    [
        ("robot/leg/rf/servos", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("robot/legs/rf/servo", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("rf/servo", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("robot/rf/servo", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("robot/leg/servo/rf", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("Robot/Leg/rf/Servo", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("robot/leg/rf/servo/coxa", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("robot/leg/servo/rf/coxa", "nobody reads this key", "did you mean robot/leg/rf/servo?"),
        ("hexa/robot/leg/rf/servo", "lie under 'hexa'", "--namespace hexa"),
        ("robot/leg/*/servo", "names no usable leg", "leg id"),
    ],
)
def test_strays(key: str, what: str, remedy: str) -> None:
    diagnosis = diagnose(receive(*good(), (key, b"")), 3.0, alive=True)
    assert what in only(diagnosis.findings).what
    assert remedy in diagnosis.findings[0].remedy


def test_legs_misspelt_in_one_way_are_one_entry() -> None:
    received = receive(*((f"robot/legs/{leg}/servo", b"") for leg in ("lf", "lm", "rf")))
    entry = only([f for f in diagnose(received, 3.0, alive=True).findings if f.cause == "key"])
    assert entry.legs == ["lf", "lm", "rf"]


def test_a_flood_of_keys_is_bounded() -> None:
    received = receive(*((f"x/{n}", b"") for n in range(1000)))
    assert len(received.meters) == 400
    assert received.uncounted_keys == 600


@pytest.mark.e2e
def test_the_command(beside_a_source: Any) -> None:
    nobody = free_address()
    alone = tried("doctor", "--connect", nobody)
    assert (alone.exit_code, f"nobody listens on tcp/{nobody}" in alone.output) == (2, True)
    samples = [("rf", one) for one in stream(75)]
    result = beside_a_source(samples, "doctor", "--seconds", "3", "--json")
    assert result.exit_code == 1
    diagnosis = json.loads(result.stdout)
    assert (diagnosis["router"], diagnosis["service_alive"]) == ("connected", False)
    assert [key["key"] for key in diagnosis["keys"]] == [servo_key("rf")]
    findings = [msgspec.convert(row, Finding) for row in diagnosis["findings"]]
    assert "a router is there, but no service" in [finding.what for finding in findings]


def test_what_the_service_says_of_itself_is_found() -> None:
    told = service(note="state: disk full", events_lost=3, slow_puts=5, late_puts=3, stalls=1)
    messages = [(SERVICE_STATUS, encode(told)), *good()[1:]]
    assert whats(diagnose(receive(*messages), 3.0, alive=True)) == [
        "error: note of the service: state: disk full",
        "error: 3 contact events were lost: held up for too long, or the link was closed",
        "warning: 1 times the service stood still for a second or more",
        "note: 2 contact events were held up by a subscriber that hung",
        "note: 3 contact events were late, though no subscriber hung: its computer is busy",
    ]
