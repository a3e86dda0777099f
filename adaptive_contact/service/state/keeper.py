"""Schedules saving and restoring of state; a thread waits for the disk.

The worker takes a snapshot, one leg at a time and only when no sample waits; the thread packs
it, writes it and syncs it.  A disk that is slower than the snapshots come gets the newest of
each leg; a disk that fails, or a folder that cannot be had (read-only, in use), is counted,
reported, and tried again with the next snapshot.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from adaptive_contact.service.logs import LogThrottle
from adaptive_contact.service.state.format import Identity, Position, Record, Refused
from adaptive_contact.service.state.store import StateStore
from adaptive_contact.status import StateFacts

if TYPE_CHECKING:
    from adaptive_contact.core.leg_learner import ContactLearner
    from adaptive_contact.service.leg_endpoint import LegEndpoint

_log = structlog.get_logger()

SAVE_PERIOD_S: Final = 10.0
# Refusals listed in ServiceStatus; more than a robot has legs would not fit its 4 kB.
_MOST: Final = 4
_ERROR_LINE: Final = 320


class _Last(NamedTuple):
    """Holds what was last saved of a leg, and when the next save is due."""

    due_ns: int
    samples: int
    model_version: int | None  # None until the leg is looked at


class StateKeeper:
    """Saves and restores the learners of one service.

    Args:
        store: where to; closed by :meth:`close`.
        robot: name of the robot.
        settings: digest of a leg's settings, by its id.
        package: version of this package.
        period_s: between two saves of a leg.
    """

    def __init__(
        self,
        store: StateStore,
        robot: str,
        settings: Callable[[str], str],
        *,
        package: str = "",
        period_s: float = SAVE_PERIOD_S,
    ) -> None:
        self._store = store
        self._robot = robot
        self._settings = settings
        self._package = package
        self._period_ns = int(period_s * 1e9)
        self._identities: dict[str, Identity] = {}
        self._last: dict[str, _Last] = {}
        self._restored: list[str] = []
        self._refused: list[str] = []
        self._saved = 0
        self._failed = 0
        self._error: str | None = store.trouble
        self._counting = threading.Lock()  # the worker and the thread both see failures
        self._throttle = LogThrottle(60.0)
        self._waiting: dict[str, Record] = {}
        self._under_way: str | None = None  # leg of a write
        self._ending = False
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        if store.trouble is not None:
            _log.warning("state is not saved", why=store.trouble)
        if store.exposed is not None:
            _log.warning("state is open to others", what=store.exposed)

    @property
    def facts(self) -> StateFacts:
        """Return folder, counts and errors, as the status publishes them."""
        more = len(self._refused) - _MOST
        error = self._error
        return StateFacts(
            folder=self._store.shown,
            restored=self._restored,
            refused=self._refused[:_MOST] + ([f"{more} more, as the log says"] if more > 0 else []),
            saved=self._saved,
            failed=self._failed,
            error=None if error is None else error[:_ERROR_LINE],
            exposed=None if self._store.exposed is None else self._store.exposed[:_ERROR_LINE],
        )

    def restore(
        self, leg: str, learner: ContactLearner, library: str, now_ns: int
    ) -> Position | None:
        """Restore a new learner from its newest sound state, if there is one.

        Returns:
            Where its source was; None without a state.
        """
        identity = Identity(self._robot, leg, library, self._settings(leg))
        self._identities[leg] = identity
        # Staggered, so that no two legs are saved in one tick.
        share = (len(self._identities) % 7 + 1) / 8
        self._last[leg] = _Last(now_ns + int(self._period_ns * share), 0, None)
        for path, found in self._store.candidates(identity):
            why = found.why if isinstance(found, Refused) else learner.restore(found.body)
            if why is None and isinstance(found, Record):
                age_s = max(0.0, (time.time_ns() - found.saved_ns) / 1e9)
                _log.info(
                    "state restored",
                    leg=leg,
                    model_version=found.model_version,
                    age_s=round(age_s, 1),
                )
                self._restored.append(leg)
                if found.seq is None:
                    return None
                return Position(found.run, found.seq, found.missed_down, found.superseded)
            why = " ".join(str(why).split())[:160]
            _log.warning("state refused", leg=leg, file=path.name, why=why)
            self._refused.append(f"{path.name}: {why}")
            self._store.set_aside(path)
        return None

    def due(self, endpoint: LegEndpoint, now_ns: int) -> bool:
        """Return whether a leg should be saved: a new model, or 10 s of samples since the last."""
        last = self._last.get(endpoint.leg)
        if last is None:
            return False
        if last.model_version is None:  # what it started or went on with is no promotion
            last = self._last[endpoint.leg] = last._replace(model_version=endpoint.model_version)
        if endpoint.received_samples == last.samples:
            return False
        return endpoint.model_version != last.model_version or now_ns >= last.due_ns

    def snapshot(self, endpoint: LegEndpoint, now_ns: int) -> None:
        """Snapshot a leg for the thread to save."""
        self._last[endpoint.leg] = _Last(
            now_ns + self._period_ns, endpoint.received_samples, endpoint.model_version
        )
        try:
            body = endpoint.learner.snapshot()
        except Exception as error:  # a fault in one leg's learning must not end the others' service
            self._fail(endpoint.leg, error)
            return
        position = endpoint.position
        record = Record(
            identity=self._identities[endpoint.leg],
            saved_ns=time.time_ns(),
            package=self._package,
            model_version=endpoint.model_version,
            run=None if position is None else position.run,
            seq=None if position is None else position.seq,
            missed_down=0 if position is None else position.missed_down,
            superseded=() if position is None else position.superseded,
            body=body,
        )
        with self._changed:
            self._waiting[endpoint.leg] = record  # replaces one that still waits
            self._changed.notify_all()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="state", daemon=True)
            self._thread.start()

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything taken is on disk; False when it is not in time."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not self._waiting and self._under_way is None, timeout_s
            )

    # A memory card takes seconds for a file, now and then; a disk that hangs must not hold the end
    # up until the service is killed (TimeoutStopSec, 10 s).
    def close(self, timeout_s: float = 4.0) -> None:
        """Write what waits, as far as time allows, and unlock the folder."""
        if not self.flush(timeout_s):
            with self._changed:
                late = " ".join(sorted({*self._waiting, self._under_way or ""} - {""}))
            _log.warning("state not saved in time, the one before it stays", legs=late)
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(0.1)
        self._store.close()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._waiting) or self._ending)
                if self._ending:
                    return
                leg = next(iter(self._waiting))
                record = self._waiting.pop(leg)
                self._under_way = leg
            try:
                self._write(leg, record)
            finally:
                with self._changed:
                    self._under_way = None
                    self._changed.notify_all()

    def _write(self, leg: str, record: Record) -> None:
        try:
            self._store.save(record)
        except Exception as error:  # must not end this thread for the other legs
            # A full or failing disk; or a learner that put something into its snapshot that is
            # no plain value or fits no file.
            self._fail(leg, error)
            return
        self._saved += 1
        if self._error is not None:
            _log.info("state is saved again", leg=leg)
        self._error = None

    def _fail(self, leg: str, error: Exception) -> None:
        """Count a state that was not saved, and say so now and then."""
        why = (error.strerror if isinstance(error, OSError) else None) or str(error)
        why = self._store.trouble or (why or type(error).__name__).lower()
        with self._counting:
            self._failed += 1
            self._error = self._store.trouble or f"{leg} not saved in {self._store.shown}: {why}"
            self._throttle.warn("failed", time.monotonic_ns(), "state not saved", leg=leg, why=why)
