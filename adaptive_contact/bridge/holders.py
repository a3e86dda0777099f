"""Who has a serial port open: locks are advice, and most Dynamixel software does not ask for it.

Linux shows every process' open files under ``/proc/PID/fd``; two files are the same device where
their device numbers are.  Of other users' processes only root sees them.  Who has the *other end*
of a pseudo-terminal open is its virtual bus, not a rival, and keeps our end open as well.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

__all__ = ["holders", "is_pseudo"]

_PROCESSES: Final = Path("/proc")
_PSEUDO: Final = "/dev/pts/"


def is_pseudo(device: str) -> bool:
    """Whether a device is a pseudo-terminal; symbolic links are followed."""
    return os.path.realpath(device).startswith(_PSEUDO)


def holders(device: str) -> dict[int, str]:
    """Other processes that have a device open, as far as this user may see: name by id."""
    try:
        wanted = Path(device).stat().st_rdev
    except OSError:
        return {}
    if not wanted:  # no device
        return {}
    other_end = f"tty-index:\t{Path(os.path.realpath(device)).name}" if is_pseudo(device) else None
    found = {}
    for process in _PROCESSES.iterdir():
        if not process.name.isdigit() or int(process.name) == os.getpid():
            continue
        if _has_open(process, wanted) and not (other_end and _has_end(process, other_end)):
            found[int(process.name)] = _text(process / "comm") or "a program"
    return dict(sorted(found.items()))


def _has_open(process: Path, device: int) -> bool:
    try:
        files = list((process / "fd").iterdir())
    except OSError:
        return False  # it has ended, or is another user's
    return any(_number(file) == device for file in files)


def _number(file: Path) -> int:
    try:
        return file.stat().st_rdev
    except OSError:
        return -1


def _has_end(process: Path, other_end: str) -> bool:
    """Whether it has the other end open, which Linux tells by the number of the pair."""
    try:
        return any(other_end in _text(file).splitlines() for file in (process / "fdinfo").iterdir())
    except OSError:
        return False


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
