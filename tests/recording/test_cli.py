"""The commands record, replay and score, as a person runs them."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.service.link import Link
from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.wire import (
    JSON,
    MSGPACK,
    ContactEvent,
    ContactTruth,
    ServoSample,
    contact_key,
    encode,
    servo_key,
    truth_key,
)
from programs import succeeded
from stepping import step
from waiting import until

MS = 1_000_000
TICK = 20 * MS
WAIT_S = 30.0


def printed(*words: object) -> str:
    """Standard output of a command that succeeds; raises what it raises."""
    return str(succeeded(*words).stdout)


def event(at_ns: int) -> ContactEvent:
    return ContactEvent(
        leg="rf",
        t_ns=at_ns,
        seq=at_ns // TICK,
        onset_ns=at_ns - 10 * MS,
        contact=True,
        status="valid",
        score=2.0,
        residual=[0.0, 0.0, 0.0],
        model_version=1,
    )


def write_walk(path: Path, *, swings: int = 4, with_truth: bool = True) -> None:
    """One leg, 40 ticks a step, 30 of them swing; a touch 500 ms into each swing."""
    with RecordingWriter(path, about={"scenario": "test"}) as writer:
        if with_truth:
            writer.write_message(truth_key("rf"), ContactTruth(t_ns=0, contact=False, force=0.0), 0)
        for k in range(40 * swings):
            phase = k % 40
            angles, word = step(k)
            sample = ServoSample(
                t_ns=k * TICK,
                seq=k,
                measured=angles,
                desired=angles,
                phase=word,
                run=1,
            )
            writer.write_message(servo_key("rf"), sample, k * TICK)
            if with_truth and phase in (25, 38):
                change = ContactTruth(
                    t_ns=k * TICK, contact=phase == 25, force=2.0, speed_m_s=0.3, surface="hard"
                )
                writer.write_message(truth_key("rf"), change, k * TICK)
            if with_truth and phase == 26:
                writer.write_message(contact_key("rf"), event(k * TICK), k * TICK)


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    write_walk(path)
    return path


def test_a_score_is_a_table_or_json(walk: Path) -> None:
    assert "100.0 %" in printed("score", walk)
    text = json.loads(printed("score", walk, "--json"))
    assert text["recording"] == str(walk)
    assert text["truncated"] is False
    assert text["rows"]["headline"]["found"] == 4
    assert text["rows"]["headline"]["latency_median_ms"] == 20.0
    assert text["false_alarms"] == 0
    assert json.loads(printed("score", walk, "--json", "--from", "0.8"))["swings"] == 3


def test_the_description_of_another_robot_is_refused(walk: Path, tmp_path: Path) -> None:
    other = tmp_path / "robot.toml"
    other.write_text(
        '[robot]\nname = "dog"\nperiod_s = 0.02\nquantum_rad = 0.001\n'
        '[[leg]]\nid = "fl"\njoints = ["hip", "thigh", "calf"]\n'
    )
    for words in (["score", walk], ["replay", walk, "--events", tmp_path / "events.jsonl"]):
        with pytest.raises(RecordingError, match=r"not those of robot 'dog' \(fl\); give the"):
            printed(*words, "--config", other)
    assert not (tmp_path / "events.jsonl").exists()


def test_events_of_a_file_are_scored(walk: Path, tmp_path: Path) -> None:
    events = tmp_path / "events.jsonl"
    lines = [encode(event(at_ms * MS), JSON).decode() for at_ms in (540, 900)]
    events.write_text("\n".join(lines) + "\n\n")
    text = json.loads(printed("score", walk, "--events", events, "--json"))
    assert text["rows"]["headline"]["found"] == 1
    assert text["false_alarms"] == 1
    events.write_text("")
    assert json.loads(printed("score", walk, "--events", events, "--json"))["detections"] == 0


@pytest.mark.parametrize(
    ("make", "command", "arguments", "word"),
    [
        (lambda p: write_walk(p, with_truth=False), "score", [], "no truth"),
        (lambda p: p.write_bytes(b"hello, world"), "score", [], "is not a recording"),
        (lambda p: None, "score", [], "cannot be read"),
        (write_walk, "score", ["--events", "nowhere.jsonl"], "nowhere.jsonl: cannot be read"),
        (lambda p: write_walk(p, swings=0), "replay", ["--events", "-"], "no servo sample"),
    ],
)
def test_what_is_wrong_with_a_recording_is_one_line(
    tmp_path: Path, make: Callable[[Path], Any], command: str, arguments: list[str], word: str
) -> None:
    path = tmp_path / "a.mcap"
    make(path)
    with pytest.raises(RecordingError, match=word) as caught:
        printed(command, path, *arguments)
    assert str(caught.value).count(str(path)) <= 1


GOOD = encode(event(5 * TICK), JSON) + b"\n"


@pytest.mark.parametrize(
    ("lines", "size", "words"),
    [
        (GOOD + b'{"v":1,"leg":"rf"}\n', None, "line 2: not a contact event"),
        # A hole, of more bytes than any memory has: of a line without end little is read.
        (b"", 1 << 40, r"line 1: not a contact event .more than"),
        (4 * GOOD, None, "more than 3 lines"),
    ],
)
def test_a_file_of_other_lines_than_events_is_refused(
    walk: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lines: bytes,
    size: int | None,
    words: str,
) -> None:
    monkeypatch.setattr("adaptive_contact.cli.score._MOST_LINES", 3)
    events = tmp_path / "events.jsonl"
    events.write_bytes(3 * GOOD)
    printed("score", walk, "--events", events)
    events.write_bytes(lines)
    os.truncate(events, size or len(lines))
    with pytest.raises(RecordingError, match=words):
        printed("score", walk, "--events", events)


@pytest.mark.parametrize(
    ("command", "options", "words"),
    [
        ("score", ["--from", "2", "--to", "1"], "is not before"),
        ("replay", ["--events", "-", "--speed", "max", "--all"], "--speed and --all"),
        ("replay", ["--baseline", "x"], "--baseline is for --events"),
        ("replay", ["--events", "no/out.jsonl"], "cannot be written"),
        ("replay", ["--plot", "plot.pdf"], r"ends with \.html"),
        *(
            ("replay", ["--speed", speed], "expected a factor above 0")
            for speed in ("0", "-1", "nan", "inf", "fast", "", "1e9")
        ),
    ],
)
def test_options_that_cannot_be_are_refused(
    walk: Path, command: str, options: list[str], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        printed(command, walk, *options)


def publish_until_file_grows(router: Link, path: Path) -> int:
    """Publish samples until some are written out; how many were put."""
    publisher, size, count = (
        router.publisher(servo_key("rf")),
        path.stat().st_size,
        itertools.count(),
    )

    def grown() -> bool:
        publisher.put_raw(b"sample %06d" % next(count), MSGPACK)
        return path.stat().st_size > size

    until(grown)
    return next(count)


@pytest.mark.e2e
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_record_ends_cleanly_on_a_signal(
    router: Link, cli: Any, tmp_path: Path, number: signal.Signals
) -> None:
    path = tmp_path / "a.mcap"
    recorder = cli("record", path, "--connect", router.endpoints[0])
    recorder.wait_line(r"recording robot/\*\*")
    count = publish_until_file_grows(router, path)
    assert recorder.stop(number) == 0, recorder.lines
    recording = read_recording(path)
    records = list(recording)
    assert recording.damage is None
    # The first may have been put before the subscription was known to the router.
    assert count - 50 <= len(records) <= count
    assert [r.payload for r in records] == sorted(r.payload for r in records)
    assert {r.key for r in records} == {"robot/leg/rf/servo"}
    assert all(abs(r.log_time_ns - time.time_ns()) < 120e9 for r in records)
    recorder.wait_line(f"{len(records)} messages of 1 keys")
    assert recording.about["key"] == "robot/**"


@pytest.mark.e2e
def test_encodings_and_keys_that_zenoh_cannot_send_are_counted(
    router: Link, cli: Any, tmp_path: Path
) -> None:
    """Zenoh 1.10 panics at an encoding of 256 letters and a key of 65,536; 255 arrive."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        writer.write("robot/" + "k" * 70_000, b"{}", MSGPACK, 0)
        for k, length in enumerate((1, 254, 255, 256, 257, 400, 70_000)):
            writer.write("robot/leg/rf/servo", b"{}", "x" * length, k)
            writer.write("robot/leg/rf/servo", b"{}", "é" * (length // 2), k)
    arrived: list[int] = []
    router.subscribe(servo_key("*"), lambda got: arrived.append(len(got.encoding.encode())))
    player = cli(
        "replay", path, "--connect", router.endpoints[0], "--speed", "max", "--all", "--keep-run"
    )
    assert player.wait() == 0
    player.wait_line("malformed 9")
    assert not [line for line in player.lines if "panic" in line]
    until(lambda: len(arrived) == 6)
    assert sorted(n for n in arrived if n > 100) == [254, 254, 254, 255]


@pytest.mark.parametrize("command", ["replay", "score", "fit"])
def test_a_recording_from_a_fifo_is_refused_in_a_line(
    command: str, walk: Path, tmp_path: Path
) -> None:
    """What cannot be read twice: a pipe, a process substitution."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    options = {"replay": ["--events", "-"], "score": [], "fit": ["-o", tmp_path / "out.json"]}
    words = [command, fifo, *options[command]]
    process = subprocess.Popen(
        [sys.executable, "-m", "adaptive_contact", *map(str, words)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with contextlib.suppress(BrokenPipeError):
        fifo.write_bytes(walk.read_bytes())  # waits until it is opened for reading
    out, said = process.communicate(timeout=WAIT_S)
    assert process.returncode == 2
    assert out == ""
    last = said.splitlines()[-1]
    assert last.startswith(f"adaptive-contact: {fifo}: cannot be read twice; expected an MCAP file")
    assert "Traceback" not in said
    assert not (tmp_path / "out.json").exists()
