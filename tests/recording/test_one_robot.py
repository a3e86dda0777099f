"""Recordings of others: keys that are understood or named, and why samples cannot be used."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import pytest

from adaptive_contact.service.one_robot import OneRobot
from adaptive_contact.service.recording import Record, RecordingWriter
from adaptive_contact.wire import MSGPACK, ContactEvent, ContactTruth, contact_key, truth_key
from stepping import step

TICK = 20_000_000
LEGS = ("lf", "rf")
Fields = dict[str, Any]


def _fields(k: int, **changed: Any) -> Fields:
    angles, phase = step(k)
    read = [round(q / 0.005118) * 0.005118 for q in angles]
    return {
        "v": 1,
        "t_ns": k * TICK,
        "seq": k,
        "measured": read,
        "desired": angles,
        "phase": phase,
        **changed,
    }


def _write(
    path: Path,
    change: Callable[[Fields], Fields] = lambda fields: fields,
    key: Callable[[str], str] = lambda key: key,
    pack: Callable[[Fields], tuple[bytes, str]] = lambda fields: (msgpack.packb(fields), MSGPACK),
) -> Path:
    """A walk of two legs, with truth and events."""
    with RecordingWriter(path) as writer:
        for k in range(400):
            for leg in LEGS:
                payload, encoding = pack(change(_fields(k)))
                writer.write(key(f"robot/leg/{leg}/servo"), payload, encoding, k * TICK)
                if k % 40 in (5, 25):
                    touches = k % 40 == 25
                    at = {"t_ns": k * TICK - TICK // 2, "contact": touches}
                    truth = ContactTruth(**at, force=2.0 * touches)
                    told = ContactEvent(
                        leg=leg, t_ns=k * TICK, seq=k, onset_ns=k * TICK, contact=touches,
                        status="valid", score=2.0, residual=[0.1], model_version=1,
                    )  # fmt: skip
                    for name, message in ((truth_key(leg), truth), (contact_key(leg), told)):
                        writer.write_message(key(name), message, k * TICK)
    return path


@pytest.fixture
def run(ours: Any, tmp_path: Path) -> Callable[[str, Path], tuple[int, str, str]]:
    more = {"replay": ["--events", "-"], "score": ["--json"], "fit": ["-o", tmp_path / "out"]}
    return lambda command, path: ours(command, path, *more[command])


def _score(said: str) -> Any:
    return {name: part for name, part in json.loads(said).items() if name != "recording"}


def _as_json(begin: bytes) -> Callable[[Fields], tuple[bytes, str]]:
    return lambda fields: (begin + json.dumps(fields).encode(), "text/json")


@pytest.mark.parametrize(
    ("key", "pack"),
    [
        (lambda key: f"/{key}", None),
        (lambda key: f"hexapod1/{key}", None),
        (lambda key: f"/lab/hexapod1/{key}", None),
        (lambda key: key, _as_json(b"")),
        (lambda key: key, _as_json(b"\xef\xbb\xbf")),
        (lambda key: key, _as_json(b" \n\t")),
        (lambda key: key, lambda fields: (json.dumps(fields).encode(), "zenoh/bytes")),
        (lambda key: key, lambda fields: (msgpack.packb(fields), "zenoh/bytes")),
    ],
    ids=["a slash", "a namespace", "both", "text/json", "BOM", "white space", "none", "msgpack"],
)
def test_keys_and_encodings_that_are_understood(
    key: Any, pack: Any, run: Any, tmp_path: Path
) -> None:
    plain = run("score", _write(tmp_path / "plain.mcap"))
    other = run("score", _write(tmp_path / "a.mcap", key=key, **({"pack": pack} if pack else {})))
    assert plain[0] == other[0] == 0
    assert _score(plain[1]) == _score(other[1])
    assert sum(row["touches"] for row in _score(plain[1])["rows"].values()) > 0
    assert other[2] == plain[2], "that the robot is the shipped one, and nothing else"
    code, _, said = run("replay", tmp_path / "a.mcap")
    assert code == 0
    assert "800 samples in 400 ticks" in said
    for sound in (plain[2], said):  # it is accused of nothing
        assert "not used" not in sound
        assert "legs lf rf" not in sound


@pytest.mark.parametrize(
    ("command", "misspelt"),
    [
        ("replay", "robot/legs/rf/servo"),
        ("replay", "rf/servo"),
        ("score", "/robot/legs/rf/servo"),
        ("fit", "robot/leg/rf/servos"),
    ],
)
def test_a_misspelt_key_is_named(command: str, misspelt: str, run: Any, tmp_path: Path) -> None:
    start, end = misspelt.split("rf")
    path = _write(
        tmp_path / "a.mcap",
        key=lambda key: key.replace("robot/leg/", start).replace("/servo", end),
    )
    code, _, said = run(command, path)
    assert code == 2
    line = f"400 messages on {misspelt} not used: did you mean robot/leg/rf/servo?"
    assert line in said
    assert "--key" not in said


# What `doctor` would name, and by which commands it is tried: all have one door.
REASONS: dict[str, tuple[str, Callable[[Fields], Fields], str]] = {
    "degrees": (
        "replay score fit",
        lambda f: f | {n: [math.degrees(q) for q in f[n]] for n in ("measured", "desired")},
        "angles are not in radians: more than a turn; these look like degrees",
    ),
    "seconds": ("replay", lambda f: f | {"t_ns": f["t_ns"] / 1e9}, "t_ns is not an integer"),
    "microseconds": (
        "score", lambda f: f | {"t_ns": f["t_ns"] // 1000}, "it seems to be in microseconds",
    ),
    "milliseconds": (
        "fit", lambda f: f | {"t_ns": f["t_ns"] // 1_000_000}, "it seems to be in milliseconds",
    ),
    "whole seconds": (
        "replay", lambda f: f | {"t_ns": f["t_ns"] // 1_000_000_000}, "t_ns does not increase",
    ),
    "joints": (
        "score",
        lambda f: f | {n: f[n][:2] for n in ("measured", "desired")},
        "samples have 2 joints, robot.toml has 3 (coxa, femur, tibia)",
    ),
    "a text": ("fit", lambda f: f | {"measured": "0.1 0.2 0.3"}, "payloads cannot be read"),
    "no seq": (
        "replay score fit",
        lambda f: {n: v for n, v in f.items() if n != "seq"},
        "missing required field `seq`",
    ),
    "NaN": (
        "replay score fit",
        lambda f: f | {"desired": [math.nan] * 3},
        "samples hold NaN or infinity",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("command", "change", "why"),
    [
        pytest.param(command, change, why, id=f"{name}-{command}")
        for name, (commands, change, why) in REASONS.items()
        for command in commands.split()
    ],
)
def test_the_reason_is_the_one_that_doctor_gives(
    command: str, change: Any, why: str, run: Any, tmp_path: Path
) -> None:
    code, out, said = run(command, _write(tmp_path / "a.mcap", change))
    assert (code, out) == (2, "")
    named = [line for line in said.splitlines() if why in line]
    assert len(named) == 1, said
    assert "legs lf rf: " in named[0]


@pytest.mark.parametrize(
    ("command", "count", "why"),
    [
        ("replay", lambda k: 6 * k + 3, "seq goes up by 6 from sample to sample: 5 of 6 count as"),
        ("fit", lambda k: 20 * k + (k % 4 == 0), "seq goes up by 20 from sample to sample"),
        ("replay", lambda k: 2 * k + (k > 100) + (k > 300), "seq goes up by 2 from sample to"),
        ("fit", lambda k: 7, "samples repeat the seq before them: 399 of 399"),
        ("replay", lambda k: k // 2, "samples repeat the seq before them: 200 of 399"),
    ],
    ids=["one of six legs", "milliseconds", "every second", "none", "twice"],
)
def test_numbers_that_count_no_ticks_are_named(
    command: str, count: Any, why: str, run: Any, tmp_path: Path
) -> None:
    code, out, said = run(
        command, _write(tmp_path / "a.mcap", lambda f: f | {"seq": count(f["seq"])})
    )
    assert (code, out) == (2, "")
    assert why in said, said
    assert "period_s" not in said
    assert "are lost" not in said


@pytest.mark.parametrize("command", ["replay", "score"])
def test_turns_are_named(command: str, run: Any, tmp_path: Path) -> None:
    """As doctor and fit do: they cost events, and nothing else says so."""

    def turned(fields: Fields) -> Fields:
        seq = fields["seq"]
        off = math.tau * (seq % 37 == 3)
        load = 0.02 * math.sin(seq * seq)  # without it the readings are copies
        return fields | {
            "measured": [q + off + load for q in fields["measured"]],
            "desired": [q + off for q in fields["desired"]],
        }

    _, _, said = run(command, _write(tmp_path / "a.mcap", turned))
    assert said.count("readings are off by a full turn") == 1
    assert "beyond their limits" not in said


@pytest.mark.parametrize("command", ["replay", "score"])
def test_one_leg_in_degrees_does_not_spoil_the_other(
    command: str, run: Any, tmp_path: Path
) -> None:
    legs = iter(LEGS * 400)

    def change(fields: Fields) -> Fields:
        turns = math.degrees(1.0) if next(legs) == "lf" else 1.0
        return fields | {n: [q * turns for q in fields[n]] for n in ("measured", "desired")}

    code, _, said = run(command, _write(tmp_path / "a.mcap", change))
    assert code == 0
    assert "leg lf: angles are not in radians" in said


@pytest.mark.parametrize(("command", "code"), [("replay", 2), ("score", 0)])
def test_at_another_rate_events_can_be_scored_but_not_made(
    command: str, code: int, run: Any, tmp_path: Path
) -> None:
    path = _write(tmp_path / "a.mcap", lambda fields: fields | {"t_ns": 2 * fields["t_ns"]})
    found, _, said = run(command, path)
    assert found == code
    assert "legs lf rf: robot.toml says that ticks are 20.0 ms apart (50.0 Hz)" in said


def _records(*keys: str) -> list[Record]:
    return [Record(key, msgpack.packb(_fields(0)), MSGPACK, 0, 0) for key in keys]


def test_a_second_robot_is_left_out_and_named() -> None:
    robots = OneRobot(
        _records("a/robot/leg/rf/servo", "b/robot/leg/rf/servo", "b/robot/leg/lf/servo")
    )
    assert [record.key for record in robots] == ["robot/leg/rf/servo"]
    (line,) = robots.trouble(None)
    assert line.startswith("2 messages under 'b' not used")
    assert "one robot (under 'a')" in line


def test_keys_of_others_pass_as_they_are() -> None:
    keys = ["camera/image", "/tf", "robot/sim/drift", "a/b/c/d/servo", "arm/command"]
    robots = OneRobot(_records(*keys))
    assert [record.key for record in robots] == keys
    assert robots.trouble(None) == []


def test_many_misspelt_keys_are_counted() -> None:
    robots = OneRobot(_records(*(f"leg{i}/servo" for i in range(10))))
    assert len(list(robots)) == 10
    lines = robots.trouble(None)
    assert len(lines) == 4
    assert lines[-1] == "and 7 more such keys"
