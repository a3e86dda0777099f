"""Recordings for other programs: their own readers decode what is written."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from adaptive_contact.cli.export import export
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.service.recording.export import export_recording
from adaptive_contact.service.recording.scene import Scene
from adaptive_contact.service.recording.schemas import kind_of_key
from adaptive_contact.wire import (
    JSON,
    MSGPACK,
    BodyPose,
    BridgeStatus,
    Command,
    ContactEvent,
    ContactTruth,
    Drift,
    LearnerStatus,
    Mark,
    Message,
    ModelReport,
    ModelTerm,
    Quantiles,
    ServoCounts,
    ServoSample,
    encode,
    servo_key,
)

SECOND = 1_000_000_000
BIG = 1_700_000_000_123_456_789  # no float has this value

SAMPLE = ServoSample(
    t_ns=BIG,
    seq=7,
    measured=[0.1, -0.2, 0.3],
    desired=[0.0, 1e-300, 2.0],
    preview=[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
    phase="swing",
    valid=[True, False, True],
)
MESSAGES: dict[str, Message] = {
    "robot/leg/lf/servo": SAMPLE,
    "robot/leg/four/servo": ServoSample(t_ns=1, seq=0, measured=[1.0] * 4, desired=[2.0] * 4),
    "robot/leg/lf/contact": ContactEvent(
        leg="lf", t_ns=BIG, seq=7, onset_ns=BIG - 5, contact=True, status="valid", score=1.5,
        residual=[0.1, 0.2, 0.3], model_version=2,
    ),
    "robot/leg/lf/learner": LearnerStatus(
        leg="lf", t_ns=3, status="adapting", model_version=1, residual_rms=[0.1], noise_floor=[0.2],
        rejects={"not_finite": 3, "malformed": 1},
    ),
    "robot/leg/lf/model": ModelReport(
        leg="lf", model_version=1, joints=["coxa"], terms=[[ModelTerm(name="x", coefficient=2.0)]],
        equations=["x' = 2 x, \"quoted\""],
    ),
    "robot/leg/lf/truth": ContactTruth(t_ns=4, contact=False, force=0.0),
    "robot/leg/lf/command": Command(desired=[0.5]),
    "hexapod1/robot/bridge/left/status": BridgeStatus(
        port="left", t_ns=5, mode="drive", state="running", rate_hz=50.0, wanted_hz=50.0,
        cycle_ms=Quantiles(p50=1.0), jitter_ms=Quantiles(max=2.0), cycles=9, missed=0,
        servos={"3": ServoCounts(faults={"stale": 2})},
    ),
    "robot/sim/drift": Drift(kind="mass", value=0.1),
    "robot/mark": Mark(t_ns=BIG, label="a slip"),
    "robot/sim/body": BodyPose(
        t_ns=6, position_m=(0.1, 0.2, 0.3), quaternion_wxyz=(1.0, 0.0, 0.0, 0.0)
    ),
}  # fmt: skip


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "in.mcap"
    with RecordingWriter(path, about={"robot": "hexapod"}) as writer:
        for at, (key, message) in enumerate(MESSAGES.items()):
            encoding = (MSGPACK, JSON)[at % 2]
            writer.write(key, encode(message, encoding), encoding, at * SECOND)
        writer.write("camera/fps", msgspec.msgpack.encode({"fps": 30}), MSGPACK, 20 * SECOND)
        writer.write("robot/leg/lf/servo", b"\xc1", MSGPACK, 21 * SECOND)
    return path


@pytest.mark.parametrize(
    "key", ["robot/legs/lf/servo", "robot/leg/lf/servos", "myrobot/leg/lf/servo", "servo", ""]
)
def test_other_keys_have_no_schema(key: str) -> None:
    assert kind_of_key(key) is None


def plain(held: Any) -> Any:
    """A protobuf message as the map that it came from."""
    if hasattr(held, "DESCRIPTOR"):
        fields = {f.name: plain(part) for f, part in held.ListFields()}
        return fields["values"] if set(fields) == {"values"} else fields
    if isinstance(held, str | bytes | int | float):
        return held
    items = [plain(part) for part in held]
    if items and all(isinstance(item, dict) and "key" in item for item in items):
        return {item["key"]: item.get("value", {}) for item in items}
    return items


def whole(held: Any) -> Any:
    """A message as a map, with what it leaves out on the wire."""
    if isinstance(held, msgspec.Struct):
        return {f: whole(getattr(held, f)) for f in held.__struct_fields__}
    if isinstance(held, dict):
        return {k: whole(part) for k, part in held.items()}
    return [whole(part) for part in held] if isinstance(held, list | tuple) else held


def told(held: Any) -> Any:
    """Without what protobuf does not tell from nothing: zeros, empty lists and texts, None."""
    if isinstance(held, dict):
        return {k: told(v) for k, v in held.items() if told(v) not in (None, 0, "", [], {})}
    return [told(part) for part in held] if isinstance(held, list) else held


def decoded(path: Path) -> Iterator[tuple[str, int, str, Any]]:
    """Topic, log time, name of the schema and content of what mcap's own support can decode."""
    factory = DecoderFactory()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            decode = factory.decoder_for(channel.message_encoding, schema)
            if decode is not None:
                yield channel.topic, message.log_time, schema.name, decode(message.data)


def test_mcaps_own_protobuf_support_decodes_every_message(recorded: Path) -> None:
    found = {topic: rest for topic, *rest in decoded(recorded)}
    assert list(found) == list(MESSAGES)
    for at, (key, message) in enumerate(MESSAGES.items()):
        log_time, schema, content = found[key]
        assert (log_time, schema) == (at * SECOND, f"adaptive_contact.{type(message).__name__}")
        assert told(plain(content)) == told(whole(message))
    assert not found["robot/leg/lf/learner"][2].HasField("note")


def test_an_older_recording_becomes_one_that_opens(recorded: Path, tmp_path: Path) -> None:
    older, out = tmp_path / "older.mcap", tmp_path / "out.mcap"
    writer = Writer(str(older))
    writer.start()
    for record in read_recording(recorded):
        encoding = record.encoding.removeprefix("application/")
        channel = writer.register_channel(record.key, encoding, 0)
        writer.add_message(channel, record.log_time_ns, record.payload, record.publish_time_ns)
    writer.finish()
    assert list(read_recording(older)) == list(read_recording(recorded))
    exported = export_recording(read_recording(older), out, "mcap")
    assert exported.messages == len(MESSAGES) + 2
    assert list(read_recording(out)) == list(read_recording(recorded))
    assert [found[0] for found in decoded(out)] == list(MESSAGES)


@pytest.mark.parametrize("name", ["hexapod", "mine"])
def test_a_robot_that_is_drawn_stays_drawn_or_that_is_said(
    ours: Any, name: str, tmp_path: Path
) -> None:
    path, out = tmp_path / "in.mcap", tmp_path / "out.mcap"
    sample = ServoSample(t_ns=1, seq=0, measured=[0.0, 0.5, -1.5], desired=[0.0, 0.5, -1.5])
    with RecordingWriter(path, {"robot": name}, Scene(shipped_robot())) as writer:
        for leg in shipped_robot().leg_ids:
            writer.write(servo_key(leg), encode(sample, MSGPACK), MSGPACK, SECOND)

    done = ours("export", str(path), "--to", "mcap", "-o", str(out))
    assert done.code == 0
    drawn = [any(topic == "/tf" for topic, *_ in decoded(each)) for each in (path, out)]
    assert drawn == [True, name == "hexapod"]
    assert ("robot 'mine' is not drawn" in done.err) == (name == "mine")


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_table_has_a_row_for_each_message(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "tables"
    exported = export_recording(read_recording(recorded), out, "csv")
    assert exported.files[out / "ServoSample.csv"] == 2
    rows = table(out / "ServoSample.csv")
    assert [row["measured_3"] for row in rows] == ["", "1.0"]
    assert rows[0]["t_ns"] == str(BIG)
    assert float(rows[0]["desired_1"]) == 1e-300
    assert (rows[0]["valid_0"], rows[0]["valid_1"]) == ("1", "0")
    assert json.loads(rows[0]["preview"]) == SAMPLE.preview
    assert [row["leg"] for row in rows] == ["lf", "four"]
    assert table(out / "LearnerStatus.csv")[0]["leg"] == "lf"
    status = table(out / "BridgeStatus.csv")[0]
    assert (status["key"], status["jitter_ms.max"]) == ("hexapod1/robot/bridge/left/status", "2.0")
    model = table(out / "ModelReport.csv")[0]
    assert json.loads(model["equations"]) == ['x\' = 2 x, "quoted"']


def test_damage_is_said_and_the_rest_exported(ours: Any, recorded: Path, tmp_path: Path) -> None:
    content = recorded.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[: len(content) // 3])
    intact = len(list(read_recording(cut)))
    assert 0 < intact < len(MESSAGES)
    done = ours("export", cut, "--to", "mcap", "-o", tmp_path / "out.mcap")
    assert done.code == 0
    damaged = read_recording(cut)
    list(damaged)
    assert f"adaptive-contact: {cut}: {damaged.damage}" in done.err
    assert len(list(read_recording(tmp_path / "out.mcap"))) == intact


@pytest.mark.parametrize(("to", "name"), [("mcap", "walk-mcap.mcap"), ("csv", "walk-csv")])
def test_without_a_name_it_lies_beside_the_recording(
    recorded: Path, to: Any, name: str, tmp_path: Path
) -> None:
    copy = tmp_path / "here" / "walk.mcap"
    copy.parent.mkdir()
    copy.write_bytes(recorded.read_bytes())
    export(copy, to)
    assert {path.name for path in copy.parent.iterdir()} == {"walk.mcap", name}


def test_what_is_there_stays_without_force(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    out.write_text("another")
    export(recorded, "mcap", out, force=True)
    assert len(list(read_recording(out))) == len(MESSAGES) + 2
    tables = tmp_path / "tables"
    export(recorded, "csv", tables)
    with pytest.raises(ConfigurationError, match=r"\.csv exists already"):
        export(recorded, "csv", tables)
    with pytest.raises(ConfigurationError, match="is no folder"):
        export(recorded, "csv", out)
    with pytest.raises(ConfigurationError, match="what the command reads"):
        export(recorded, "mcap", recorded, force=True)


def test_nothing_to_export_leaves_no_file(tmp_path: Path) -> None:
    source, out = tmp_path / "in.mcap", tmp_path / "out"
    with RecordingWriter(source) as writer:
        writer.write("camera/raw", b"\xff\xd8", "image/jpeg", 0)
    with pytest.raises(RecordingError, match=r"none of its 1 messages .*camera/raw"):
        export_recording(read_recording(source), out, "csv")
    assert not out.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["in.mcap"]
