"""Learns the first model of a leg that has no baseline.

Until there is a model there is no alarm to detect a contact, so only the cautious part of each
swing is taken (not its first ticks, not its last), and what touches there all the same is trimmed
(:mod:`adaptive_contact.fit.outliers`).  As soon as there are enough, and then with every few
swings more, a fit is tried; it is taken when its error on held-out swings is a small part of the
motion.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri  # scipy.stats takes half a second to import

from adaptive_contact.errors import IdentificationError
from adaptive_contact.fit.refit_job import Refitter
from adaptive_contact.fit.train import LegFigures, Stretch, cautious, learn_leg
from adaptive_contact.model.library import Library
from adaptive_contact.model.model_file import LegBaseline
from adaptive_contact.model.noise import WINDOWS
from adaptive_contact.model.tail import Tail
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
FIRST_ROOM: Final = 500  # samples; doubled when they are full
# A run of fewer is not learned from.
LEAST_SAMPLES: Final = 11
# Shape of a tail fitted to few ticks is worthless; the pooled one of the shipped baselines is 0 to
# 0.1, and the heavier end costs a third more threshold.
PRIOR_SHAPE: Final = 0.1


def prior_tails(joints: int) -> tuple[Tail, ...]:
    """Compute tails of the statistic for a leg with too few free ticks of its own.

    Gaussian residuals make it chi-square with J degrees of freedom; its tail beyond 1 % is taken a
    little heavier, as real ones are.
    """
    rate = 0.01
    level = float(chdtri(joints, rate))
    # Mean excess of the chi-square tail over its level.
    beyond = chdtri(joints, rate * (np.arange(200) + 0.5) / 200)
    scale = float(np.mean(beyond) - level)
    return tuple(Tail(level, rate, scale, PRIOR_SHAPE, 0) for _ in WINDOWS)


@dataclasses.dataclass(frozen=True)
class ColdResult:
    """Holds the result of one try.

    Attributes:
        known: the leg's first model, None if it was not good enough.
        reason: one line.
    """

    number: int
    known: LegBaseline | None
    reason: str


@dataclasses.dataclass(frozen=True)
class ColdJob:
    """Describes a first fit, to be run in any process."""

    leg: str
    number: int
    described: Leg
    library: Library
    stretches: tuple[Stretch, ...]
    quantum_rad: float

    def run(self) -> ColdResult:
        """Fit a first model, and tell whether it is good enough."""
        try:
            known, figures, _ = learn_leg(
                self.described, self.library, self.stretches, self.quantum_rad, None, first=True
            )
        except IdentificationError as error:
            return ColdResult(self.number, None, str(error))
        words = f"after {figures.swings} swings"
        judged = self._judge(figures)
        if judged is None:
            words = f"the leg moves too little per tick for its position step {words}"
            return ColdResult(self.number, None, f"not good enough yet: {words}")
        span, share = judged
        of = "the motion" if span == 1 else f"the motion of {span} ticks"
        words = f"held-out error {share:.2f} of {of} {words}"
        if share > GOOD_SHARE:
            return ColdResult(self.number, None, f"not good enough yet: {words}")
        return ColdResult(self.number, known, f"first model: {words}")

    def _judge(self, figures: LegFigures) -> tuple[int, float] | None:
        tick = np.array(figures.held_out_rms), np.array(figures.naive_rms)
        best = None
        for span, (held_out, naive) in {1: tick, **figures.spans}.items():
            moving = naive > STILL_QUANTA * self.quantum_rad
            if not moving.any():
                continue
            share = float(np.max(held_out[moving] / naive[moving]))
            if best is None or share < best[1]:
                best = span, share
            if span == 1 or share <= GOOD_SHARE:
                break
        return best


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
        self.swings = self.samples = 0
        self._leg = leg
        self._library = library
        self._quantum = quantum_rad
        # In arrays that grow: made in the tick that hands a job in, they would hold up all legs.
        self._angles = np.zeros((FIRST_ROOM, 2, len(leg.joints)))  # measured and desired
        self._flags = np.zeros((FIRST_ROOM, 2), dtype=bool)  # swing and sound
        self._starts = [0]  # of samples without a gap
        self._swung = False  # the sample before, of the same run
        self._next_try = FIRST_TRY_SWINGS
        self._jobs = 0
        self._pending: int | None = None

    @property
    def progress(self) -> str:
        """Progress to the next try, such as ``12 of 20 swings``."""
        if self._pending is not None:
            return f"a first model is being fitted to {self.swings} swings"
        return f"{self.swings} of {self._next_try} swings"

    def interrupt(self) -> None:
        """End the stretch of samples: the stream broke off here."""
        if self._starts[-1] < self.samples:
            self._starts.append(self.samples)
        self._swung = False

    def drop_newest(self, ticks: int) -> None:
        """Drop the newest samples, which turn out not to be of the leg."""
        self.samples = max(self.samples - ticks, self._starts[-1])
        self.interrupt()

    def add(self, measured: list[float], desired: list[float], *, swing: bool, sound: bool) -> None:
        """Take in a sample."""
        self.swings += self._swung and not swing
        self._swung = swing
        if self.samples == len(self._flags):
            self._make_room()
        self._angles[self.samples] = measured, desired
        self._flags[self.samples] = swing, sound
        self.samples += 1

    def _make_room(self) -> None:
        """For the next sample: twice as much, or what the oldest tenth leaves."""
        if self.samples < MAX_SAMPLES:
            more = min(self.samples, MAX_SAMPLES - self.samples)
            self._angles = np.concatenate([self._angles, np.zeros_like(self._angles[:more])])
            self._flags = np.concatenate([self._flags, np.zeros_like(self._flags[:more])])
            return
        gone = MAX_SAMPLES // 10
        self.samples -= gone
        for held in (self._angles, self._flags):
            held[: self.samples] = held[gone:].copy()
        moved = [start - gone for start in self._starts]
        # The run that begins before what is left begins with it.
        self._starts = [0, *(start for start in moved if start > 0)]

    def poll(self, refitter: Refitter) -> ColdResult | None:
        """Submit a fit when it is time; return its result, once, when it is there."""
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
        """Make the next job, when it is time."""
        if self.swings < self._next_try:
            return None
        self._next_try = self.swings + TRY_EVERY
        self._jobs += 1
        ends = [*self._starts[1:], self.samples]
        stretches = tuple(
            self._stretch(begin, end)
            for begin, end in zip(self._starts, ends, strict=True)
            if end - begin >= LEAST_SAMPLES
        )
        return ColdJob(self._leg.id, self._jobs, self._leg, self._library, stretches, self._quantum)

    def _stretch(self, begin: int, end: int) -> Stretch:
        measured, desired = self._angles[begin:end].transpose(1, 0, 2).copy()
        swing, sound = self._flags[begin:end].T.copy()
        return Stretch(measured, desired, swing, cautious(swing), sound, certain=False)
