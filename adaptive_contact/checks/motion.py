"""Holds the motion of a robot's legs: samples as arrays, and the control tick of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.wire import ServoSample

# Where stamps and seq grow by amounts this far apart, s, another run of the source begins: no loop
# is as late.
MOST_ADRIFT_S: Final = 1.0
MOST_SEQ: Final = 2**60
MOST_NS: Final = 2**63 - 1


class LegMotion(NamedTuple):
    """Holds one leg's samples in a row, the newest last, in the frame of its description."""

    t_ns: Ints  # (n,) times
    seq: Ints  # (n,) the source's count of control ticks, from any number on
    measured: Array  # (n, J) rad
    desired: Array  # (n, J) rad
    swing: Mask | None = None  # (n,) whether the leg is in a swing; None where that is not known

    def part(self, rows: slice | Mask) -> LegMotion:
        """Return some of the samples."""
        swing = None if self.swing is None else self.swing[rows]
        return LegMotion(
            self.t_ns[rows], self.seq[rows], self.measured[rows], self.desired[rows], swing
        )

    def between(self, first_ns: int, last_ns: int) -> LegMotion:
        """Return the samples from one time up to another."""
        return self.part((self.t_ns >= first_ns) & (self.t_ns < last_ns))

    @staticmethod
    def from_samples(samples: Sequence[ServoSample]) -> LegMotion:
        """Return the motion of samples of as many joints, in the frame of the leg's description."""
        phase_given = all(sample.phase is not None for sample in samples)
        # Counted from the first one on; both within what an array holds.
        seq = [max(-MOST_SEQ, min(one.seq - samples[0].seq, MOST_SEQ)) for one in samples]
        t_ns = [max(-MOST_NS, min(one.t_ns, MOST_NS)) for one in samples]
        return LegMotion(
            np.array(t_ns, dtype=np.int64),
            np.array(seq, dtype=np.int64),
            np.array([sample.measured for sample in samples], dtype=np.float64),
            np.array([sample.desired for sample in samples], dtype=np.float64),
            np.array([sample.phase == "swing" for sample in samples]) if phase_given else None,
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
    known = np.concatenate([stamps for stamps, _ in runs[first]])
    ticks = np.concatenate([count + _ahead(stamps, count) for stamps, count in runs[first]])
    order = np.argsort(known)
    found = {first: ticks}
    for leg in [leg for leg in runs if leg != first]:
        parts = []
        for stamps, count in runs[leg]:
            rows = (stamps >= known.min()) & (stamps <= known.max())
            at = np.interp(stamps[rows], known[order], ticks[order]) if rows.any() else stamps
            parts.append(count + _ahead(at, count[rows] if rows.any() else count))
        found[leg] = np.concatenate(parts)
    return found


def _ahead(ticks: Array, count: Ints) -> int:
    """By how much ticks are ahead of a count, most of the time."""
    return round(float(np.median(ticks - count)))


def _runs(motion: LegMotion, period_s: float) -> list[tuple[Array, Ints]]:
    """Stamps, in ticks, and the count of a leg's samples, cut where the count restarts."""
    stamps = motion.t_ns / (period_s * 1e9)
    steps = np.diff(motion.seq)
    lost = np.abs(np.diff(stamps) - steps) > MOST_ADRIFT_S / period_s
    cuts = np.flatnonzero((steps <= 0) | lost) + 1
    return list(zip(np.split(stamps, cuts), np.split(motion.seq, cuts), strict=True))
