"""Requests sparse refits of one leg, and promotes what they find or drops it.

The recursion follows coefficients, and cannot follow the slope of the servos' control law, which is
inside the terms.  A refit finds the slope by which the buffer's rows are the likeliest, and fits a
sparse model of it (:mod:`adaptive_contact.fit.refit_job`); it also finds a prior's
noise that is too small.  What it found to go on from is promoted.
"""

from __future__ import annotations

import math
import zlib
from typing import Final

from adaptive_contact.arrays import Array
from adaptive_contact.core.learn.replay_buffer import ReplayBuffer
from adaptive_contact.fit.refit_job import LEAST_GAIN, RefitJob, RefitResult, Refitter
from adaptive_contact.fit.sparse_regression import FitStatus
from adaptive_contact.model.bounds import is_count
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import Library, plain_of
from adaptive_contact.model.model_file import LegBaseline
from adaptive_contact.wire import RefitCounts

REFIT_EVERY_SWINGS: Final = 20
# Or after so long, for legs that step slowly.
REFIT_EVERY_S: Final = 30.0
# The first comes later by up to this share of that, for each leg its own: the fits of legs that
# walk together, one process's work, do not all fall into one step.
SPREAD: Final = 0.5
# Ticks after its snapshot at which a result takes effect, so that a replay, which waits for it,
# gives the same events as the live run, which does not.
REFIT_DUE_TICKS: Final = 50
MIN_ROWS_PER_TERM: Final = 4
# The newest rows that a refit is made of: fifty swings of a walk.
MOST_ROWS: Final = 1300
# Room for segments of an older state of the leg.
ROOM: Final = 1.6


def rows_for_refit(model: LegModel) -> int:
    """Compute how many rows a buffer must hold for refits of a model's library."""
    return math.ceil(ROOM * MIN_ROWS_PER_TERM * model.library.size)


def first_refit_after(leg: str) -> tuple[int, float]:
    """Compute after how many swings, or s, a leg's first refit is asked for."""
    later = 1.0 + SPREAD * zlib.crc32(leg.encode()) / 2**32
    return round(later * REFIT_EVERY_SWINGS), later * REFIT_EVERY_S


class PeriodicRefit:
    """Requests the refits of one leg.

    Args:
        leg: its id.
        library: of the model.
        quantum_rad: position step.
        refitter: does the work.
        prior_rms: (J,) rad, residuals that the prior expects; None for a leg with a baseline.
    """

    def __init__(
        self,
        leg: str,
        library: Library,
        quantum_rad: float,
        refitter: Refitter,
        prior_rms: Array | None = None,
    ) -> None:
        self._prior_rms = prior_rms
        self._leg, self._quantum = leg, quantum_rad
        self._library, self._needed = plain_of(library), MIN_ROWS_PER_TERM * library.size
        self._refitter = refitter
        self._swings = self._ticks = 0  # since the last refit was requested
        self._every_swings, self._every_s = first_refit_after(leg)
        self._at_once = False  # the leg has changed since
        self._jobs = 0
        self._pending = False  # the newest of them is
        self._counts = dict.fromkeys(("promoted", "refused", "rolled_back"), 0)
        self._reason: str | None = None
        self._wait: str | None = None

    @property
    def counts(self) -> RefitCounts:
        """Return the counts of refits, for the status."""
        reasons = "; ".join(filter(None, (self._reason, self._wait))) or None
        return RefitCounts(**self._counts, last_reason=reasons)

    def end_swing(self, buffer: ReplayBuffer, era: int, *, learned: bool) -> None:
        """Count a swing, and request a refit if one is due and there is enough to fit to.

        Args:
            buffer: confirmed segments.
            era: the present state of the leg.
            learned: some of the swing's ticks were confirmed.
        """
        self._swings += learned
        waited_s = self._ticks * self._library.period_s
        due = self._swings >= self._every_swings or waited_s >= self._every_s or self._at_once
        if self._pending or not due:
            return
        values = buffer.newest(era, MOST_ROWS)
        if len(values) < self._needed:
            self._wait = (
                f"waiting: {len(values)} free ticks of the leg as it is to fit to, "
                f"{self._needed} are needed"
            )
            return
        self._swings = self._ticks = 0
        self._every_swings, self._every_s = REFIT_EVERY_SWINGS, REFIT_EVERY_S
        self._at_once, self._pending, self._wait = False, True, None
        self._jobs += 1
        job = RefitJob(self._leg, self._jobs, values, self._library, self._quantum, self._prior_rms)
        self._refitter.submit(job)

    def tick(self) -> LegBaseline | None:
        """Collect a result that is due; return what is to be promoted."""
        self._ticks += 1
        if not self._pending or self._ticks <= REFIT_DUE_TICKS:
            return None
        result = self._refitter.collect(self._leg, self._jobs)
        if result is None:
            return None
        assert isinstance(result, RefitResult)
        self._pending = False
        why = self._objection(result)
        if why is None:
            self._counts["promoted"] += 1
            self._reason = f"promoted: {_found(result)}"
            return result.start
        self._counts["refused"] += 1
        self._reason = f"refused: {why}"
        return None

    def leg_changed(self) -> None:
        """Drop the refit under way, as the leg has changed; a new one does not wait."""
        self.drop()
        self._at_once = True

    def drop(self) -> None:
        """Drop the refit under way."""
        self._pending, self._wait = False, None

    def count_return(self, why: str) -> None:
        """Count a return to an earlier model."""
        self._counts["rolled_back"] += 1
        self._reason = f"rolled back: {why}"

    def snapshot(self) -> dict[str, object]:
        """Return the counts, for :meth:`restore`."""
        return {**self._counts, "reason": self._reason}

    def restore(self, saved: object) -> None:
        """Take over what was saved; what does not fit is left out."""
        if not isinstance(saved, dict):
            return
        for name in self._counts:
            if is_count(saved.get(name)):
                self._counts[name] = saved[name]
        reason = saved.get("reason")
        self._reason = reason if isinstance(reason, str) else None

    def _objection(self, result: RefitResult) -> str | None:
        """Return why a refit is not promoted; None for one that is."""
        if result.status is not FitStatus.OK:
            return f"the fit ended with '{result.status}'"
        if result.start is not None:
            return None
        if result.slope_rad == self._library.slope_rad:
            return f"no slope fits better than {self._library.slope_rad:.3g} rad"
        return f"{_slope(result)} fits hardly better ({result.gain:.0f} nats)"


def _slope(result: RefitResult) -> str:
    return f"a slope of {result.slope_rad:.3g} rad"


def _found(result: RefitResult) -> str:
    if result.gain >= LEAST_GAIN:
        return f"{_slope(result)} fits better by {result.gain:.0f} nats"
    return f"errors are {result.level**0.5:.1f} times those that were expected"
