"""Handles the signals that end a command."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable


def on_signals(
    handler: Callable[[int, object], None],
    numbers: Iterable[signal.Signals] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP),
) -> None:
    """Handle signals that end a command.

    A terminal that is closed sends SIGHUP; under ``nohup`` that is ignored, and stays so.
    """
    for number in numbers:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def interrupt_once() -> None:
    """Raise KeyboardInterrupt at a Ctrl-C, but at no second one while that cleans up.

    It would end the removal of what is half written, and the file would stay.  Who presses it
    again after :data:`CLEANING_S` is heeded.  Where Ctrl-C is ignored it stays so.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    before_s = float("-inf")

    def interrupt(_: int, __: object) -> None:
        nonlocal before_s
        now_s = time.monotonic()
        if now_s - before_s < 2.0:  # what is half written is being removed
            return
        before_s = now_s
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
