"""Recordings of strangers: random damage and chunks that unpack to gigabytes, in little memory."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from adaptive_contact.service.recording import RecordingWriter, read_recording

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
        timeout=120,
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
        packer = zstandard.ZstdCompressor().compressobj()
        packed = b"".join(packer.compress(block) for _ in range(2000)) + packer.flush()
    else:
        frame = lz4.frame.LZ4FrameCompressor()
        packed = frame.begin() + b"".join(frame.compress(block) for _ in range(2000))
        packed += frame.flush()
    path.write_bytes(whole[:at] + chunk(name.encode(), packed, says) + whole[at:])
    out = read_in_a_child(path)
    assert out.startswith("1 1 damaged place"), out


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
