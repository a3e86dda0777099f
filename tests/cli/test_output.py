"""Standard streams that cannot be written: real processes, buffered as on any machine, or not."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

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


@needs_full
def test_an_unexpected_fault_keeps_its_code() -> None:
    code = (
        "import adaptive_contact.cli.main as cli\n"
        "def broken(*_, **__):\n"
        "    print('half a table')\n"
        "    raise ValueError('a fault')\n"
        "cli.load_commands, cli.app = (lambda asked: None), broken\n"
        "cli.main()"
    )
    with FULL.open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=BUFFERED,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=600,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.rstrip().endswith("ValueError: a fault")


def test_a_file_on_a_full_disk_is_named() -> None:
    """It is not standard output that has no room."""
    code = (
        "import errno\n"
        "import adaptive_contact.cli.main as cli\n"
        "def broken(*_, **__): raise OSError(errno.ENOSPC, 'No space left on device', 'a.json')\n"
        "cli.load_commands, cli.app = (lambda asked: None), broken\n"
        "cli.main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=BUFFERED,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    says = "adaptive-contact: a.json cannot be written (No space left on device); make room\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", says)


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
        "from adaptive_contact.cli._output import protect_output, say, say_json, say_note\n"
        "protect_output()\n"
        "say('k\\u00e4fer \\u5de6')\n"
        "say_note('k\\u00e4fer')\n"
        'say_json(\'{"robot":"k\\u00e4fer \\U0001f916"}\')\n'
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
