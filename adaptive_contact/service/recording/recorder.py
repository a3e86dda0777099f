"""Records the wire: everything that matches a key expression, as it comes."""

from __future__ import annotations

import collections
import contextlib
import queue
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from adaptive_contact.service.link import Link, Received, check_key_expression
from adaptive_contact.service.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from adaptive_contact.service.recording.scene import Scene

# How long a stop may go unnoticed while nothing arrives.
_LOOK_S: Final = 0.1
_PROGRESS_S: Final = 0.5


class SplitWriter:
    """Writes one recording after another: ``walk_0.mcap``, ``walk_1.mcap`` and so on.

    Args:
        path: the name without numbers.
        about, scene: as of :class:`RecordingWriter`.
        part_s: how long each file is, s of log time.
        keep: files that are kept, the newest; None for all.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        scene: Scene | None,
        part_s: float,
        keep: int | None,
    ) -> None:
        self.paths: list[Path] = []  # that are there
        self._path, self._about, self._scene = path, about, scene
        self._part_ns = round(part_s * 1e9)
        self._keep = keep
        self._number = 0
        self._end_ns: int | None = None
        self._writer = self._next()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(
        self, key: str, payload: bytes, encoding: str, log_time_ns: int, publish_time_ns: int | None
    ) -> None:
        """Append a message, to the next file where it is time."""
        if self._end_ns is None:
            self._end_ns = log_time_ns + self._part_ns
        elif log_time_ns >= self._end_ns:
            self._writer.close()
            self._writer = self._next()
            self._end_ns = log_time_ns + self._part_ns
        self._writer.write(key, payload, encoding, log_time_ns, publish_time_ns)

    def _next(self) -> RecordingWriter:
        path = part_path(self._path, self._number)
        self._number += 1
        writer = RecordingWriter(path, self._about, self._scene)
        self.paths.append(path)
        if self._keep is not None and len(self.paths) > self._keep:
            self.paths.pop(0).unlink(missing_ok=True)
        return writer


def part_path(path: Path, number: int) -> Path:
    """Name of a part of a recording."""
    return path.with_name(f"{path.stem}_{number}{path.suffix}")


class Recorder:
    """Writes what a subscription receives.

    The subscription only queues, on Zenoh's thread; the thread that calls :meth:`run` writes.
    Log time is the arrival on this machine's wall clock, publish time the publisher's, where the
    network stamps samples.

    Args:
        link: open session.
        writer: open recording; closed by its owner.
        key_expr: what to record.
    """

    def __init__(self, link: Link, writer: RecordingWriter | SplitWriter, key_expr: str) -> None:
        self.counts: collections.Counter[str] = collections.Counter()  # messages so far, by key
        self._writer = writer
        self._queue: queue.SimpleQueue[Received] = queue.SimpleQueue()
        # One offset for the whole recording: a clock that is set meanwhile bends no interval.
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._subscription = link.subscribe(check_key_expression(key_expr), self._queue.put)

    def record_message(self, key: str, payload: bytes, encoding: str) -> None:
        """Record a message of this program's own, as one that has just arrived."""
        self._queue.put(Received(key, payload, encoding, time.monotonic_ns(), None))

    def run(
        self,
        stop: threading.Event,
        seconds: float | None = None,
        on_progress: Callable[[], None] | None = None,
    ) -> None:
        """Record until ``stop`` is set or the time is over; then write what is still queued.

        Args:
            stop: is noticed within a tenth of a second.
            seconds: how long, None for no end.
            on_progress: called about twice a second.
        """
        now_s = time.monotonic()
        end_s = None if seconds is None else now_s + seconds
        progress_s = now_s + _PROGRESS_S
        while not stop.is_set() and (end_s is None or now_s < end_s):
            wait_s = _LOOK_S if end_s is None else min(_LOOK_S, end_s - now_s)
            with contextlib.suppress(queue.Empty):
                self._write(self._queue.get(timeout=wait_s))
            now_s = time.monotonic()
            if on_progress is not None and now_s >= progress_s:
                progress_s = now_s + _PROGRESS_S
                on_progress()
        self._subscription.close()
        while not self._queue.empty():
            self._write(self._queue.get())

    def _write(self, received: Received) -> None:
        log_ns = received.arrival_ns + self._offset_ns
        self._writer.write(
            received.key, received.payload, received.encoding, log_ns, received.published_ns
        )
        self.counts[received.key] += 1
