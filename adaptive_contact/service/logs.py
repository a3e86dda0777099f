"""Writes structured logs to stderr: ``key=value`` lines or JSON lines; throttled."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Hashable, MutableMapping
from typing import Any, TextIO

import structlog

from adaptive_contact.printable import printable, printable_json, printable_lines

_log = structlog.get_logger()


class _Lines:
    """Writes lines, and never raises: a full disk must not end the service that reports it.

    Args:
        stream: where to.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._turn = threading.Lock()

    def msg(self, message: str) -> None:
        with self._turn, contextlib.suppress(OSError, ValueError):  # full, gone, or closed
            self._stream.write(f"{message}\n")
            self._stream.flush()

    debug = info = warning = error = critical = exception = msg


def _shown(_: object, __: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Show control characters of values from the wire, which a terminal would obey."""
    for name, value in event.items():
        if isinstance(value, str):
            event[name] = printable(value)
    return event


def _as_json(event: object, **options: Any) -> str:
    return printable_json(json.dumps(event, **options))


def _trace(stream: TextIO, found: Any) -> None:
    """Write a traceback; the message of an exception may hold what came over the wire."""
    text = io.StringIO()
    structlog.dev.plain_traceback(text, found)
    stream.write(printable_lines(text.getvalue()))


def configure_logs(
    level: str = "info", *, json: bool = False, stream: TextIO | None = None
) -> None:
    """Set up the process's logging.

    Args:
        level: least level that is logged, such as ``info``.
        json: one JSON object per line.
        stream: where to; stderr unless given.
    """
    stream = stream or sys.stderr
    processors: list[Any] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    if json:
        processors += [
            structlog.processors.format_exc_info,
            structlog.processors.EventRenamer("message"),
            structlog.processors.JSONRenderer(serializer=_as_json),
        ]
    else:
        processors.append(_shown)
        # A plain stack: a fancy one takes a fifth of a second of a tick, and shows local variables.
        console = structlog.dev.ConsoleRenderer(
            colors=stream.isatty(), pad_event_to=0, exception_formatter=_trace
        )
        processors += [console]
    lines = _Lines(stream)
    structlog.configure(
        processors=processors,
        wrapper_class=structlog.make_filtering_bound_logger(
            logging.getLevelNamesMapping()[level.upper()]
        ),
        logger_factory=lambda *_: lines,
        cache_logger_on_first_use=False,
    )


class LogThrottle:
    """Lets one line of a kind through per period, and says how many it held back.

    Args:
        period_s: between two lines of a kind.
    """

    def __init__(self, period_s: float = 10.0) -> None:
        self._period_ns = int(period_s * 1e9)
        # kind -> when the last line passed, and how many came since; the oldest kind goes first.
        self._kinds: OrderedDict[Hashable, tuple[int, int]] = OrderedDict()

    def passes(self, kind: Hashable, now_ns: int, times: int = 1) -> int | None:
        """Ask for a line.

        Args:
            kind: what the line is about; each kind has its own period.
            now_ns: monotonic.
            times: how many such things happened.

        Returns:
            How many the line stands for, or None where it is to be held back.
        """
        passed_ns, held = self._kinds.get(kind, (None, 0))
        if passed_ns is not None and now_ns - passed_ns < self._period_ns:
            self._kinds[kind] = (passed_ns, held + times)
            return None
        self._kinds[kind] = (now_ns, 0)
        self._kinds.move_to_end(kind)
        if len(self._kinds) > 256:
            self._kinds.popitem(last=False)
        return held + times

    def warn(
        self, kind: Hashable, now_ns: int, what: str, *, times: int = 1, **facts: object
    ) -> None:
        """Log a warning, and how many it stands for, unless one of its kind has just passed."""
        stands_for = self.passes(kind, now_ns, times)
        if stands_for is not None:
            _log.warning(what, times=stands_for, **facts)

    def fault(self, leg: str, fault: Exception) -> None:
        """Log that a leg was restarted after a fault, unless one of it has just been logged."""
        times = self.passes(leg, time.monotonic_ns())
        if times is not None:
            _log.error("fault in learning, leg restarted", leg=leg, times=times, exc_info=fault)
