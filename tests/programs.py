"""Programs of Python in processes of their own."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

from click.testing import Result
from typer.main import get_command
from typer.testing import CliRunner

from adaptive_contact.cli import main as cli

END_S: Final = 60.0

# A router that listens where it is told, or at a free port, which it says.
ROUTER: Final = """
import sys, threading
from adaptive_contact.service.link import Link, router_settings
with Link.open(router_settings([sys.argv[1]])) as link:
    print(link.endpoints[0], flush=True)
    threading.Event().wait()
"""


class Program:
    """A process, and the lines that it says; it is ended by :meth:`close` at the latest.

    Args:
        words: what follows the interpreter, such as ``-m adaptive_contact serve``.
        python: another interpreter than that of the tests.
        before: what runs the interpreter, such as ``ip netns exec NAME``.
        where: more for ``Popen``, such as ``cwd`` and ``env``.
    """

    def __init__(
        self,
        *words: object,
        python: str = sys.executable,
        before: Sequence[str] = (),
        **where: Any,
    ) -> None:
        self.lines: list[str] = []
        self._looked_at = 0
        self._changed = threading.Condition()
        self.process = subprocess.Popen(
            [*before, python, "-u", *map(str, words)],
            text=True,
            encoding="utf-8",
            **{
                "stdin": subprocess.DEVNULL,
                "stdout": subprocess.PIPE,
                "stderr": subprocess.STDOUT,
                **where,
            },
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self.process.stdout or ():
            with self._changed:
                self.lines.append(line.rstrip("\n"))
                self._changed.notify_all()

    def wait_line(self, pattern: str, timeout_s: float = END_S, begin: int = 0) -> re.Match[str]:
        """The match in the first line from one on; fails when the process ends before."""
        until_s = time.monotonic() + timeout_s
        while True:
            ended = not self._reader.is_alive()
            with self._changed:
                for at, line in enumerate(self.lines[begin:], begin):
                    if match := re.search(pattern, line):
                        self._looked_at = at + 1
                        return match
                assert not ended, f"no '{pattern}' in {self.lines}"
                assert time.monotonic() < until_s, f"no '{pattern}' in time in {self.lines}"
                self._changed.wait(0.1)

    def next_line(self, pattern: str, timeout_s: float = END_S) -> re.Match[str]:
        """The match in the first line after the one that was found last."""
        return self.wait_line(pattern, timeout_s, self._looked_at)

    def wait(self, timeout_s: float = END_S) -> int:
        """Wait for its end; its exit code."""
        code = self.process.wait(timeout_s)
        self._reader.join(END_S)
        return code

    def stop(self, number: int = signal.SIGINT) -> int:
        """Ask it to end; its exit code."""
        self.process.send_signal(number)
        return self.wait()

    def close(self) -> None:
        """End it, if the test has not."""
        if self.process.poll() is None:
            self.process.terminate()
            self.process.send_signal(signal.SIGCONT)  # a stopped process handles no signal
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(END_S)
            self.process.kill()
        self.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


def commands() -> Iterator[tuple[tuple[str, ...], Any]]:
    """All commands of ours and groups of them, each with its words."""
    cli.load_commands()
    waiting: list[tuple[tuple[str, ...], Any]] = [((), get_command(cli.app))]
    for words, command in waiting:
        yield words, command
        below = getattr(command, "commands", {})
        waiting += [((*words, name), one) for name, one in below.items()]


def tried(*words: object, **more: Any) -> Result:
    """What becomes of a command of ours, run in this process."""
    cli.load_commands()
    return CliRunner().invoke(cli.app, [str(word) for word in words], **more)


def succeeded(*words: object) -> Result:
    """The same of one that succeeds; an error is raised."""
    result = tried(*words)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result


def invoke(*words: object) -> str:
    """What a command of ours that succeeds says, on both streams."""
    return succeeded(*words).output
