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
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from adaptive_contact.service.recording import RecordingWriter

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
