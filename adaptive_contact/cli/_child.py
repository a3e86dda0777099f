"""Runs a command of this project in its own process, and ends it by its id."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import threading
import time
from collections import deque
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
        self._changed = threading.Condition()
        # Lines kept of what it says; enough to find the last one that means something.
        self._lines: deque[str] = deque(maxlen=200)
        self._over = False
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

    @property
    def lines(self) -> list[str]:
        """Return its last lines, without empty ones; all of them, once it has ended."""
        if not self.running:
            self._reader.join(_END_S)
        with self._changed:
            return list(self._lines)

    def wait_line(self, pattern: re.Pattern[str], timeout_s: float) -> re.Match[str]:
        """Wait until it says something.

        Args:
            pattern: searched in each line.
            timeout_s: at most; one that says it compiles gets ten minutes.

        Returns:
            The match in the first line that has one.

        Raises:
            AdaptiveContactError: it ended, or did not say it in time.
        """
        began_s = time.monotonic()
        with self._changed:
            while True:
                # A first start compiles, for minutes beside other work.  It says so, and is alive.
                if any(re.search(r"compiling the arithmetic", line) for line in self._lines):
                    timeout_s = max(timeout_s, 600.0)  # a slow computer's first start
                for line in self._lines:
                    match = pattern.search(line)
                    if match is not None:
                        return match
                left_s = began_s + timeout_s - time.monotonic()
                if self._over or left_s <= 0.0:
                    break
                self._changed.wait(left_s)
        if self._over:
            self._process.wait(_END_S)
            raise self.failure()
        raise AdaptiveContactError(
            f"{self.name} was not ready within {timeout_s:g} s; {self._last_words()}"
        )

    def check(self) -> None:
        """Raise if it has ended with a failure.

        Raises:
            AdaptiveContactError: with the last line it said.
        """
        if self._process.poll():
            raise self.failure()

    def failure(self) -> AdaptiveContactError:
        """Return why it ended, in one line."""
        code = self._process.poll()
        return AdaptiveContactError(
            f"{self.name} ended too early (exit code {code}); {self._last_words()}"
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
            if self.running:
                self._process.kill()
                self._process.wait()
            self._reader.join(_END_S)
            if self._process.stdout is not None and not self._reader.is_alive():
                self._process.stdout.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.strip():
                with self._changed:
                    self._lines.append(line.strip())
                    self._changed.notify_all()
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _last_words(self) -> str:
        lines = self.lines
        return f"its last words: {lines[-1]}" if lines else "it said nothing"
