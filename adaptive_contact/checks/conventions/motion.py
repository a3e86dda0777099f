"""Holds the motion of a robot's legs: samples as arrays, and the control tick of each."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.wire import ServoSample

# Where stamps and seq grow by amounts this far apart, s, another run of the source begins: no loop
# is as late.
MOST_ADRIFT_S: Final = 1.0
MOST_SEQ: Final = 2**60


@dataclasses.dataclass(frozen=True)
class LegMotion:
    """One leg's samples, in the frame of its description."""

    t_ns: Ints  # (n,) times
    measured: Array  # (n, J) rad
    desired: Array  # (n, J) rad
    swing: Mask | None = None  # (n,) as the source reports; None where it does not
    # (n,) the source's count of control ticks, from any number on; None where only stamps
    # distinguish them
    seq: Ints | None = None

    def between(self, first_ns: int, last_ns: int) -> LegMotion:
        """The samples from one time up to another."""
        rows = (self.t_ns >= first_ns) & (self.t_ns < last_ns)
        swing = None if self.swing is None else self.swing[rows]
        seq = None if self.seq is None else self.seq[rows]
        return LegMotion(self.t_ns[rows], self.measured[rows], self.desired[rows], swing, seq)

    @staticmethod
    def of_samples(samples: Sequence[ServoSample]) -> LegMotion:
        """The motion of accepted samples, in order and in the frame of the leg's description."""
        phase_given = all(sample.phase is not None for sample in samples)
        # Counted from the first one on, within what an array holds.
        seq = [max(-MOST_SEQ, min(one.seq - samples[0].seq, MOST_SEQ)) for one in samples]
        return LegMotion(
            np.array([sample.t_ns for sample in samples], dtype=np.int64),
            np.array([sample.measured for sample in samples], dtype=np.float64),
            np.array([sample.desired for sample in samples], dtype=np.float64),
            np.array([sample.phase == "swing" for sample in samples]) if phase_given else None,
            np.array(seq, dtype=np.int64),
        )


def control_ticks(motions: Mapping[str, LegMotion], period_s: float) -> dict[str, Ints]:
    """Number the control tick of every sample, alike for all legs.

    Within a run of the source a leg's ticks are counted by ``seq``, so that stamps that jitter
    shift none.  The offset between the counts of two legs follows from the median of their stamps
    over the time that both have.

    Args:
        motions: by leg.
        period_s: the control tick.

    Returns:
        (n,) per leg.
    """
    runs = {leg: _runs(motion, period_s) for leg, motion in motions.items() if len(motion.t_ns)}
    if not runs:
        return {}
    first = max(runs, key=lambda leg: len(motions[leg].t_ns))
    for run in runs[first]:
        run.ticks = run.count + round(run.phase(*run.span))
    for leg, own in runs.items():
        for run in own if leg != first else ():
            shared = max(runs[first], key=lambda other: other.overlap(run))
            low, high = max(run.span[0], shared.span[0]), min(run.span[1], shared.span[1])
            if shared.overlap(run) > 0:
                between = run.phase(low, high) - shared.phase(low, high)
                run.ticks = run.count + int(shared.ticks[0] - shared.count[0]) + round(between)
            else:
                run.ticks = run.count + round(run.phase(*run.span))
    return {leg: np.concatenate([run.ticks for run in own]) for leg, own in runs.items()}


class _Run:
    """Samples of one leg that one count goes through.

    Attributes:
        count: (n,) ticks from any number on.
        span: first and last stamp, ticks.
        ticks: (n,) ticks, alike for all legs, once they are known.
    """

    def __init__(self, stamps: Array, count: Ints) -> None:
        self.count, self.ticks = count, count
        self._stamps = stamps
        self.span = float(stamps[0]), float(stamps[-1])

    def overlap(self, other: _Run) -> float:
        """Time that both have, ticks."""
        return min(self.span[1], other.span[1]) - max(self.span[0], other.span[0])

    def phase(self, low: float, high: float) -> float:
        """By how much the stamps of a time are ahead of the count, median, ticks."""
        rows = (self._stamps >= low) & (self._stamps <= high)
        rows = rows if rows.any() else np.ones_like(rows)
        return float(np.median(self._stamps[rows] - self.count[rows]))


def _runs(motion: LegMotion, period_s: float) -> list[_Run]:
    """A leg's samples, cut where its count restarts."""
    stamps = motion.t_ns / (period_s * 1e9)
    if motion.seq is None:
        return [_Run(stamps, np.rint(stamps).astype(np.int64))]
    steps = np.diff(motion.seq)
    lost = np.abs(np.diff(stamps) - steps) > MOST_ADRIFT_S / period_s
    cuts = np.flatnonzero((steps <= 0) | lost) + 1
    return [
        _Run(part, count)
        for part, count in zip(np.split(stamps, cuts), np.split(motion.seq, cuts), strict=True)
    ]
