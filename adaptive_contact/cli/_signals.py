"""Signals that end a command."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable
from typing import Final

ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def on_signals(
    handler: Callable[[int, object], None], numbers: Iterable[signal.Signals] = ENDING
) -> None:
    """Handle signals that end a command.

    A terminal that is closed sends SIGHUP; under ``nohup`` that is ignored, and stays so.
    """
    for number in numbers:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
