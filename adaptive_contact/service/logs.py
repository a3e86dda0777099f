"""Structured logs on stderr: ``key=value`` lines for people, JSON lines for machines."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import sys
import threading
from collections.abc import MutableMapping
from typing import Any, TextIO

import structlog

from adaptive_contact.printable import printable, printable_json, printable_lines

__all__ = ["configure_logs"]


class _Lines:
    """Writes lines, and never raises: a full disk must not end the service that tells of it.

    Args:
        stream: where to.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._turn = threading.Lock()

    def msg(self, message: str) -> None:
        """Write a line, if that can be done."""
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
            colors=stream.isatty(),
            pad_event_to=0,
            exception_formatter=_trace,
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
