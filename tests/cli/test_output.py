"""Streams that cannot be written, buffered or not, and files that are there: real processes."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from programs import commands
from waiting import until

FULL = Path("/dev/full")
SOURCES = os.pathsep.join(path for path in sys.path if path)
BUFFERED = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"} | {
    "PYTHONPATH": SOURCES
}
ENVIRONMENTS = {"buffered": BUFFERED, "unbuffered": BUFFERED | {"PYTHONUNBUFFERED": "1"}}
OURS = (sys.executable, "-m", "adaptive_contact")
DISK = (
    "adaptive-contact: the output cannot be written (No space left on device); make room, or send "
    "it elsewhere\n"
)

needs_full = pytest.mark.skipif(not FULL.exists(), reason="no device that is always full")
each_environment = pytest.mark.parametrize(
    "env",
    [
        pytest.param(ENVIRONMENTS["buffered"], id="buffered"),
        pytest.param(ENVIRONMENTS["unbuffered"], id="unbuffered", marks=pytest.mark.slow),
    ],
)
# One that prints with typer, one with rich, and one that is the help.
each_printer = pytest.mark.parametrize(
    "words", [["sim", "list", "--json"], ["sim", "list"], ["--help"]], ids=" ".join
)


def ran(*words: str, env: dict[str, str] = BUFFERED, **streams: object) -> tuple[int, str]:
    """Exit code and standard error of a command of ours."""
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, **streams}
    done = subprocess.run([*OURS, *words], env=env, text=True, timeout=600, check=False, **options)  # type: ignore[call-overload]
    return done.returncode, done.stderr or ""


@contextlib.contextmanager
def nobody_reads() -> Iterator[int]:
    """The end of a pipe to write into, whose reader is gone."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        yield writer
    finally:
        os.close(writer)


@needs_full
@each_environment
@each_printer
def test_a_full_disk_is_one_line_and_code_2(words: list[str], env: dict[str, str]) -> None:
    with FULL.open("w") as full:
        assert ran(*words, env=env, stdout=full) == (2, DISK)


@each_environment
@each_printer
def test_a_reader_that_is_gone_is_code_141(words: list[str], env: dict[str, str]) -> None:
    with nobody_reads() as pipe:
        assert ran(*words, env=env, stdout=pipe) == (141, "")


def closed(*numbers: int) -> str:
    """A shell that runs a command of ours with file descriptors closed."""
    shut = " ".join(f"{number}>&-" for number in numbers)
    return f'exec "$0" -m adaptive_contact "$@" {shut}'


@pytest.mark.parametrize("numbers", [(1,), (2,), (0, 1, 2)])
def test_streams_closed_by_the_caller_are_not_missed(
    numbers: tuple[int, ...], tmp_path: Path
) -> None:
    """A file opened later does not get their numbers: what is printed would go into it."""
    out = tmp_path / "robot.toml"
    words = ["robot", "init", "--help"]
    done = subprocess.run(
        ["sh", "-c", closed(*numbers), sys.executable, *words],
        env=BUFFERED,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        timeout=600,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert not out.exists()
    script = (
        "import os, sys\n"
        "from adaptive_contact.cli._output import protect_output\n"
        "protect_output()\n"
        f"assert all(os.fstat(number) for number in {numbers})\n"
        f"with open({str(out)!r}, 'w') as file:\n"
        "    assert file.fileno() > 2\n"
        "    print('a line', flush=True)\n"
        "    print('a line', file=sys.stderr)\n"
    )
    shell = closed(*numbers).replace("-m adaptive_contact", "-c")
    done = subprocess.run(
        ["sh", "-c", shell, sys.executable, script], env=BUFFERED, timeout=600, check=False
    )
    assert done.returncode == 0
    assert out.read_text() == ""


@needs_full
@each_environment
@pytest.mark.parametrize(
    ("words", "code"),
    [(["sim", "list"], 0), (["nosuch"], 2), (["score", "nosuch.mcap"], 2), (["sim"], 2)],
)
def test_an_error_that_cannot_be_said_keeps_its_code(
    words: list[str], code: int, env: dict[str, str]
) -> None:
    with FULL.open("w") as full, nobody_reads() as pipe:
        assert ran(*words, env=env, stderr=full) == (code, "")
        assert ran(*words, env=env, stderr=pipe) == (code, "")


def broken(raises: str, **streams: object) -> subprocess.CompletedProcess[str]:
    """A command that prints and then raises."""
    code = (
        "import errno\n"
        "import adaptive_contact.cli.main as cli\n"
        "def broken(*_, **__):\n"
        "    print('half a table')\n"
        f"    raise {raises}\n"
        "cli.load_commands, cli.app = (lambda asked: None), broken\n"
        "cli.main()"
    )
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=BUFFERED, text=True, timeout=600, check=False, **given)  # type: ignore[call-overload,no-any-return]


@needs_full
def test_an_unexpected_fault_keeps_its_code() -> None:
    with FULL.open("w") as full:
        done = broken("ValueError('a fault')", stdout=full)
    assert done.returncode == 1
    assert done.stderr.rstrip().endswith("ValueError: a fault")


def test_a_file_on_a_full_disk_is_named() -> None:
    """It is not standard output that has no room."""
    done = broken("OSError(errno.ENOSPC, 'No space left on device', 'a.json')")
    says = "adaptive-contact: a.json cannot be written (No space left on device); make room\n"
    assert (done.returncode, done.stderr) == (2, says)


@needs_full
@each_environment
def test_a_command_that_runs_until_it_is_stopped_loses_its_lines(
    env: dict[str, str], tmp_path: Path
) -> None:
    """Its exit code is that of its work: here a virtual bus, which prints once it runs."""
    for stop in (signal.SIGINT, signal.SIGTERM):
        folder = tmp_path / stop.name
        with FULL.open("w") as full:
            process = subprocess.Popen(
                [*OURS, "bridge", "virtual", "--dir", str(folder), "--ports", "1"],
                env=env,
                stdout=full,
                stderr=full,
            )
        try:
            until((folder / "port0").is_symlink)
            process.send_signal(stop)
            assert process.wait(60) == 0
        finally:
            process.kill()
            process.wait(60)


@pytest.mark.parametrize("errors", ["", ":strict", ":surrogateescape"])
def test_letters_that_the_locale_lacks_are_escaped(errors: str) -> None:
    """A robot's name ends no command, and JSON stays JSON."""
    script = (
        "from adaptive_contact.cli._output import print_json, print_line, print_note\n"
        "from adaptive_contact.cli._output import protect_output\n"
        "protect_output()\n"
        "print_line('k\\u00e4fer \\u5de6')\n"
        "print_note('k\\u00e4fer')\n"
        'print_json(\'{"robot":"k\\u00e4fer \\U0001f916"}\')\n'
    )
    env = {**BUFFERED, "PYTHONIOENCODING": f"ascii{errors}", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=env, capture_output=True, timeout=600, check=False
    )
    assert done.stderr == b"adaptive-contact: k\\xe4fer\n"
    line, told = done.stdout.splitlines()
    assert line == b"k\\xe4fer \\u5de6"
    assert json.loads(told) == {"robot": "k\u00e4fer \U0001f916"}
    assert done.returncode == 0


# -- No command writes over a file that is there, unless --force says so

KEPT = b"somebody's work"
# Each option that names what a command writes: by its command, words around the file.
WRITTEN: dict[tuple[str, ...], tuple[str, ...]] = {
    ("record", "file"): ("FILE",),
    ("replay", "events"): ("in.mcap", "--events", "FILE"),
    ("replay", "plot"): ("in.mcap", "--plot", "FILE"),
    ("export", "out"): ("in.mcap", "--to", "mcap", "-o", "FILE"),
    ("fit", "out"): ("in.mcap", "-o", "FILE"),
    ("sim", "pose", "record"): ("--offline", "--seconds", "1", "--record", "FILE"),
    ("sim", "compare", "picture"): ("--picture", "FILE"),
    ("sim", "pose", "render"): ("--offline", "--seconds", "1", "--render", "FILE"),
    ("sim", "walk", "record"): ("--offline", "--seconds", "1", "--record", "FILE"),
    ("sim", "walk", "render"): ("--offline", "--seconds", "1", "--render", "FILE"),
    ("sim", "baseline", "out"): ("--out", "FILE"),
    ("bridge", "virtual", "write_config"): ("--write-config", "FILE"),
    ("bridge", "virtual", "record"): ("--scenario", "walk", "--record", "FILE"),
    ("bridge", "virtual", "directory"): ("--dir", "FOLDER/port0"),
    ("robot", "init", "out"): ("--legs", "l", "--joints", "2", "--out", "FILE"),
    ("robot", "check", "picture"): ("--picture", "FILE"),
    ("robot", "learn", "out"): ("--out", "FILE"),
    ("robot", "learn", "recording"): ("--recording", "FILE"),
    ("demo", "out"): ("--out", "FOLDER/summary.json"),
    ("bench", "out"): ("--out", "FOLDER/bench.json"),
    ("paper", "docs"): ("--docs", "FILE"),
    ("scenarios", "report", "docs"): ("--docs", "FOLDER/adaptation.md"),
}
# What commands read, folders of the studies, in which the same command goes on, and the folder in
# which the live page makes files of new names.
OTHERS = {
    *(
        "baseline",
        "zenoh_config",
        "ros_zenoh_config",
        "state",
        "scenario",
        "urdf",
        "more",
        "device",
        "record_to",
    ),
    *(("replay", "file"), ("export", "file"), ("score", "events"), ("fit", "recordings")),
    *(("export", "events"), ("score", "recording")),
    *(("paper", "out"), ("scenarios", "run", "out"), ("scenarios", "report", "out")),
    ("sim", "compare", "out"),
}


@pytest.fixture(autouse=True)
def _in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("where", WRITTEN, ids=" ".join)
def test_a_file_that_is_there_is_kept(where: tuple[str, ...], tmp_path: Path, ours: Any) -> None:
    file = Path("out.png")
    words = list(WRITTEN[where])
    for k, word in enumerate(words):
        if word.startswith("FOLDER/"):
            file, words[k] = Path("folder", Path(word).name), "folder"
            file.parent.mkdir()
    file.write_bytes(KEPT)
    words = [str(file) if word == "FILE" else word for word in words]
    code, _, line = ours(*where[:-1], *words)
    assert code == 2
    assert re.fullmatch(rf"adaptive-contact: \S*{file} exists already.*\n", line)
    assert file.read_bytes() == KEPT
    assert [p for p in tmp_path.rglob("[!.]*") if p.is_file()] == [tmp_path / file]


def test_every_option_that_names_a_file_is_looked_at() -> None:
    found = {
        (*words, option.name)
        for words, command in commands()
        for option in command.params
        if re.search("FILE|DIR|FOLDER|OUT|PATH$|RECORD|MCAP", str(option.metavar))
    }
    assert {one for one in found if one not in OTHERS and one[-1] not in OTHERS} == {*WRITTEN}


def test_a_picture_is_what_its_name_says(ours: Any) -> None:
    code, _, line = ours("sim", "compare", "--picture", "walks.svg")
    assert (code, line) == (
        2,
        "adaptive-contact: --picture walks.svg: expected a name that ends with .png\n",
    )


def test_force_replaces(ours: Any) -> None:
    file = Path("walk.mcap")
    file.write_bytes(KEPT)
    words = ("sim", "walk", "--offline", "--seconds", "0.1", "--record", "walk.mcap")
    assert ours(*words, "--force")[::2] == (0, "")
    recorded = file.read_bytes()
    assert recorded != KEPT
    code, _, line = ours("replay", "walk.mcap", "--events", "walk.mcap", "--force")
    assert (code, "what the command reads" in line) == (2, True)
    code, _, line = ours("replay", "walk.mcap", "--events", "x", "--plot", "x")
    assert (code, "given twice" in line) == (2, True)
    assert file.read_bytes() == recorded


def test_what_stands_in_a_usual_folder_is_made_again(ours: Any) -> None:
    """A study that is refused for another reason shows that its files were none."""
    for name in ("out/demo/summary.json", "docs/adaptation.md"):
        Path(name).parent.mkdir(parents=True)
        Path(name).write_bytes(KEPT)
    assert "expected 8 to 3600 s" in ours("demo", "--seconds", "1").err
    assert "no results there" in ours("scenarios", "report").err
    assert "exists already" in ours("scenarios", "report", "--docs", "./docs/../docs").err
