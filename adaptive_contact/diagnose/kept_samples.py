"""Reads the newest samples of one leg, which its ticks keep, for judgements of a whole motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.detect.layout import KEPT
from adaptive_contact.detect.leg_batch import LegPlace
from adaptive_contact.wire import ServoSample


class KeptSamples(NamedTuple):
    """Holds copies of n samples in a row."""

    # t_ns, seq: (n,) of each
    t_ns: Ints
    seq: Ints
    # measured, desired: (n, J) rad
    measured: Array
    desired: Array
    # (n,) whether the leg was in a swing, by its source; None where that is silent
    swing: Mask | None

    @classmethod
    def of(cls, place: LegPlace, most: int = KEPT) -> KeptSamples:
        """Copy the newest samples of a leg since its source began, so many at most."""
        count = place.leg.kept_n
        at = np.arange(max(count - most, 0), count) % KEPT
        t_ns, seq, phase = place.batch.kept_stamps[place.row, at].T
        measured, desired = np.split(place.batch.kept_angles[place.row, at], 2, axis=1)
        swing = None if (phase < 0).any() else phase == 1
        return cls(t_ns.copy(), seq.copy(), measured.copy(), desired.copy(), swing)

    @classmethod
    def first(cls, samples: Sequence[ServoSample]) -> KeptSamples:
        """Take as many from the beginning of a recording, of one leg in its description's frame."""
        samples = samples[:KEPT]
        phases = [sample.phase for sample in samples]
        return cls(
            np.array([sample.t_ns for sample in samples]),
            np.array([sample.seq for sample in samples]),
            np.array([sample.measured for sample in samples]),
            np.array([sample.desired for sample in samples]),
            None if None in phases else np.array([phase == "swing" for phase in phases]),
        )
