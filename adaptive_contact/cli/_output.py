"""Writes to standard output and standard error, and handles their failures.

Text of the wire and of files is shown, never obeyed: all lines for people go through
:func:`print_line`.  Where a stream cannot be written, for a full disk or a reader that is gone:

A line on standard error is lost, and the command goes on.  Standard output is what a command is
called for, so it ends with :class:`OutputLost`; a command that runs until it is stopped declares
with :func:`make_stdout_optional` that its lines are lost as well.  After that nothing is left that
the interpreter could fail to write at its exit, which would turn the exit code into 120.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
from typing import TYPE_CHECKING, Final, TextIO

from adaptive_contact.printable import printable, printable_json
from adaptive_contact.service.settings import Finding

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


_LONGEST: Final = 2000  # characters of a line


def print_line(line: object, *, err: bool = False) -> None:
    """Print one line for people; control characters in it are shown."""
    print(printable(line), file=sys.stderr if err else sys.stdout, flush=True)


def print_json(value: object, indent: int | None = None) -> None:
    """Print a value as JSON that a terminal can show; bytes and text are JSON already."""
    if not isinstance(value, bytes | str):
        import msgspec

        value = msgspec.json.encode(value, enc_hook=str)
        value = value if indent is None else msgspec.json.format(value, indent=indent)
    shown = printable_json(value)
    try:
        shown.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:  # a locale of fewer letters: as JSON has them in ASCII
        shown = json.dumps(json.loads(shown))
    print(shown, flush=True)


def print_note(line: object) -> None:
    """Print one line for people beside a command's output, on standard error."""
    text = str(line)
    if len(text) > _LONGEST:  # it shows what a file holds
        text = f"{text[: _LONGEST // 2]} … {text[-_LONGEST // 2 :]}"
    print_line(f"adaptive-contact: {text}", err=True)


def print_waiting(finding: Finding) -> None:
    """Print what stands in the way of the network, while a command tries on."""
    print_note(f"{finding.line}; trying on")


def overwrite(line: str) -> None:
    """Replace the last line of a terminal on standard error, at most its width."""
    room = shutil.get_terminal_size().columns - 1
    print(f"\r\x1b[K{printable(line)[:room]}", end="", file=sys.stderr, flush=True)


class OutputLost(Exception):  # noqa: N818 - no error of the program
    """Reports that standard output takes no more.

    Not an ``OSError``: typer and rich take a broken pipe of any file for that of standard output,
    and end with code 1.
    """

    def __init__(self, cause: OSError) -> None:
        super().__init__(cause.strerror)
        self.cause = cause


class _Channel(io.FileIO):
    """Wraps a standard stream's file, and drops what cannot be written.

    Args:
        number: of the file descriptor, which stays open.
        needed: the first write that fails raises :class:`OutputLost`; what is still buffered then
            is dropped.
    """

    def __init__(self, number: int, *, needed: bool) -> None:
        super().__init__(number, "w", closefd=False)
        self.needed = needed

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if self.needed:
                self.needed = False
                raise OutputLost(error) from error
            return memoryview(data).nbytes


def protect_output() -> None:
    """Replace ``sys.stdout`` and ``sys.stderr`` by streams that a failing write does not spoil.

    Call it once per process, before anything is printed.  A stream that was closed by the caller
    (``>&-``) becomes the null device, so that no file opened later takes its number.
    """
    with contextlib.suppress(OSError):
        while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
            os.set_inheritable(number, True)
        os.close(number)
    sys.stdout = _protected(sys.stdout, 1, needed=True)
    sys.stderr = _protected(sys.stderr, 2, needed=False)


def make_stdout_optional() -> None:
    """Drop lines that standard output cannot take, instead of ending with them."""
    channel = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    if isinstance(channel, _Channel):
        channel.needed = False


def _protected(stream: TextIO | None, number: int, *, needed: bool) -> TextIO:
    at_once = number == 2
    encoding, errors = "utf-8", "backslashreplace"
    if stream is None:  # closed by the caller; what has its number now may be another file
        number = os.open(os.devnull, os.O_WRONLY)
    if isinstance(stream, io.TextIOWrapper):
        with contextlib.suppress(OSError):
            stream.flush()
        at_once = stream.line_buffering or stream.write_through
        encoding = stream.encoding  # of a locale that may lack letters of the wire and of files
    return io.TextIOWrapper(
        io.BufferedWriter(_Channel(number, needed=needed)),
        encoding=encoding,
        errors=errors,
        line_buffering=at_once,
    )
