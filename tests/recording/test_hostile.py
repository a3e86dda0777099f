"""Recordings of strangers: random damage and chunks that unpack to gigabytes, in little memory."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import os
import resource
import sqlite3
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.wire import MSGPACK, ServoSample, encode, servo_key

LIMIT_BYTES = 600 << 20  # Python with numpy reserves 200 MB of addresses, a chunk takes 128 MB


def limited() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))


def read_in_a_child(path: Path) -> str:
    code = (
        "import sys\n"
        "from adaptive_contact.service.recording import read_recording\n"
        "r = read_recording(sys.argv[1])\n"
        "print(sum(1 for _ in r), r.damage)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, path],
        preexec_fn=limited,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


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
    out = read_in_a_child(path)
    assert out.startswith("1 1 damaged place"), out


def peak_mb(*args: str) -> tuple[float, int, str]:
    """Runs a command; its largest resident memory, its exit code, and what it said on stderr."""
    with subprocess.Popen(
        [sys.executable, "-m", "adaptive_contact", *args],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        said = process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    return usage.ru_maxrss / 1024, process.returncode, said


@pytest.mark.e2e
@pytest.mark.parametrize("command", ["replay", "score", "fit"])
def test_commands_take_little_memory_for_a_chunk_that_unpacks_to_gigabytes(
    tmp_path: Path, command: str
) -> None:
    """62 kB that unpack to 2 GB, in a recording of a leg; against the same recording without."""
    path, bomb = tmp_path / "a.mcap", tmp_path / "bomb.mcap"
    with RecordingWriter(path) as writer:
        for seq in range(200):
            sample = ServoSample(
                t_ns=seq * 20_000_000, seq=seq, measured=[0.0, 0.1, 0.2], desired=[0.0, 0.1, 0.2]
            )
            writer.write(servo_key("rf"), encode(sample), MSGPACK, seq * 20_000_000)
    whole = path.read_bytes()
    at = whole.index(b"\x06", 8)  # of the first chunk
    bomb.write_bytes(whole[:at] + chunk(b"zstd", zeros(), 1000) + whole[at:])
    out = tmp_path / "out.jsonl"
    options = {
        "replay": ("--events", str(out)),
        "score": ("--json",),
        "fit": ("--out", str(out)),
    }[command]
    without, code, _ = peak_mb(command, str(path), *options)
    out.unlink(missing_ok=True)
    with_it, same, said = peak_mb(command, str(bomb), *options)
    assert same == code, said
    assert "damaged" in said
    assert "Traceback" not in said
    # A chunk may unpack to 64 MB, beside what was unpacked before.
    assert with_it < without + 200, (with_it, without)


def test_random_flips_and_cuts_cost_only_what_they_hit(tmp_path: Path) -> None:
    path, bad = tmp_path / "a.mcap", tmp_path / "bad.mcap"
    rng = np.random.default_rng(28)
    with RecordingWriter(path) as writer:
        for k in range(400):  # 40 chunks of ten
            payload = rng.bytes(50)
            writer.write(
                f"k{k % 3}", payload + struct.pack("<I", zlib.crc32(payload)), "", k * 10**8
            )
    whole = path.read_bytes()
    count = len(list(read_recording(path)))
    assert count == 400
    for flips in (1, 1, 1, 3, 10) * 40:
        data = bytearray(whole)
        for at in rng.integers(8, len(data), flips):
            data[at] ^= 1 << int(rng.integers(8))
        cut = int(rng.integers(8, len(data))) if rng.random() < 0.3 else len(data)
        bad.write_bytes(data[:cut])
        recording = read_recording(bad)
        got = list(recording)
        assert all(
            zlib.crc32(r.payload[:-4]) == struct.unpack("<I", r.payload[-4:])[0] for r in got
        )
        assert len({r.log_time_ns for r in got}) == len(got)
        assert recording.truncated or len(got) == count
        if cut == len(data) and flips == 1:  # more may hit the channels and their copy
            assert len(got) >= count - 12, recording.damage


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
    "x.db3.zstd": (lambda path: path.write_bytes(zeros()), "unpacks to more than 64 MB"),
    "x.mcap.zstd": (lambda path: path.write_bytes(zeros()), "unpacks to more than 64 MB"),
    "message.db3": (lambda path: database(path, data=zeros()), "a message is no"),
    "cells.db3": (lambda path: database(path, "data AS (zeroblob(900000000))"), "too big"),
    "view.db3": (lambda path: database(path, view=ENDLESS), "cannot be read as a bag"),
    "gz.db3": (lambda path: path.write_bytes(gzip.compress(bytes(1 << 28))), "is not a database"),
    "bz2.mcap.zstd": (lambda path: path.write_bytes(bz2.compress(bytes(1 << 28))), "be unpacked"),
}
READ_A_BAG = """
import resource, sys
from pathlib import Path
from adaptive_contact.errors import RecordingError
from adaptive_contact.robot import parse_robot
from adaptive_contact.service.recording.bags import Bag
robot = parse_robot('''
    ros2 = {state = "/state"}
    robot = {name = "mini", period_s = 0.02, quantum_rad = 0.005}
    leg = [{id = "lf", joints = ["a"], ros2 = {joints = ["a"]}}]
''', source="test")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    bag = Bag(sys.argv[1], robot)
    print(len(list(bag)), bag.damage, bag.notes)
except RecordingError as error:
    print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10)
"""


@pytest.mark.parametrize("name", BAG_BOMBS)
def test_a_bag_that_unpacks_to_gigabytes_fills_neither_memory_nor_disk(
    tmp_path: Path, name: str
) -> None:
    pytest.importorskip("rosbags", reason="needs the extra 'ros2' (rosbags)")
    (tmp_path / "bag").mkdir()
    (tmp_path / "tmp").mkdir()
    make, says = BAG_BOMBS[name]
    make(tmp_path / "bag" / name)
    done = subprocess.run(
        [sys.executable, "-c", READ_A_BAG, tmp_path / "bag"],
        env={**os.environ, "TMPDIR": str(tmp_path / "tmp")},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100 << 20, 100 << 20)),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    line, grown_mb = done.stdout.splitlines()
    assert says in line
    assert int(grown_mb) < 200
    assert list((tmp_path / "tmp").iterdir()) == []
