"""Asks for sparse refits of one leg, judges what they find on new ticks, keeps the training domain.

The recursion follows coefficients, and cannot follow the slope of the servos' control law, which is
inside the terms.  A refit finds the slope by which the buffer's rows are the likeliest, and fits a
sparse model of it (:mod:`adaptive_contact.fit.refit_job`).  Where that says that the slope is
another, both models predict the next confirmed rows, which neither has learned yet.  The refit
takes its place where it does not predict these worse.  There is no other rule.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.fit.refit_job import RefitJob, RefitResult, Refitter, factor_of
from adaptive_contact.fit.sparse_regression import FitStatus
from adaptive_contact.learn.replay_buffer import ReplayBuffer
from adaptive_contact.model.bounds import is_count
from adaptive_contact.model.labelled_swing import Row
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import Library, plain_of
from adaptive_contact.model.model_file import LegBaseline
from adaptive_contact.model.training_domain import Domain
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
# By so much the rows have to be likelier (the logarithm).  Where the slope is right no other gains;
# where none is, neighbours differ by up to 38; off by 4 it is 30 to 600 (decision 55).
LEAST_GAIN: Final = 40.0
JUDGED_ROWS: Final = 200  # new ones
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
    """Requests and judges the refits of one leg.

    Args:
        leg: its id.
        library: of the model.
        noise: (J,) rad.
        quantum_rad: position step.
        refitter: does the work.
        domain: where the baseline's model has been; None if that is not known.

    Attributes:
        domain: where the leg has been: the baseline's, widened by the newest refit.
    """

    def __init__(
        self,
        leg: str,
        library: Library,
        noise: Array,
        quantum_rad: float,
        refitter: Refitter,
        domain: Domain | None = None,
    ) -> None:
        self.domain = self._of_baseline = domain
        self._leg, self._noise, self._quantum = leg, noise, quantum_rad
        self._library, self._whole = plain_of(library), library.size
        self._refitter = refitter
        self._swings = self._ticks = 0  # since the last refit was asked for
        self._every_swings, self._every_s = first_refit_after(leg)
        self._at_once = False  # the leg has changed since
        self._jobs = 0
        self._pending: int | None = None  # job
        self._judged: LegBaseline | None = None
        self._gains: list[float] = []  # of the rows so far, noise variances
        self._counts = dict.fromkeys(("promoted", "refused", "rolled_back"), 0)
        self._reason: str | None = None
        self._wait: str | None = None

    @property
    def counts(self) -> RefitCounts:
        """Counts of refits, for the status."""
        reasons = "; ".join(filter(None, (self._reason, self._wait))) or None
        return RefitCounts(**self._counts, last_reason=reasons)

    def swing_done(self, period_s: float, *, learned: bool = True) -> bool:
        """Count a swing; return whether it is time to :meth:`request` a refit.

        Args:
            period_s: control tick.
            learned: some of its ticks were confirmed.
        """
        self._swings += learned
        if self._pending is not None or self.judging:
            return False
        waited_s = self._ticks * period_s
        return self._swings >= self._every_swings or waited_s >= self._every_s or self._at_once

    def request(self, buffer: ReplayBuffer, era: int) -> None:
        """Request a refit if there is enough to fit to.

        Args:
            buffer: confirmed segments.
            era: the present state of the leg.
        """
        values, needed = buffer.newest(era, MOST_ROWS), MIN_ROWS_PER_TERM * self._whole
        if len(values) < needed:
            self._wait = (
                f"waiting: {len(values)} free ticks of the leg as it is to fit to, "
                f"{needed} are needed"
            )
            return
        self._swings = self._ticks = 0
        self._every_swings, self._every_s = REFIT_EVERY_SWINGS, REFIT_EVERY_S
        self._at_once, self._wait = False, None
        self._pending = self._jobs = self._jobs + 1
        self._refitter.submit(
            RefitJob(self._leg, self._jobs, values, self._library, self._quantum, self._of_baseline)
        )

    def tick(self) -> bool:
        """Collect a result that is due; True if one came."""
        self._ticks += 1
        if self._pending is None or self._ticks <= REFIT_DUE_TICKS:
            return False
        result = self._refitter.collect(self._leg, self._pending)
        if result is None:
            return False
        assert isinstance(result, RefitResult)
        self._pending = None
        if result.status is not FitStatus.OK:
            self._refuse(f"the fit ended with '{result.status}'")
            return True
        self.domain = result.domain
        if result.start is None:
            self._refuse(f"no slope fits better than {self._library.slope_rad:.3g} rad")
        elif result.gain < LEAST_GAIN:
            self._refuse(f"{self._found(result.start)} fits hardly better ({result.gain:.0f} nats)")
        else:
            self._judged, self._gains = result.start, []
        return True

    @property
    def judging(self) -> bool:
        """Whether a refit is being judged, by :meth:`judge`."""
        return self._judged is not None

    def judge(self, row: Row, off: Sequence[float]) -> LegBaseline | None:
        """Judge the refit on a new row; return it once it has won.

        Args:
            row: of a confirmed tick.
            off: (J,) how far the model in force was off there, over the noise.
        """
        start = self._judged
        if start is None:
            return None
        window = self._library.window_of(row.theta[: self._library.size])
        moved = start.model.library.evaluate_flat(window) @ start.model.coefficients
        after = np.square((row.target - moved) / self._noise)
        # One wild reading must not decide.
        gain = np.minimum(np.square(off), 25.0) - np.minimum(after, 25.0)
        self._gains.append(float(gain.mean()))
        if len(self._gains) < JUDGED_ROWS:
            return None
        mean, self._judged = float(np.mean(self._gains)), None
        words = f"{self._found(start)}, {mean:+.3f} noise variances better on new ticks"
        if not mean >= 0.0:  # NaN is not
            self._refuse(words)
            return None
        self._counts["promoted"] += 1
        self._reason = f"promoted: {words}"
        return start

    def leg_changed(self) -> None:
        """Drop the refit under way, as the leg has changed; a new one does not wait."""
        self.drop()
        self._at_once = True
        self.domain = self._of_baseline

    def drop(self) -> None:
        """Drop the refit under way."""
        self._pending = self._judged = self._wait = None

    def resume(self, buffer: ReplayBuffer, era: int) -> None:
        """Widen the training domain by a restored buffer."""
        values = buffer.newest(era, MOST_ROWS)
        if self._of_baseline is not None and len(values):
            self.domain = self._of_baseline.widened(factor_of(values, len(self._noise)))

    def rolled_back(self, why: str) -> None:
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

    def _found(self, start: LegBaseline) -> str:
        return f"a slope of {start.model.library.slope_rad:.3g} rad"

    def _refuse(self, why: str) -> None:
        """Count a refit that is not put in force, and keep the reason."""
        self._counts["refused"] += 1
        self._reason = f"refused: {why}"
