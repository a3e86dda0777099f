"""Who has a serial port open: locks are advice, and most Dynamixel software does not ask for it.

Linux shows every process' open files under ``/proc/PID/fd``; two files are the same device where
their device numbers are.  A pseudo-terminal's number counts within its ``devpts`` only, of which
every container has one of its own: there the file system must be the same, too.  Of other users'
processes only root sees the files.  Who has the *other end* of a pseudo-terminal open is its
virtual bus, not a rival, and keeps our end open as well.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple

__all__ = ["holders", "is_pseudo"]

_PROCESSES: Final = Path("/proc")
# Major device numbers of pseudo-terminals; Documentation/admin-guide/devices.txt of Linux.
_PSEUDO: Final = range(136, 144)


class _Device(NamedTuple):
    number: int
    # File system of a pseudo-terminal.  A node of any other device is the same device in every one.
    within: int | None


def is_pseudo(device: str) -> bool:
    """Whether a device is a pseudo-terminal; symbolic links are followed."""
    known = _device(Path(device))
    return known is not None and known.within is not None


def holders(device: str) -> dict[int, str]:
    """Other processes that have a device open, as far as this user may see: name by id."""
    wanted = _device(Path(device))
    if wanted is None:
        return {}
    found = {}
    for process in _PROCESSES.iterdir():
        if not process.name.isdigit() or int(process.name) == os.getpid():
            continue
        if any(_device(file) == wanted for file in _files(process)) and not (
            wanted.within is not None
            and _has_other_end(process, os.path.realpath(device), wanted.within)
        ):
            found[int(process.name)] = _name(process)
    return dict(sorted(found.items()))


def _name(process: Path) -> str:
    """A program's name; the kernel keeps 15 characters of it, its command line has all."""
    short = _text(process / "comm")
    words = (PurePosixPath(word).name for word in _text(process / "cmdline").split("\0")[:2])
    return next((word for word in words if word.startswith(short)), short) or "a program"


def _device(file: Path) -> _Device | None:
    """Which device a file is, links followed; None if it is not one, or gone."""
    try:
        status = file.stat()
    except OSError:
        return None
    if not status.st_rdev:
        return None
    pseudo = os.major(status.st_rdev) in _PSEUDO
    return _Device(status.st_rdev, status.st_dev if pseudo else None)


def _files(process: Path) -> Iterator[Path]:
    try:
        yield from (process / "fd").iterdir()
    except OSError:
        return  # it has ended, or is another user's


def _has_other_end(process: Path, device: str, within: int) -> bool:
    """Whether a process has the other end of a pseudo-terminal open.

    Linux tells the number of the pair, and the path by which the other end was opened: ``ptmx`` of
    the ``devpts`` itself, or one beside which that is mounted as ``pts``.
    """
    index = f"tty-index:\t{PurePosixPath(device).name}"
    for file in _files(process):
        if index not in _text(process / "fdinfo" / file.name).splitlines():
            continue
        try:
            opened = PurePosixPath(file.readlink())
            folders = (opened.parent, opened.parent / "pts")
            if within in [_file_system(process, folder) for folder in folders]:
                return True
        except OSError:  # closed meanwhile
            continue
    return False


def _file_system(process: Path, folder: PurePosixPath) -> int | None:
    """The file system of a folder, as that process sees it: a container has mounts of its own."""
    try:
        here = (process / "ns/mnt").samefile(_PROCESSES / "self/ns/mnt")
        root = Path("/") if here else process / "root"
        return (root / folder.relative_to("/")).stat().st_dev
    except (OSError, ValueError):
        return None


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
