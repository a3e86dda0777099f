"""Learning a leg nobody has described: from nothing to a first model.

Until there is a model there is no alarm to tell a contact by, so only the cautious part of each
swing is taken (not its first ticks, not its last), and rows that no robust fit explains are left
out.  As soon as there are enough, and then with every few swings more, a fit is tried; it is taken
when its error on held-out swings is a small part of the motion.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from adaptive_contact.adapt.baseline import LegBaseline
from adaptive_contact.adapt.gather import cautious
from adaptive_contact.adapt.refit import Refitter
from adaptive_contact.adapt.training import Stretch, learn_leg
from adaptive_contact.detect import Tail
from adaptive_contact.detect.noise import WINDOWS
from adaptive_contact.errors import IdentificationError
from adaptive_contact.identify import Library
from adaptive_contact.robot import Leg

__all__ = ["ColdJob", "ColdResult", "ColdStart", "prior_tails"]

Array = NDArray[np.float64]

# Swings after which a fit is tried; then every TRY_EVERY more.
FIRST_TRY_SWINGS: Final = 20
TRY_EVERY: Final = 10
# Taken when the held-out error is below this share of the motion, in every joint that moves.
GOOD_SHARE: Final = 0.35
# A joint that moves less than this many quanta per tick needs no model to be good.
STILL_QUANTA: Final = 2.0
# A cold start remembers this many samples: ten minutes at 50 Hz.
MAX_SAMPLES: Final = 30_000
# Shape of a tail fitted to few ticks is worthless; the pooled one of the shipped baselines is 0 to
# 0.1, and the heavier end costs a third more threshold.
PRIOR_SHAPE: Final = 0.1


def prior_tails(joints: int) -> tuple[Tail, ...]:
    """Tails of the statistic for a leg with too few free ticks of its own.

    Gaussian residuals make it chi-square with J degrees of freedom; its tail beyond 1 % is taken a
    little heavier, as real ones are.
    """
    rate = 0.01
    level = float(stats.chi2.isf(rate, joints))
    # Mean excess of the chi-square tail over its level.
    beyond = stats.chi2.isf(rate * (np.arange(200) + 0.5) / 200, joints)
    scale = float(np.mean(beyond) - level)
    return tuple(Tail(level, rate, scale, PRIOR_SHAPE, 0) for _ in WINDOWS)


@dataclasses.dataclass(frozen=True)
class ColdResult:
    """What a try gave.

    Attributes:
        known: the leg's first model, None if it was not good enough.
        reason: one line.
    """

    number: int
    known: LegBaseline | None
    reason: str


@dataclasses.dataclass(frozen=True)
class ColdJob:
    """A first fit, to be done anywhere."""

    leg: str
    number: int
    described: Leg
    library: Library
    stretches: tuple[Stretch, ...]
    quantum_rad: float

    def run(self) -> ColdResult:
        """Fit, and say whether it is good."""
        try:
            known, figures, _ = learn_leg(
                self.described, self.library, self.stretches, self.quantum_rad, None
            )
        except IdentificationError as error:
            return ColdResult(self.number, None, str(error))
        naive, held_out = np.array(figures.naive_rms), np.array(figures.held_out_rms)
        moving = naive > STILL_QUANTA * self.quantum_rad
        share = float(np.max(held_out[moving] / naive[moving])) if moving.any() else 1.0
        words = f"held-out error {share:.2f} of the motion after {figures.swings} swings"
        if share > GOOD_SHARE:
            return ColdResult(self.number, None, f"not good enough yet: {words}")
        return ColdResult(self.number, known, f"first model: {words}")


class ColdStart:
    """Collects samples until a first model can be fitted.

    Args:
        leg: its description.
        library: the terms to choose from.
        quantum_rad: position step.

    Attributes:
        swings: seen so far.
        samples: held.
    """

    def __init__(self, leg: Leg, library: Library, quantum_rad: float) -> None:
        self.swings = 0
        self._leg = leg
        self._library = library
        self._quantum = quantum_rad
        self.samples = 0
        self._runs: list[list[tuple[list[float], list[float], bool, bool]]] = [[]]
        self._next_try = FIRST_TRY_SWINGS
        self._jobs = 0
        self._pending: int | None = None

    def interrupt(self) -> None:
        """The stream broke off here."""
        if self._runs[-1]:
            self._runs.append([])

    def add(self, measured: list[float], desired: list[float], *, swing: bool, sound: bool) -> None:
        """Take in a sample."""
        run = self._runs[-1]
        if run and run[-1][2] and not swing:
            self.swings += 1
        run.append((measured, desired, swing, sound))
        self.samples += 1
        while self.samples > MAX_SAMPLES:
            if len(self._runs) > 1 and not self._runs[0]:
                self._runs.pop(0)
            else:
                self.samples -= len(self._runs[0][: MAX_SAMPLES // 10])
                del self._runs[0][: MAX_SAMPLES // 10]

    def poll(self, refitter: Refitter) -> ColdResult | None:
        """Hand in a fit when it is time; its result, once, when it is there."""
        if self._pending is None:
            job = self.job()
            if job is not None:
                self._pending = job.number
                refitter.submit(job)
            return None
        result = refitter.collect(self._leg.id, self._pending)
        if result is None:
            return None
        assert isinstance(result, ColdResult)
        self._pending = None
        return result

    def job(self) -> ColdJob | None:
        """A fit to try, when it is time."""
        if self.swings < self._next_try:
            return None
        self._next_try = self.swings + TRY_EVERY
        self._jobs += 1
        stretches = tuple(self._stretch(run) for run in self._runs if len(run) > 10)
        return ColdJob(self._leg.id, self._jobs, self._leg, self._library, stretches, self._quantum)

    def _stretch(self, run: list[tuple[list[float], list[float], bool, bool]]) -> Stretch:
        measured, desired, swing, sound = zip(*run, strict=True)
        mask = np.array(swing)
        return Stretch(np.array(measured), np.array(desired), mask, cautious(mask), np.array(sound))
