"""Writes the files that a person names, whole or not at all, and reads texts, to so much at most.

A regular file is written beside its place, synced and renamed, so that a crash or a full disk
leaves the old one.  Links are followed, and the file they lead to is replaced.  A device, a FIFO or
a standard stream is written to and stays what it is: `-o /dev/null` as root must not put a file
there.  The folder of learned state has stricter rules, see
:mod:`adaptive_contact.service.state.store`.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Final

import msgspec

from adaptive_contact.errors import AdaptiveContactError, ConfigurationError

# Of the name of a file in the name of the one beside it: a file system allows 255 bytes.
_NAME_CHARACTERS: Final = 40
_ADVICE: Final = "give a path in a folder that exists, is writable and has room"
# In a key of TOML: they cost the parser their number's square, 4 s for 20,000.
_MOST_PARTS: Final = 64


def write_file(
    path: str | Path,
    data: bytes | str,
    *,
    advice: str = _ADVICE,
    error: type[AdaptiveContactError] = ConfigurationError,
) -> None:
    """Write a file, whole or not at all, as :func:`whole_file` does; text becomes UTF-8."""
    with whole_file(path, advice=advice, error=error) as file:
        file.write(data.encode() if isinstance(data, str) else data)


def read_file(
    path: Path,
    advice: str,
    *,
    # Of a text that a person writes; 64 legs of 16 joints, with all that robot.toml says, have 174
    # kB.
    most: int = 256_000,
    error: type[AdaptiveContactError] = ConfigurationError,
) -> bytes:
    """Read a file that is small.

    Args:
        path: of the file.
        advice: what is expected, the end of the error's line.
        most: bytes that it may have.
        error: kind of error to raise.

    Raises:
        AdaptiveContactError: of the given kind, when it cannot be read, or is larger.
    """
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as why:
        raise error(f"{path}: cannot be read ({why.strerror or why}); {advice}") from why
    if len(data) > most:
        raise error(f"{path}: has more than {most // 1000} kB; {advice}")
    return data


def read_toml(path: Path, advice: str) -> dict[str, Any]:
    """Read a TOML file that is small, see :func:`read_file` and :func:`parse_toml`."""
    try:
        text = read_file(path, advice).decode("utf-8-sig")  # editors of Windows begin with a mark
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: is not UTF-8 text; {advice}") from error
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse TOML, in little time whatever it is; ``source`` names it in errors.

    Raises:
        ConfigurationError: in one line, what is wrong in it.
    """
    try:
        if max(map(_dots, text.split("\n"))) > _MOST_PARTS:
            raise ConfigurationError(
                f"{source}: a line joins more than {_MOST_PARTS} words by dots;"
                " expected keys of a few parts"
            )
        table = tomllib.loads(text)
        msgspec.msgpack.encode(table)  # takes integers of 64 bits, as TOML does
    except RecursionError as error:
        raise ConfigurationError(f"{source}: not valid TOML: nested too deeply") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{source}: not valid TOML: {error}") from error
    except (ValueError, OverflowError) as error:  # of thousands of digits, of a few
        raise ConfigurationError(
            f"{source}: not valid TOML: a whole number has more than 64 bits"
        ) from error
    return table


def _dots(line: str) -> int:
    """Count the dots that may join the parts of one key of TOML.

    Those of the numbers of a list, and those of a comment, join nothing.  In a line with quotes
    only a parser knows what is a comment: all count.
    """
    if '"' in line or "'" in line:
        return line.count(".")
    return max(part.count(".") for part in line.partition("#")[0].split(","))


@contextlib.contextmanager
def whole_file(
    path: str | Path,
    *,
    advice: str = _ADVICE,
    error: type[AdaptiveContactError] = ConfigurationError,
) -> Iterator[IO[bytes]]:
    """Open a file that appears whole or not at all.

    Args:
        path: where to; a link is followed, a device or FIFO written to.
        advice: what the person can do when it fails, the end of the error's line.
        error: kind of error to raise.

    Yields:
        The file; it gets its name when the block ends without an exception.

    Raises:
        AdaptiveContactError: of the given kind, when it cannot be written.
    """
    path = Path(path)
    try:
        with _opened(path) as file:
            yield file
    except OSError as why:
        raise error(cannot_write(path, why, advice)) from why


def holds_content(path: Path) -> bool:
    """Return whether writing to ``path`` would lose content; a device or a FIFO holds none."""
    return path.is_file() or path.is_dir()


def why_not_writable(path: Path) -> str | None:
    """Say why a file could not be written later, before any work is done for it; None if it could.

    A regular file needs a folder that is writable, for it is written beside its place.
    """
    if path.is_dir():
        return "it is a folder"
    target = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        return None if os.access(path, os.W_OK) else "no permission"
    if not target.parent.is_dir():
        return f"there is no folder {target.parent}"
    if path.exists() and not os.access(path, os.W_OK):
        return "it is read-only"
    try:  # permissions do not say it: of root, of a disk that is full, of /proc
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        return f"no file can be made in its folder: {error.strerror}"
    return None


def cannot_write(path: Path, why: OSError, advice: str) -> str:
    """Return the line for a file that cannot be written."""
    return f"{path}: cannot be written ({why.strerror or why}); {advice}"


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a file beside its place, or what is there and is no regular file."""
    try:
        found = path.stat()
    except FileNotFoundError:
        found = None
    target = Path(os.path.realpath(path))
    stream = None if found is None else _standard_stream(found)
    opened: contextlib.AbstractContextManager[IO[bytes]]
    if stream is not None:
        _flush_streams()
        opened = os.fdopen(os.dup(stream), "wb")  # shares the position with what is printed
    elif found is None or (stat.S_ISREG(found.st_mode) and _is_same(target, found)):
        if found is not None and not os.access(target, os.W_OK):
            raise PermissionError(13, "it is read-only", str(target))
        opened = _beside(target, found)
    else:
        opened = os.fdopen(
            os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC | os.O_NOCTTY), "wb"
        )
    with opened as file:
        yield file


def _standard_stream(found: os.stat_result) -> int | None:
    """Return the standard stream that goes to a file, if one does."""
    for stream in (1, 2):
        with contextlib.suppress(OSError):  # it may be closed
            if os.path.samestat(os.fstat(stream), found):
                return stream
    return None


@contextlib.contextmanager
def _beside(target: Path, old: os.stat_result | None) -> Iterator[IO[bytes]]:
    """Open a new file beside ``target``, then rename it; mode and owner of the old one stay."""
    part = target.with_name(f".{target.name[:_NAME_CHARACTERS]}.{secrets.token_hex(4)}.part")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    handle = os.open(part, flags, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            if old is not None:
                with contextlib.suppress(OSError):  # only root may give files away
                    os.fchown(handle, old.st_uid, old.st_gid)
                os.fchmod(handle, stat.S_IMODE(old.st_mode) & 0o777)
            os.fsync(handle)
        part.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


def _is_same(target: Path, found: os.stat_result) -> bool:
    """Return whether a path without links is the file found (not: a removed `/proc/…/fd`)."""
    try:
        return os.path.samestat(target.stat(), found)
    except OSError:
        return False


def _flush_streams() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
