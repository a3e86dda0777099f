"""Recordings: what is written comes back, and damage costs only what is behind it."""

from __future__ import annotations

import contextlib
import gzip
import os
import resource
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import msgspec
import pytest
import zstandard
from google.protobuf import descriptor_pb2
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from adaptive_contact.errors import RecordingError
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.recording import Record, RecordingWriter, read_recording
from adaptive_contact.service.recording.recorder import SplitWriter
from adaptive_contact.service.recording.scene import Scene
from adaptive_contact.service.recording.schemas import protobuf_class
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus, StateFacts
from adaptive_contact.wire import (
    JSON,
    MSGPACK,
    ContactTruth,
    ServoSample,
    decode,
    encode,
    servo_key,
    truth_key,
)

TICK = 20_000_000
LEGS = ("lf", "lm", "lr", "rf", "rm", "rr")


def sample(k: int) -> ServoSample:
    return ServoSample(
        t_ns=k * TICK, seq=k, measured=[0.1, -0.2, k * 1e-3], desired=[0.0, 0.5, -0.5]
    )


records = st.builds(
    Record,
    key=st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), min_size=1, max_size=40),
    payload=st.binary(max_size=300),
    encoding=st.sampled_from(
        [MSGPACK, JSON, "zenoh/bytes", "text/plain", "application/json;utf-8", "application/cdr"]
    ),
    log_time_ns=st.integers(0, 2**64 - 1),
    publish_time_ns=st.integers(0, 2**64 - 1),
)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(records, max_size=40))
def test_any_key_and_any_payload_come_back(tmp_path: Path, written: list[Record]) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for record in written:
            writer.write(*record)
        assert writer.messages == len(written)
    recording = read_recording(path)
    assert list(recording) == written
    assert recording.damage is None
    assert list(recording) == written  # a second pass


def test_messages_are_decodable_and_channels_named_by_contract(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    truth = ContactTruth(t_ns=5, contact=True, force=1.5, speed_m_s=0.3, surface="hard")
    with RecordingWriter(path, about={"scenario": "pose", "seed": "7"}) as writer:
        writer.write_message(servo_key("rf"), sample(3), 60)
        writer.write(truth_key("rf"), encode(truth, JSON), JSON, 61)
        writer.write("robot/leg/rf/servo", b"\xff broken", MSGPACK, 62)
        writer.write("other/key", b"anything", "text/plain", 63, 40)
    first, second, third, fourth = read_recording(path)
    assert decode(first.payload, ServoSample, first.encoding) == sample(3)
    assert decode(second.payload, ContactTruth, second.encoding) == truth
    assert third == Record("robot/leg/rf/servo", b"\xff broken", MSGPACK, 62, 62)
    assert fourth == Record("other/key", b"anything", "text/plain", 63, 40)
    assert read_recording(path).about == {"scenario": "pose", "seed": "7"}
    # The reference reader of the format finds the same, by index, with schemas for the contract.
    with path.open("rb") as file:
        seen = [
            (channel.topic, channel.message_encoding, schema.name if schema else None)
            for schema, channel, _ in make_reader(file, validate_crcs=True).iter_messages()
        ]
    assert seen == [
        ("robot/leg/rf/servo", "protobuf", "adaptive_contact.ServoSample"),
        ("robot/leg/rf/truth", "protobuf", "adaptive_contact.ContactTruth"),
        ("robot/leg/rf/servo", "msgpack", None),
        ("other/key", "text/plain", None),
    ]


def test_a_file_is_read_by_its_own_descriptors(tmp_path: Path) -> None:
    """An older contract had its fields at other numbers, and fewer of them."""
    path = tmp_path / "a.mcap"
    described = descriptor_pb2.FileDescriptorSet.FromString(protobuf_class(ServoSample)[0])
    fields = described.file[0].message_type[0].field
    assert [field.name for field in fields[:2]] == ["t_ns", "seq"]
    fields[0].number, fields[1].number = 2, 1
    del fields[-1], described.file[0].message_type[0].oneof_decl[-1]
    writer = Writer(str(path))
    writer.start()
    name = "adaptive_contact.ServoSample"
    schema = writer.register_schema(name, "protobuf", described.SerializeToString())
    channel = writer.register_channel(servo_key("rf"), "protobuf", schema)
    writer.add_message(channel, 1, protobuf_class(ServoSample)[1](sample(3)), 1)
    writer.finish()
    (record,) = read_recording(path)
    read = decode(record.payload, ServoSample, record.encoding)
    assert (read.t_ns, read.seq) == (3, 3 * TICK)
    assert read.measured == sample(3).measured


@pytest.mark.parametrize("error", [None, "no space"])
def test_a_field_that_is_none_comes_back_as_none(tmp_path: Path, error: str | None) -> None:
    """Also a struct, and a field without a default: statuses of the service have both."""
    state = StateFacts(folder="/a", restored=[], refused=[], saved=0, failed=1, error=error)
    written = [
        ServiceStatus(
            version="1", robot="r", period_s=0.02, baseline=None, legs={}, uptime_s=1.0, state=one
        )
        for one in (state, None)
    ]
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        for status in written:
            writer.write_message(SERVICE_STATUS, status, 1)
    records = list(read_recording(tmp_path / "a.mcap"))
    assert [decode(r.payload, ServiceStatus, r.encoding) for r in records] == written


def test_what_protobuf_cannot_say_keeps_its_bytes(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    odd = [
        encode(msgspec.structs.replace(sample(3), **change))
        for change in ({"valid": []}, {"t_ns": 2**63}, {"preview": []})
    ]
    with RecordingWriter(path) as writer:
        for payload in odd:
            writer.write(servo_key("rf"), payload, MSGPACK, 1)
    assert [record.payload for record in read_recording(path)] == odd


@pytest.mark.parametrize("descriptors", [b"", b"\xff\xff", b"\x0a\x03\x0a\x01a"])
def test_descriptors_that_are_none_cost_their_messages(tmp_path: Path, descriptors: bytes) -> None:
    path = tmp_path / "a.mcap"
    writer = Writer(str(path))
    writer.start()
    schema = writer.register_schema("adaptive_contact.ServoSample", "protobuf", descriptors)
    writer.add_message(writer.register_channel(servo_key("rf"), "protobuf", schema), 1, b"", 1)
    writer.finish()
    recording = read_recording(path)
    assert list(recording) == []
    assert recording.damage is not None


def test_truncation_at_every_byte_gives_a_prefix(tmp_path: Path) -> None:
    path, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    # A message each second: every chunk holds one or two, so that the file has several.
    with RecordingWriter(path) as writer:
        for k in range(6):
            writer.write_message(servo_key("rf"), sample(k), k * 1_000_000_000)
    whole = path.read_bytes()
    written = list(read_recording(path))
    counts = []
    for size in range(len(whole)):
        cut.write_bytes(whole[:size])
        if size < 8:
            with pytest.raises(RecordingError, match=r"is empty|is not a recording"):
                read_recording(cut)
            continue
        recording = read_recording(cut)
        got = list(recording)
        assert recording.damage is not None, size
        assert "\n" not in recording.damage
        assert f"the {len(got)} messages before it are intact" in recording.damage
        assert got == written[: len(got)]
        counts.append(len(got))
    assert counts == sorted(counts)
    assert set(counts) >= {0, 2, 4, 6}


def test_what_is_written_can_be_read_before_the_file_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for k in range(500):
            writer.write_message(servo_key("rf"), sample(k), k * TICK)
        open_file = read_recording(path)
        assert len(list(open_file)) > 500 - 2 * 51  # what a killed recorder leaves
        assert open_file.damage is not None


def is_part(got: list[Record], written: list[Record]) -> bool:
    """Whether all of ``got`` is among ``written``, in the same order."""
    rest = iter(written)
    return all(any(record == one for one in rest) for record in got)


def test_flipped_bytes_never_raise_and_never_invent(tmp_path: Path) -> None:
    path, bad = tmp_path / "a.mcap", tmp_path / "bad.mcap"
    with RecordingWriter(path) as writer:
        for k in range(8):
            writer.write_message(servo_key("rf"), sample(k), k * 500_000_000)
    whole = path.read_bytes()
    written = list(read_recording(path))
    with path.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    inside = [
        (one.chunk_start_offset + 9, one.chunk_start_offset + one.chunk_length) for one in chunks
    ]
    flips = (0x01, 0x02, 0x09, 0x80, 0xFF)
    for at in range(8, len(whole), 3):
        flip = flips[at % len(flips)]
        bad.write_bytes(whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :])
        recording = read_recording(bad)
        got = list(recording)
        assert is_part(got, written), (at, flip)
        assert recording.damage is not None or len(got) == len(written), (at, flip)
        if any(begin <= at < end for begin, end in inside):  # behind the length of a chunk
            assert len(got) >= len(written) - 3, (at, flip)  # a chunk holds at most three


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
@pytest.mark.parametrize("chunked", [True, False])
def test_files_of_other_writers(
    tmp_path: Path, compression: CompressionType, chunked: bool
) -> None:
    path = tmp_path / "other.mcap"
    writer = Writer(str(path), compression=compression, use_chunking=chunked)
    writer.start()
    channel = writer.register_channel("robot/leg/rf/servo", "json", 0)
    for k in range(20):
        writer.add_message(channel, k, b"{%d}" % k, k)
    writer.add_attachment(0, 0, "notes", "text/plain", b"ignored")
    writer.finish()
    recording = read_recording(path)
    assert [r.payload for r in recording] == [b"{%d}" % k for k in range(20)]
    assert {r.encoding for r in recording} == {JSON}
    assert recording.about == {}
    whole = path.read_bytes()
    path.write_bytes(whole[: 200 if chunked else whole.index(b"{13}")])
    cut = read_recording(path)
    assert len(list(cut)) == (0 if chunked else 13)  # a chunk that is cut is lost
    assert cut.damage is not None


def test_a_file_that_is_no_recording_is_one_line(tmp_path: Path) -> None:
    for name, content in {
        "text": b"hello world, not mcap",
        "empty": b"",
        "short": b"\x89MC",
    }.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(RecordingError) as caught:
            read_recording(path)
        assert str(path) in str(caught.value)
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(RecordingError, match="cannot be read"):
            read_recording(path)


def test_what_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written"):
        RecordingWriter(tmp_path / "no" / "folder.mcap")
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path)
    for time_ns in (-1, 2**64):
        with pytest.raises(RecordingError, match="does not fit"):
            writer.write("k", b"", MSGPACK, time_ns)
    writer.close()
    writer.close()
    with pytest.raises(RecordingError, match="already closed"):
        writer.write("k", b"", MSGPACK, 0)
    assert list(read_recording(path)) == []


def test_an_error_in_the_block_still_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with contextlib.suppress(ZeroDivisionError), RecordingWriter(path) as writer:
        writer.write("k", b"1", MSGPACK, 0)
        raise ZeroDivisionError
    recording = read_recording(path)
    assert len(list(recording)) == 1
    assert recording.damage is None


def test_a_ring_of_files_keeps_the_newest(tmp_path: Path) -> None:
    scene = Scene(shipped_robot("hexapod"))
    with SplitWriter(tmp_path / "walk.mcap", {"key": "robot/**"}, scene, 1.0, 2) as writer:
        for k in range(250):  # five seconds
            for leg in LEGS:
                writer.write(servo_key(leg), encode(sample(k)), MSGPACK, k * TICK, None)
    assert writer.paths == [tmp_path / "walk_3.mcap", tmp_path / "walk_4.mcap"]
    assert sorted(tmp_path.iterdir()) == writer.paths
    for number, path in enumerate(writer.paths, 3):
        recording = read_recording(path)
        times = [record.log_time_ns for record in recording]
        assert (min(times), max(times)) == (number * 50 * TICK, (number * 50 + 49) * TICK)
        assert len(times) == 50 * len(LEGS)
        assert recording.damage is None
        assert recording.about == {"key": "robot/**"}
        with path.open("rb") as file:  # each begins with the whole scene
            topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
        assert topics.count("/robot") == 1


# -- Recordings of strangers: random damage and chunks that unpack to gigabytes, in little me

LIMIT_BYTES = 600 << 20  # Python with numpy reserves 200 MB of addresses, a chunk takes 128 MB


def child(code: str, path: Path, which: int, limit: int) -> str:
    """What a process says that reads a file, with a limit of its own."""
    done = subprocess.run(
        [sys.executable, "-c", code, path],
        env={**os.environ, "TMPDIR": str(path.parent)},
        preexec_fn=lambda: resource.setrlimit(which, (limit, limit)),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


READ = """
import sys
from adaptive_contact.service.recording import read_recording
r = read_recording(sys.argv[1])
print(sum(1 for _ in r), r.damage)
"""
READ_A_BAG = '''
import resource, sys
from adaptive_contact.errors import RecordingError
from adaptive_contact.robot import parse_robot
from adaptive_contact.service.recording.bags import Bag
robot = parse_robot("""
    ros2 = {state = "/state"}
    robot = {name = "mini", period_s = 0.02, quantum_rad = 0.005}
    leg = [{id = "lf", joints = ["a"], ros2 = {joints = ["a"]}}]
""", source="test")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    bag = Bag(sys.argv[1], robot)
    print(len(list(bag)), bag.damage, bag.notes)
except RecordingError as error:
    print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10)
'''


def chunk(name: bytes, packed: bytes, size: int) -> bytes:
    head = struct.pack("<QQQII", 0, 0, size, 0, len(name)) + name + struct.pack("<Q", len(packed))
    return struct.pack("<BQ", 6, len(head) + len(packed)) + head + packed


@pytest.mark.parametrize("name", ["zstd", "lz4"])
@pytest.mark.parametrize("says", [1000, 60 << 20, 1 << 30])
def test_a_chunk_that_unpacks_to_gigabytes_is_stepped_over(
    tmp_path: Path, name: str, says: int
) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.write("k", b"one", "text/plain", 0)
    whole = path.read_bytes()
    at = whole.index(b"\x06", 8)  # of the first chunk
    block = bytes(1 << 20)
    if name == "zstd":
        packed = zeros()
    else:
        frame = lz4.frame.LZ4FrameCompressor()
        packed = frame.begin() + b"".join(frame.compress(block) for _ in range(2000))
        packed += frame.flush()
    path.write_bytes(whole[:at] + chunk(name.encode(), packed, says) + whole[at:])
    out = child(READ, path, resource.RLIMIT_AS, LIMIT_BYTES)
    assert out.startswith("1 1 damaged place"), out


def database(path: Path, columns: str = "", view: str = "", data: bytes = b"") -> None:
    """A db3 file of rosbag2 with two messages."""
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute(f"CREATE TABLE messages(id, topic_id, timestamp, {columns or 'data'})")
        file.execute(view or "CREATE TABLE topics(id, name, type)")
        if not view:
            file.execute("INSERT INTO topics VALUES (1, '/state', 'sensor_msgs/msg/JointState')")
        for k in (1, 2):
            file.execute("INSERT INTO messages(id, topic_id, timestamp) VALUES (?, 1, ?)", (k, k))
        if data:
            file.execute("UPDATE messages SET data = ?", (data,))
        file.commit()


def zeros() -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    block = bytes(1 << 20)
    return b"".join(packer.compress(block) for _ in range(2000)) + packer.flush()


ENDLESS = (
    "CREATE VIEW topics AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) "
    "SELECT x AS id, 'a' || x AS name, 'b' AS type FROM c"
)
BAG_BOMBS: dict[str, tuple[Callable[[Path], object], str]] = {
    "message.db3": (lambda path: database(path, data=zeros()), "a message is no"),
    "cells.db3": (lambda path: database(path, "data AS (zeroblob(900000000))"), "too big"),
    "view.db3": (lambda path: database(path, view=ENDLESS), "cannot be read as a bag"),
    "gz.db3": (lambda path: path.write_bytes(gzip.compress(bytes(1 << 28))), "is not a database"),
}


@pytest.mark.parametrize("name", BAG_BOMBS)
def test_a_bag_that_unpacks_to_gigabytes_does_not_fill_the_memory(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "bag").mkdir()
    make, says = BAG_BOMBS[name]
    make(tmp_path / "bag" / name)
    out = child(READ_A_BAG, tmp_path / "bag", resource.RLIMIT_FSIZE, 100 << 20)
    line, grown_mb = out.splitlines()
    assert says in line
    assert int(grown_mb) < 200
    assert list(tmp_path.iterdir()) == [tmp_path / "bag"]
