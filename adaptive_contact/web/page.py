"""Runs the page's server and what feeds it, each on a thread of its own.

The feeding thread takes in what has been published, ten times a second, and makes bytes, which the
serving threads give to every browser.  Another one asks the service for its ticks: where no answer
comes, the others do not wait for it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Final, Self

import msgspec

from adaptive_contact.checks.findings import Finding, Level
from adaptive_contact.errors import LinkError, RecordingError
from adaptive_contact.service.link import Link
from adaptive_contact.service.trace import TraceReader
from adaptive_contact.service.watch import Feed, View
from adaptive_contact.web.frames import Frames, Table
from adaptive_contact.web.recordings import Recordings
from adaptive_contact.web.server import Refused, Site, WebSettings
from adaptive_contact.wire import LearnerStatus, LegTrace, ModelReport, Rejected, decode, model_key

FRAME_S: Final = 0.1
_END_S: Final = 2.0


class LivePage:
    """Serves the page; a context manager.

    Raises:
        ConfigurationError: the port is in use, or the address is none of this computer's.
    """

    def __init__(self, settings: WebSettings) -> None:
        to = settings.record_to
        self._recordings = None if to is None else Recordings(to)
        self._site = Site(settings, self._model, self._record)
        self._stop = threading.Event()
        self._start_ns = time.monotonic_ns()
        # One offset for the whole page, as of a recording.
        self._wall_ns = time.time_ns() - self._start_ns
        self._frames = Frames(self._start_ns)
        self._table = Table((self._start_ns + self._wall_ns) // 1_000_000)
        self._waiting: Finding | None = None
        self._link: Link | None = None
        self._reader: TraceReader | None = None
        self._traces: deque[tuple[LegTrace, int]] = deque()  # and when they came
        self._view: View | None = None
        self._asking = threading.Lock()
        self._fault: BaseException | None = None
        self._server = self._thread("page-server", self._site.serve_forever)
        self._feeder = self._thread("page-feeder", self._feed)
        self._asker = self._thread("page-asker", self._poll_traces)
        for thread in (self._server, self._feeder, self._asker):
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def url(self) -> str:
        """Return the page's address for a browser; it has the token where one is needed."""
        return self._site.url

    def waits_for(self, what: str, remedy: str, level: Level = "error") -> None:
        """Show why there is nothing to see, until :meth:`show_service`, and what to do."""
        self._waiting = Finding(level, None, what, remedy)

    def show_service(self, link: Link) -> None:
        """Show the service behind a link, which its owner closes after the page."""
        self._reader = TraceReader(link)
        self._link = link

    def wait(self, until: threading.Event | None = None) -> None:
        """Wait for an event or the end of the page; what failed in one of its threads is raised."""
        while not self._stop.wait(0.2) and not (until and until.is_set()):
            pass
        if self._fault is not None:
            raise self._fault

    def leave(self) -> None:
        """Ask the link no more; what has been shown stays."""
        self._stop.set()
        self._feeder.join(_END_S)
        self._asker.join(_END_S)
        if self._recordings is not None:
            self._recordings.stop()

    def close(self, farewell: str | None = None) -> None:
        """End all threads; calling it twice is safe.

        Args:
            farewell: what browsers show from then on, where the page will not come back.
        """
        self.leave()
        if self._server.is_alive():
            self._site.history.end(farewell)
            # A browser that looks takes its last words within milliseconds.
            with self._site.lock:
                self._site.lock.wait_for(lambda: not self._site.streams, 0.5)
            self._site.shutdown()
            self._server.join(_END_S)
        self._site.server_close()

    def _thread(self, name: str, work: Callable[[], None]) -> threading.Thread:
        def run() -> None:
            try:
                work()
            except BaseException as fault:  # `wait` raises it
                self._fault = fault
                raise
            finally:
                self._stop.set()

        return threading.Thread(target=run, name=name, daemon=True)

    # -- the serving threads -------------------------------------------------------------------

    def _record(self, path: str, query: Mapping[str, str]) -> bytes:
        """Do one of :data:`~.server.ACTIONS`; return the state of the recording."""
        recordings = self._recordings
        if recordings is None:
            line = "this page records nothing; give `watch --web` a folder by --record-to"
            raise Refused(HTTPStatus.FORBIDDEN, line)
        try:
            if path == "/mark":
                recordings.mark(query.get("label", ""), self._wall_at(query.get("t", "")))
            elif path == "/record/stop":
                recordings.stop()
            else:
                recordings.start(self._link)
        except RecordingError as error:
            raise Refused(HTTPStatus.CONFLICT, str(error)) from error
        return msgspec.json.encode(recordings.state())

    def _wall_at(self, text: str) -> int:
        """Convert a time of the page, ms since its start, to the wall clock, ns."""
        now_ms = (time.monotonic_ns() - self._start_ns) // 1_000_000
        if not (
            text.isascii() and text.isdigit() and len(text) < 12 and int(text) <= now_ms + 1000
        ):
            raise Refused(HTTPStatus.BAD_REQUEST, "no time of this page; expected /mark?t=1200")
        return self._start_ns + self._wall_ns + int(text) * 1_000_000

    def _model(self, leg: str) -> bytes | None:
        if self._link is None:
            return None
        try:
            with self._asking:  # one question at a time, however many browsers ask
                replies = self._link.query(model_key(leg), timeout_s=0.5)
        except LinkError:
            return None
        for reply in replies:
            if reply.error is None:
                report = decode(reply.payload, ModelReport, reply.encoding)
                if not isinstance(report, Rejected):
                    return msgspec.json.encode(report)
        return None

    # -- the feeding thread --------------------------------------------------------------------

    def _feed(self) -> None:
        feed: Feed | None = None
        due_s = time.monotonic()
        statuses: dict[str, LearnerStatus] = {}
        while not self._stop.is_set():
            if feed is None and self._link is not None:
                feed = Feed(self._link, self._frames.contact)
            view = self._view
            if feed is not None:
                view = self._view = feed.view(time.monotonic_ns())
                self._frames.verdicts(feed.watch.pop_verdicts())
                statuses = feed.watch.statuses()
            for _ in range(len(self._traces)):
                self._frames.trace(*self._traces.popleft())
            table = self._table.encode(
                view,
                statuses,
                time.monotonic_ns(),
                waiting=self._waiting,
                recording=None if self._recordings is None else self._recordings.state(),
            )
            frame = self._frames.frame(time.monotonic_ns())
            self._site.history.push(frame, table)
            due_s = max(due_s + FRAME_S, time.monotonic())
            self._stop.wait(due_s - time.monotonic())

    # -- the asking thread ---------------------------------------------------------------------

    def _poll_traces(self) -> None:
        """Poll the service for the ticks since the last query, where one is there."""
        while not self._stop.wait(FRAME_S):
            view = self._view
            if self._reader is None or view is None or not view.alive or not view.connected:
                continue
            with contextlib.suppress(LinkError):
                traces = self._reader.query_new()
                self._traces.extend((trace, time.monotonic_ns()) for trace in traces)
