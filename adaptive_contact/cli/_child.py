"""Runs a command of this project in its own process, and ends it by its id."""

from __future__ import annotations

import contextlib
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import Final, Self

from adaptive_contact.errors import AdaptiveContactError

# `serve` ends within 2 s of a signal, within 7 s on a slow disk; the simulator after its tick.
_END_S: Final = 10.0


class Child:
    """Runs a command; a context manager that ends it.

    Its output is read on a thread, so that a full pipe never stops it.
    """

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self.name = name
        self._said = ""  # the last line that is not empty
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # None at the end
        self._process = subprocess.Popen(
            [sys.executable, "-m", "adaptive_contact", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
        )
        self._reader = threading.Thread(target=self._read, name=f"read {name}", daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def pid(self) -> int:
        """Return its process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Return whether it has not ended yet."""
        return self._process.poll() is None

    def wait_line(self, pattern: re.Pattern[str], timeout_s: float) -> re.Match[str]:
        """Wait until it says something.

        Args:
            pattern: searched in each line.
            timeout_s: at most; one that says it compiles gets ten minutes.

        Returns:
            The match in the first line from now on that has one.

        Raises:
            AdaptiveContactError: it ended, or did not say it in time.
        """
        end_s = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(end_s - time.monotonic(), 0.0))
            except queue.Empty:
                raise AdaptiveContactError(
                    f"{self.name} was not ready within {timeout_s:g} s; {self._last_words()}"
                ) from None
            if line is None:
                self._process.wait(_END_S)
                raise self.failure()
            # A first start compiles, for minutes beside other work.  It says so, and is alive.
            if "compiling the arithmetic" in line:
                end_s = max(end_s, time.monotonic() + 600.0)
            match = pattern.search(line)
            if match is not None:
                return match

    def check(self) -> None:
        """Raise if it has ended with a failure.

        Raises:
            AdaptiveContactError: with the last line it said.
        """
        if self._process.poll():
            raise self.failure()

    def failure(self) -> AdaptiveContactError:
        """Return why it ended, in one line."""
        self._reader.join(_END_S)
        return AdaptiveContactError(
            f"{self.name} ended too early (exit code {self._process.poll()}); {self._last_words()}"
        )

    def end(self) -> None:
        """Ask it to end, and make it end if it does not; quick where it has."""
        try:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
                if not self.running:
                    break
                self._process.send_signal(number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(_END_S)
        finally:
            # Also when a second Ctrl-C breaks into the waiting: nothing may stay behind.
            self._process.kill()
            self._process.wait()
            self._reader.join(_END_S)

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in filter(str.strip, lines):
                self._said = line.strip()
                self._lines.put(self._said)
        self._lines.put(None)

    def _last_words(self) -> str:
        return f"its last words: {self._said}" if self._said else "it said nothing"
