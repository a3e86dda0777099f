"""The codec takes what the contract says, and names what is wrong with everything else."""

from __future__ import annotations

import math

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact import wire
from adaptive_contact.status import SERVICE_STATUS
from adaptive_contact.wire import (
    JSON,
    MAX_PAYLOAD_BYTES,
    MAX_PREVIEW_TICKS,
    MAX_SAMPLE_BYTES,
    MSGPACK,
    ContactEvent,
    Drift,
    LearnerStatus,
    Message,
    Reject,
    Rejected,
    ServoSample,
    decode,
    encode,
)
from adaptive_contact.wire.messages import LEG_MESSAGES

angles = st.lists(st.floats(-3, 3), min_size=1, max_size=6)
samples = st.builds(
    ServoSample,
    t_ns=st.integers(0, 2**62),
    seq=st.integers(0, 2**40),
    measured=angles,
    desired=angles,
    preview=st.none() | st.lists(angles, max_size=3),
    phase=st.sampled_from([None, "swing", "stance"]),
    valid=st.none() | st.lists(st.booleans(), max_size=6),
    run=st.none() | st.integers(0, 2**40),
)


@given(samples, st.sampled_from([MSGPACK, JSON]))
def test_what_is_encoded_decodes_to_the_same(sample: ServoSample, encoding: str) -> None:
    assert decode(encode(sample, encoding), ServoSample, encoding) == sample


def test_the_bytes_are_a_plain_msgpack_map_with_a_version() -> None:
    sample = ServoSample(t_ns=5, seq=1, measured=[0.5], desired=[0.25], phase="swing")
    assert msgpack.unpackb(encode(sample)) == {
        "v": 1, "t_ns": 5, "seq": 1, "measured": [0.5], "desired": [0.25], "phase": "swing",
    }  # fmt: skip


GOOD = {"v": 1, "t_ns": 1, "seq": 1, "measured": [0.1], "desired": [0.2]}


@pytest.mark.parametrize(
    ("change", "reason", "names"),
    [
        ({"v": 2}, Reject.VERSION, "v"),
        ({"v": None}, Reject.VERSION, "v"),
        ({"v": ...}, Reject.MISSING_FIELD, "v"),
        ({"seq": ...}, Reject.MISSING_FIELD, "seq"),
        ({"measured": ...}, Reject.MISSING_FIELD, "measured"),
        ({"seq": "1"}, Reject.WRONG_TYPE, "seq"),
        ({"t_ns": 1.5}, Reject.WRONG_TYPE, "t_ns"),
        ({"measured": [0.1, "x"]}, Reject.WRONG_TYPE, "measured[1]"),
        ({"measured": 3}, Reject.WRONG_TYPE, "measured"),
        ({"phase": "flight"}, Reject.WRONG_TYPE, 'phase`; expected "swing" or "stance"'),
        ({"preview": [0.1]}, Reject.WRONG_TYPE, "preview[0]"),
    ],
)
def test_a_wrong_field_is_named(change: dict[str, object], reason: Reject, names: str) -> None:
    table = {k: v for k, v in {**GOOD, **change}.items() if v is not ...}
    result = decode(msgpack.packb(table), ServoSample)
    assert result.reason is reason
    assert names in result.detail
    assert "\n" not in result.detail


def test_unknown_fields_are_ignored_and_integers_taken_for_angles() -> None:
    sample = decode(msgpack.packb({**GOOD, "measured": [1], "later": {"a": 1}}), ServoSample)
    assert sample.measured == [1.0]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        encode(ServoSample(t_ns=1, seq=1, measured=[0.1], desired=[0.1]))[:-1],
        b"\x91" * 30_000,  # nested until the parser gives up
        b"\xdd\xff\xff\xff\xff",  # an array that claims four thousand million entries
        msgpack.packb({1: 2, "v": 1}),
    ],
)
def test_broken_msgpack_is_malformed(payload: bytes) -> None:
    result = decode(payload, ServoSample)
    assert result.reason is Reject.MALFORMED


@pytest.mark.parametrize(
    ("kind", "most"), [(ServoSample, MAX_SAMPLE_BYTES), (LearnerStatus, MAX_PAYLOAD_BYTES)]
)
def test_a_huge_payload_is_not_even_parsed(kind: type[Message], most: int) -> None:
    huge = decode(b"\x00" * (most + 1), kind)
    assert huge == Rejected(Reject.TOO_LARGE, f"more than {most} bytes")
    parsed = decode(b"\x00" * most, kind)
    assert parsed.reason is not Reject.TOO_LARGE


def test_the_longest_sample_fits() -> None:
    row = [-1.2345678901234567] * 16
    sample = ServoSample(
        t_ns=2**62,
        seq=2**40,
        measured=row,
        desired=row,
        phase="swing",
        valid=[False] * 16,
        run=-(2**62),
        preview=[row] * MAX_PREVIEW_TICKS,
    )
    for encoding in (JSON, MSGPACK):
        assert decode(encode(sample, encoding), ServoSample, encoding) == sample


@given(st.binary(max_size=300), st.sampled_from([MSGPACK, JSON, "text/plain", ""]))
def test_no_bytes_raise(payload: bytes, encoding: str) -> None:
    for kind in (ServoSample, ContactEvent, LearnerStatus, Drift):
        assert isinstance(decode(payload, kind, encoding), Message | Rejected)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
        max_leaves=20,
    )
)
def test_no_structure_raises(value: object) -> None:
    for extra in ({}, {"v": 1}, GOOD):
        table = {**extra, **value} if isinstance(value, dict) else value
        assert isinstance(decode(msgpack.packb(table), ServoSample), ServoSample | Rejected)


def test_json_nan_does_not_pass() -> None:
    payload = b'{"v":1,"t_ns":1,"seq":1,"measured":[NaN],"desired":[0]}'
    assert isinstance(decode(payload, ServoSample, JSON), Rejected)


def test_status_and_event_stay_small_enough_for_zenoh_pico() -> None:
    reasons = {str(reason): 2**40 for reason in Reject}
    status = LearnerStatus(
        leg="l" * 32, t_ns=2**62, status="ambiguous", model_version=10**6, rejects=reasons,
        residual_rms=[math.pi] * 6, noise_floor=[math.pi] * 6, note="n" * 300,
    )  # fmt: skip
    event = ContactEvent(
        leg="l" * 32, t_ns=2**62, seq=2**40, onset_ns=2**62, contact=True, status="valid",
        score=1e9, residual=[math.pi] * 6, model_version=10**6,
    )  # fmt: skip
    for message in (status, event):
        assert max(len(encode(message, e)) for e in (JSON, MSGPACK)) < 4000


@pytest.mark.parametrize("begin", [b"", b" \r\n\t", b"\xef\xbb\xbf", b"\xef\xbb\xbf "])
@pytest.mark.parametrize(
    "encoding",
    ["", "zenoh/bytes", "zenoh/string", "text/json", "text/plain", MSGPACK, JSON],
)
def test_a_payload_that_begins_with_a_brace_is_json_whatever_is_declared(
    encoding: str, begin: bytes
) -> None:
    """With a mark of byte order, or white space before it, too."""
    sample = decode(
        begin + b'{"v":1,"t_ns":1,"seq":1,"measured":[0.1],"desired":[0]}', ServoSample, encoding
    )
    assert isinstance(sample, ServoSample)


@pytest.mark.parametrize("encoding", ["", "text/json", JSON, MSGPACK])
def test_a_map_of_msgpack_is_read_whatever_is_declared(encoding: str) -> None:
    more = {f"extra{n}": n for n in range(20)}  # a map of 16 and more begins with another byte
    for table in (GOOD, {**GOOD, **more}):
        assert isinstance(decode(msgpack.packb(table), ServoSample, encoding), ServoSample)


@pytest.mark.parametrize("word", ["NaN", "-Infinity", "nan", "inf"])
def test_what_json_lacks_is_named(word: str) -> None:
    text = f'{{"v":1,"t_ns":1,"seq":1,"measured":[0.1, {word}],"desired":[0,0]}}'
    result = decode(text.encode(), ServoSample, JSON)
    assert result == (Reject.MALFORMED, "NaN or infinity, which JSON has no words for")
    other = decode(b'{"v":1,"note":"NaN"', ServoSample, JSON)
    assert "NaN" not in other.detail


# -- Keys name one leg each, and nothing that Zenoh would expand


@pytest.mark.parametrize("leg", ["rf", "leg_1", "L-2.b", "a" * 32])
def test_a_key_tells_its_leg_and_others_none(leg: str) -> None:
    for other in (
        "robot/sim/drift",
        f"robot/leg/{leg}",
        f"robot/leg/{leg}/other",
        f"x/robot/leg/{leg}/servo",
    ):
        assert wire.leg_of_key(other) is None
    for make in (
        wire.servo_key, wire.contact_key, wire.learner_key,
        wire.model_key, wire.truth_key, wire.command_key,
    ):  # fmt: skip
        assert wire.leg_of_key(make(leg)) == leg


@pytest.mark.parametrize(
    "leg", ["", "*", "**", "$*", "a*", "a/b", "a b", "é", "-x", "a" * 33, "rf\n", "?", "#"]
)
def test_wildcards_and_separators_name_no_leg(leg: str) -> None:
    assert not wire.is_leg_id(leg)
    assert wire.leg_of_key(f"robot/leg/{leg}/servo") is None


@pytest.mark.parametrize("before", ["", "hexapod1/", "site/hexapod1/"])
@pytest.mark.parametrize(
    "key",
    [
        SERVICE_STATUS, wire.HEARTBEAT, wire.MARK, wire.SIM_DRIFT, wire.SIM_BODY,
        wire.bridge_status_key("servos"),
        *(f"robot/leg/rf/{kind}" for kind in LEG_MESSAGES),
    ],
)  # fmt: skip
def test_a_key_of_the_contract_is_no_misspelling(before: str, key: str) -> None:
    assert wire.meant_key(before + key) is None
