"""A recorder at work on a thread of this process, while something else goes on."""

from __future__ import annotations

import threading
from typing import Self

from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.service.recording.recorder import Recorder


class Listening:
    """Records from the beginning of ``with`` to :meth:`end`, or to the end of ``with``.

    Args:
        recorder: subscribed; its writer is used by the thread until the end.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._stop = threading.Event()
        self._failure: AdaptiveContactError | None = None
        self._thread = threading.Thread(target=self._work, name="record")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def check(self) -> None:
        """Raise what stopped it before its time, if anything did.

        Raises:
            RecordingError: the recording cannot be written.
        """
        if self._failure is not None:
            raise self._failure

    def end(self) -> None:
        """Stop; everything heard so far is written then.

        Raises:
            RecordingError: it is not.
        """
        self._stop.set()
        self._thread.join()
        self.check()

    def _work(self) -> None:
        try:
            self._recorder.run(self._stop)
        except AdaptiveContactError as error:
            self._failure = error
