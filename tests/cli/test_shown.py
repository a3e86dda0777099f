"""Control characters of the wire, of files and of the command line: shown by every command."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from adaptive_contact.cli import doctor
from adaptive_contact.service.doctor import Examination, diagnose
from adaptive_contact.service.recording import RecordingWriter
from adaptive_contact.wire import JSON, MSGPACK, ContactTruth, ServoSample, encode
from adaptive_contact.wire.received import Received

# What a terminal obeys, and what misleads its reader; line feeds are the commands' own.
UNSAFE: Final = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069]")
# Every kind of it, and what rich would take for markup.
HOSTILE: Final = (
    "\x1b[31m\x1b]0;t\x07\x9b2J\x00\x08\r\nall is well\u202e\u2028\x7f[bold]x[/bold][/]"
)
TYPED: Final = HOSTILE.replace("\x00", "")  # no command line has a zero


@pytest.fixture
def errors_are_a_line() -> None:
    """What is typed here has line feeds; how it is printed is looked at."""


@pytest.fixture
def run(ours: Callable[..., Any]) -> Callable[..., str]:
    """Run a command in this process, and return what it says."""
    return lambda *words: "".join(ours(*words)[1:])


def _sample(k: int, **fields: Any) -> bytes:
    angles = [0.1, 0.2 + 0.001 * k, 0.3]
    sample = ServoSample(t_ns=20_000_000 * k, seq=k, measured=angles, desired=angles)
    return msgpack.packb(msgpack.unpackb(encode(sample)) | fields)


def _recording(path: Path, text: str) -> Path:
    """A leg's stream whose every free text is hostile, and keys and encodings around it."""
    with RecordingWriter(path, about={"scenario": text, "key": text}) as writer:
        for k in range(30):
            writer.write("robot/leg/rf/servo", _sample(k), MSGPACK, k)
        for k, fields in enumerate([{"v": text}, {"phase": text}, {text: 1, "t_ns": text}]):
            writer.write("robot/leg/rf/servo", _sample(40 + k, **fields), MSGPACK, 40 + k)
        writer.write_message(
            "robot/leg/rf/truth", ContactTruth(t_ns=0, contact=False, force=0.0), 50
        )
        writer.write(f"robot/leg/{text}/servo", _sample(1), MSGPACK, 60)
        writer.write(f"robot/legs/rf/{text}servo", _sample(1), MSGPACK, 60)
        writer.write(f"{text}/robot/leg/rf/servo", _sample(1), MSGPACK, 60)
        writer.write(f"rf/servo{text}", _sample(1), text, 60)
        writer.write("robot/leg/rf/learner", msgpack.packb({"v": text, "note": text}), text, 70)
    return path


def _named(name: str) -> str:
    """A robot.toml that says as little as it may, with a name, escaped as TOML does."""
    leg = '[[leg]]\nid = "rf"\njoints = ["a", "b", "c"]\n'
    return f"[robot]\nname = {json.dumps(name)}\nperiod_s = 0.02\nquantum_rad = 0.005\n{leg}"


@pytest.mark.parametrize(
    "words",
    [
        ["score", "REC"],
        ["score", "REC", "--json"],
        ["score", "REC", "--events", "EVENTS"],
        ["score", "REC", "--config", "TOML"],
        ["fit", "REC", "-o", "OUT"],
        ["fit", "REC", "--config", "TOML", "-o", "OUT"],
        ["replay", "REC", "--events", "OUT"],
        ["replay", "REC", "--events", "OUT", "--config", "TOML"],
        ["replay", "REC", "--events", "OUT", "--baseline", "BASE"],
        ["state", "show", "--state", "STATE"],
        ["state", "reset", "--state", "STATE", "--leg", TYPED],
        ["bridge", "dynamixel", "--config", "TOML"],
        ["robot", "check", "--config", "TOML"],
        ["doctor", "--namespace", TYPED],
        ["doctor", "--connect", TYPED],
        ["watch", "--connect", TYPED],
        ["record", "x.mcap", "--key", "a//" + TYPED],
        ["sim", "walk", "--scenario", TYPED],
        ["sim", "inject", TYPED],
        ["demo", "--seconds", TYPED],
        ["scenarios", "run", TYPED],
        [TYPED],
        ["score", TYPED],
        ["fit", TYPED],
    ],
    ids=lambda words: " ".join(w for w in words if w != TYPED),
)
def test_no_command_sends_what_others_wrote(
    words: list[str], run: Callable[..., str], tmp_path: Path
) -> None:
    state = tmp_path / "state" / "robot"
    state.mkdir(parents=True)
    (state / "rf.state").write_bytes(b"none")
    (state / "a\x1b[31mb.state").write_bytes(b"none")
    files = {
        "REC": _recording(tmp_path / "a.mcap", HOSTILE),
        "EVENTS": tmp_path / "events.jsonl",
        "TOML": tmp_path / "robot\x1b[31m.toml",
        "BASE": tmp_path / "base.json",
        "STATE": tmp_path / "state",
        "OUT": tmp_path / "out",
    }
    files["EVENTS"].write_text(json.dumps({"v": HOSTILE}) + "\n", encoding="utf-8")
    files["TOML"].write_text(_named(HOSTILE), encoding="utf-8")
    files["BASE"].write_text(json.dumps({"format": HOSTILE, HOSTILE: 1}), encoding="utf-8")
    said = run(*(files.get(word, word) for word in words))
    assert said
    assert not UNSAFE.search(said), repr(said)
    assert "\nall is well" not in said


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(text=st.text(min_size=1, max_size=20))
def test_doctor_sends_nothing_of_the_wire(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    heard = Examination()
    text = text.encode("utf-8", "replace").decode()
    for key in (
        f"robot/leg/{text}/servo",
        f"robot/legs/{text}/servo",
        f"{text}/robot/leg/rf/servo",
    ):
        for encoding in (MSGPACK, JSON, text):
            for payload in (_sample(1), _sample(1, v=text), text.encode()):
                heard.process_message(Received(key, payload, encoding, 0, None))
    diagnosis = diagnose(heard, 3.0, alive=False)
    doctor.print_diagnosis(diagnosis)
    said = capsys.readouterr().out
    assert "no service" in said
    assert not UNSAFE.search(said), repr(said)


def test_a_robot_s_name_is_shown_as_written(run: Callable[..., str], tmp_path: Path) -> None:
    """What rich would take for markup is text."""
    path = tmp_path / "robot.toml"
    path.write_text(_named("[bold]x[/bold]"), encoding="utf-8")
    assert "[bold]x[/bold]" in run(
        "fit", _recording(tmp_path / "a.mcap", "x"), "--config", path, "-o", tmp_path / "out"
    )
