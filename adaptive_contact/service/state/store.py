"""Stores states: ``DIR/ROBOT/LEG-LIBRARY-SETTINGS.state``, and the one before each.

A save writes a new file, syncs it, and renames: at every instant there is a whole state, the
newest or the one before it.  A state that was refused is set aside, ``.refused`` put after its
name, so that the next save does not push the sound one before it out.

A folder that others may write to must not turn a save against the service's user.  So every file
is opened relative to the folder that is locked, without following a link; a new one is created and
never taken over.  Folders are made with mode 0700, files with 0600, and what others may write to
is reported in :attr:`StateStore.exposed`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from adaptive_contact.errors import reason_of
from adaptive_contact.service.settings import shown_path
from adaptive_contact.service.state.format import MAX_BYTES, Identity, Record, Refused, pack, unpack

NEWEST: Final = ".state"
BEFORE: Final = ".before"
REFUSED: Final = ".refused"
_NEW: Final = ".new"
_LOCK: Final = "lock"
_SAFE: Final = os.O_NOFOLLOW | os.O_CLOEXEC
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}\Z")


class Stored(NamedTuple):
    """Describes one file of a folder: its record, or why it would be refused."""

    path: Path
    size: int
    record: Record | Refused


class StateStore:
    """Stores the states of one robot; opened by :meth:`open`, closed by :meth:`close`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder  # of this robot
        self.shown = shown_path(folder)  # the same, for people
        # one line on why nothing can be saved here, None when all is well
        self.trouble: str | None = f"{self.shown} is not open"
        # one line on what others may write to, None when there is no such thing
        self.exposed: str | None = None
        self._lock: int | None = None
        self._handle = -1  # of the folder, as long as there is a lock

    @classmethod
    def open(cls, root: Path, robot: str) -> StateStore:
        """Open a robot's folder below ``root``, made if need be; always gives a store.

        One service at a time saves into a folder: the second one reads, and says so.
        """
        store = cls(robot_folder(root, robot))
        store.reopen()
        return store

    def reopen(self) -> bool:
        """Try to get hold of the folder, if that has not worked yet; False where it does not.

        One that was removed is made again: a lock on what was there keeps no process out.
        """
        folder = self.folder
        if self._lock is not None:
            with contextlib.suppress(OSError):
                if os.path.samestat(os.fstat(self._lock), (folder / _LOCK).lstat()):
                    return True
            self.close()
        with contextlib.ExitStack() as opened:
            try:
                folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                if folder.is_symlink():
                    raise OSError(errno.ELOOP, "it is a link")
                folder.mkdir(mode=0o700, exist_ok=True)
                handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | _SAFE)
                opened.callback(os.close, handle)
                lock = os.open(_LOCK, os.O_RDWR | os.O_CREAT | _SAFE, 0o600, dir_fd=handle)
                opened.callback(os.close, lock)
            except OSError as error:
                self.trouble = _reason(error, self.shown)
                return False
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self.trouble = (
                    f"{self.shown} is in use by another service; stop that one, or give another "
                    "--state"
                )
                return False
            except OSError as error:  # a file system without locks
                self.trouble = _reason(error, self.shown, "locked")
                return False
            opened.pop_all()
        self._lock, self._handle, self.trouble = lock, handle, None
        self.exposed = _exposed(folder)
        return True

    def close(self) -> None:
        """Unlock the folder for other services."""
        if self._lock is not None:
            os.close(self._lock)
            os.close(self._handle)
            self._lock = None

    def path(self, identity: Identity) -> Path:
        """Return the path of a leg's newest state."""
        name = "-".join(_plain(x) for x in (identity.leg, identity.library, identity.settings))
        return self.folder / f"{name}{NEWEST}"

    def candidates(self, identity: Identity) -> Iterator[tuple[Path, Record | Refused]]:
        """Return what a leg can be restored from, newest first; missing files are left out."""
        if not os.access(self.folder, os.X_OK, effective_ids=True):
            return  # its content is unknown; `trouble` says that once, not for each leg
        newest = self.path(identity)
        for path in (newest, newest.with_suffix(BEFORE)):
            found = _read(path, identity)
            if found is not None:
                yield path, found

    def set_aside(self, path: Path) -> None:
        """Rename a refused state, to keep it for inspection."""
        with contextlib.suppress(OSError):  # a read-only folder keeps it where it is
            if self.trouble is None:  # the newest and the one before may both be refused
                self._rename(path.name, f"{path.name}{REFUSED}")

    def save(self, record: Record) -> None:
        """Write a record so that a crash at any instant leaves a whole one.

        Raises:
            OSError: it could not be written, or the folder is another's; what was there before is
                still there.
        """
        if not self.reopen():
            raise OSError(errno.EBUSY, self.trouble)
        data = pack(record)
        path = self.path(record.identity)
        newest, new = path.name, path.with_suffix(_NEW).name
        self._remove(new)  # of a save that was killed
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _SAFE
            with os.fdopen(os.open(new, flags, 0o600, dir_fd=self._handle), "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            with contextlib.suppress(FileNotFoundError):
                self._rename(newest, path.with_suffix(BEFORE).name)
            self._rename(new, newest)
            with contextlib.suppress(OSError):  # a file system that cannot keeps its own order
                os.fsync(self._handle)
        except OSError:
            with contextlib.suppress(OSError):
                self._remove(new)
            raise

    def _rename(self, name: str, to: str) -> None:
        os.replace(name, to, src_dir_fd=self._handle, dst_dir_fd=self._handle)

    def _remove(self, name: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._handle)


def is_of_leg(path: Path, leg: str) -> bool:
    """Return whether a file is a leg's by its name, which is all that a damaged one has."""
    return path.stem.rsplit("-", 2)[0] == _plain(leg)  # a leg's id may hold a "-"


def list_rest(root: Path) -> list[Path]:
    """List what killed saves have left; ``.old``, of earlier versions, is a whole state."""
    return sorted(path for path in root.glob("*/*") if path.suffix in (_NEW, ".old"))


def robot_folder(root: Path, robot: str) -> Path:
    """Return the folder of a robot's states; a name that cannot be a file's is hashed.

    Raises nothing: any text gives a folder below ``root``.
    """
    return root / _plain(robot)


def list_states(root: Path) -> list[Stored]:
    """List all states below a folder, refused ones too, in order of name."""
    found = []
    for path in sorted(root.glob("*/*")):
        if path.suffix not in (NEWEST, BEFORE, REFUSED):
            continue
        record = _read(path, None)
        if record is not None:
            with contextlib.suppress(OSError):
                found.append(Stored(path, path.stat().st_size, record))
    return found


def _read(path: Path, identity: Identity | None) -> Record | Refused | None:
    try:
        # Without waiting: a FIFO of that name would hold the service up for ever.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | _SAFE), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return Refused("not a file")
            data = file.read(MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        if error.errno == errno.ELOOP:
            return Refused("a link, which no state is")
        return Refused(f"cannot be read ({reason_of(error)})")
    if len(data) > MAX_BYTES:
        return Refused(f"larger than {MAX_BYTES // 2**20} MB, which no state is")
    return unpack(data, identity)


def _reason(error: OSError, folder: str, done: str = "written to") -> str:
    what = reason_of(error)
    return f"{folder} cannot be {done} ({what}); give another --state DIR, or --no-state"


def _plain(text: str) -> str:
    if _PLAIN.match(text):
        return text
    tail = hashlib.sha256(text.encode()).hexdigest()[:8]
    return f"{re.sub(r'[^A-Za-z0-9_]', '_', text)[:40]}.{tail}"


def _exposed(folder: Path) -> str | None:
    """Describe in one line what other users may write to, of a folder of states and all in it."""
    found = [path for path in (folder.parent, folder, *sorted(folder.iterdir())) if _is_open(path)]
    if not found:
        return None
    more = f" and {len(found) - 1} more in it" if len(found) > 1 else ""
    first = shown_path(found[0])
    return (
        f"other users may write to {first}{more}: they decide what is restored; take the right "
        f"from them: chmod -R go-w {first}"
    )


def _is_open(path: Path) -> bool:
    """Return whether a user other than this one and root may change a file or folder."""
    try:
        found = path.lstat()
    except OSError:
        return False
    if stat.S_ISLNK(found.st_mode):  # it is not followed
        return False
    if found.st_uid not in (0, os.geteuid()):
        return True
    if stat.S_ISDIR(found.st_mode) and found.st_mode & stat.S_ISVTX:
        return False  # as /tmp: no user may replace another's folder
    return bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
