"""Records what the page is asked to record: into one folder, under names that are made here.

Nothing of a request reaches a path, and no file is written over.
"""

from __future__ import annotations

import shutil
import threading
import time
from pathlib import Path
from typing import Any, Final

from adaptive_contact.errors import AdaptiveContactError, ConfigurationError, RecordingError
from adaptive_contact.printable import printable
from adaptive_contact.service.link import Link
from adaptive_contact.service.recording import RecordingWriter
from adaptive_contact.service.recording.recorder import Recorder
from adaptive_contact.wire import MARK, MSGPACK, Mark, encode

_KEY: Final = "robot/**"
# A page that is left alone fills no disk: six legs at 50 Hz write some 100 MB in this time.
_LONGEST_S: Final = 3600.0


class Recordings:
    """Makes recordings in a folder, one at a time; calls may come from any thread.

    Raises:
        ConfigurationError: there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            found = "a file" if folder.exists() else "no such folder"
            raise ConfigurationError(f"--record-to {folder}: found {found}; give a folder")
        self._folder = folder
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._recorder: Recorder | None = None
        self._path: Path | None = None
        self._began_s = 0.0
        self._seconds = 0.0  # length of the one that has ended
        self._error: str | None = None

    def start(self, link: Link | None) -> None:
        """Begin a recording.

        Raises:
            RecordingError: one runs, the disk is full, or there is no router yet.
        """
        with self._lock:
            if self._running:
                raise RecordingError("a recording runs already; stop it first")
            if link is None:
                raise RecordingError("there is no router yet; nothing to record")
            try:
                self._check_room()
                self._path = path = self._new()
            except OSError as error:
                raise RecordingError(
                    f"the folder cannot be written to ({error.strerror})"
                ) from error
            about = {"key": _KEY, "recorded": time.strftime("%Y-%m-%dT%H:%M:%S%z")}
            writer = RecordingWriter(path, about)
            recorder = self._recorder = Recorder(link, writer, _KEY)
            self._stop, self._error, self._began_s = threading.Event(), None, time.monotonic()
            self._thread = threading.Thread(
                target=self._run, args=(writer, recorder), name="page-recorder", daemon=True
            )
            self._thread.start()

    def stop(self) -> None:
        """End the recording; without one nothing happens."""
        with self._lock:
            self._stop.set()
            if self._thread is not None:
                self._thread.join()

    def mark(self, label: str, t_ns: int) -> None:
        """Write a mark into the recording.

        Raises:
            RecordingError: none runs.
        """
        recorder = self._recorder
        if recorder is None or not self._running:
            raise RecordingError("nothing is being recorded")
        mark = Mark(t_ns=t_ns, label=printable(label[:80]))
        recorder.record_message(MARK, encode(mark), MSGPACK)

    def state(self) -> dict[str, Any]:
        """Return the newest recording's file, size, length and whether it runs, for the page."""
        path, running = self._path, self._running
        if path is None:
            return {"running": False}
        seconds = time.monotonic() - self._began_s if running else self._seconds
        return {
            "running": running,
            "file": path.name,
            "bytes": path.stat().st_size if path.exists() else 0,
            "seconds": int(seconds),
            "error": self._error,
        }

    @property
    def _running(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _check_room(self) -> None:
        """Raise RecordingError where the disk is nearly full."""
        if shutil.disk_usage(self._folder).free < 500_000_000:
            raise RecordingError("less than 0.5 GB is free in the folder; make room first")

    def _run(self, writer: RecordingWriter, recorder: Recorder) -> None:
        try:
            with writer:
                recorder.run(self._stop, _LONGEST_S, self._check_room)
        except AdaptiveContactError as error:
            self._error = str(error).replace(f"{self._folder}/", "")
        except OSError as error:  # the folder is gone, or its disk
            self._error = f"the folder cannot be used any more ({error.strerror})"
        finally:
            self._seconds = time.monotonic() - self._began_s

    def _new(self) -> Path:
        """Make an empty file, named by the time; one that is there is not written over."""
        ms = time.time_ns() // 1_000_000 % 1000
        path = self._folder / f"{time.strftime('page-%Y%m%d-%H%M%S')}-{ms:03}.mcap"
        path.open("xb").close()
        return path
