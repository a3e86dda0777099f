"""Runs the commands of docs/tutorial.md, in order, as printed there."""

from __future__ import annotations

import os
import queue
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
READY = "stop with Ctrl-C"
# Commands that talk to the router, which is on a free port here.
NETWORKED = ("doctor", "bridge dynamixel", "examples/")


def commands() -> list[str]:
    text = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```console\n(.*?)```", text, re.S)
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


class Shell:
    """Runs lines as a person's shell would, `&` and `kill %1` included."""

    def __init__(self, cwd: Path) -> None:
        self.cwd = cwd
        self.jobs: list[subprocess.Popen[str]] = []
        self.readers: list[threading.Thread] = []
        self.endpoint: str | None = None

    def run(self, line: str) -> str:
        if line.startswith("kill %"):
            job = self.jobs[int(line.removeprefix("kill %")) - 1]
            job.terminate()
            job.wait(20)
            return ""
        background = line.endswith("&")
        line = line.removesuffix("&").strip()
        words = shlex.split(line)
        if words[0] == "adaptive-contact":
            words[:1] = [sys.executable, "-u", "-m", "adaptive_contact"]
        elif words[0] == "python":
            words[:1] = [sys.executable, "-u"]
            words[2] = str(ROOT / words[2])
        if line.startswith("adaptive-contact serve"):
            words += ["--listen", "tcp/127.0.0.1:0"]
        if any(part in line for part in NETWORKED):
            assert self.endpoint is not None
            words += ["--connect", self.endpoint]
        return self._start(words) if background else self._wait(words)

    def _start(self, words: list[str]) -> str:
        job = subprocess.Popen(
            words, cwd=self.cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "XDG_STATE_HOME": str(self.cwd)},
        )  # fmt: skip
        self.jobs.append(job)
        lines: queue.Queue[str | None] = queue.Queue()

        def pump() -> None:
            assert job.stdout is not None
            for line in job.stdout:
                lines.put(line)
            lines.put(None)

        self.readers.append(threading.Thread(target=pump, daemon=True))
        self.readers[-1].start()
        said = ""
        deadline = time.monotonic() + 90
        while READY not in said:
            line = lines.get(timeout=max(deadline - time.monotonic(), 0.01))
            assert line is not None, f"{shlex.join(words)} ended: {said}"
            said += line
        found = re.search(r"listening on (\S+?)[,;]", said)
        if found:
            self.endpoint = found[1]
        return said

    def _wait(self, words: list[str]) -> str:
        done = subprocess.run(
            words, cwd=self.cwd, capture_output=True, text=True, timeout=240, check=False
        )
        # The doctor warns where the other legs hang limp: that is no failure.
        allowed = (0, 1) if "doctor" in words else (0,)
        assert done.returncode in allowed, f"{shlex.join(words)}: {done.stdout}{done.stderr}"
        return done.stdout

    def end(self) -> None:
        for job in reversed(self.jobs):
            if job.poll() is None:
                job.send_signal(signal.SIGINT)
                try:
                    job.wait(20)
                except subprocess.TimeoutExpired:
                    job.kill()
                    job.wait()
        for reader in self.readers:
            reader.join(10)
        for job in self.jobs:
            assert job.stdout is not None
            job.stdout.close()


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    one = Shell(tmp_path)
    yield one
    one.end()


def test_the_tutorial_has_its_commands() -> None:
    lines = commands()
    assert len(lines) >= 9
    for words in ("robot init", "robot check", "robot learn", "bridge dynamixel", "serve"):
        assert any(words in line for line in lines), words


@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.timeout(600)
def test_every_command_of_the_tutorial_works(shell: Shell) -> None:
    said = {line: shell.run(line) for line in commands()}
    assert (shell.cwd / "legs.svg").read_text(encoding="utf-8").startswith("<svg")
    assert (shell.cwd / "baseline.json").stat().st_size > 1000
    learned = next(text for line, text in said.items() if "robot learn" in line)
    assert learned.count(": good") + learned.count(": usable") == 6
    steps = next(text for line, text in said.items() if "gait_controller" in line)
    assert "stopped on contact" in steps
    found = next(text for line, text in said.items() if "doctor" in line)
    assert "error:" not in found, found
