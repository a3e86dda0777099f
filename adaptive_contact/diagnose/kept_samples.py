"""Samples of one leg, kept until the motion in them is judged."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.wire import Phase

Array = NDArray[np.float64]


class KeptSamples:
    """Samples in a row.

    Plain arrays of Python's: a row is added in every tick, and nearly never looked at.

    Args:
        joints: J of the leg.
    """

    def __init__(self, joints: int) -> None:
        self._joints = joints
        self._angles = array("d")
        self._times, self._seq, self._phases = array("q"), array("q"), array("b")

    def __len__(self) -> int:
        return len(self._times)

    def add(self, angles: Array, t_ns: int, seq: int, phase: Phase | None) -> None:
        """Keep one more: (2 J,) rad, measured and desired."""
        self._angles.frombytes(angles.tobytes())
        self._times.append(t_ns)
        self._seq.append(seq)
        self._phases.append(-1 if phase is None else phase == "swing")

    def drop(self, first: int) -> None:
        """Drop the oldest, so many."""
        del self._angles[: 2 * self._joints * first]
        del self._times[:first], self._seq[:first], self._phases[:first]

    def clear(self) -> None:
        """Drop all."""
        self.drop(len(self))

    @property
    def measured(self) -> Array:
        """(n, J) rad, as a copy."""
        return self._of_angles()[:, : self._joints].copy()

    @property
    def desired(self) -> Array:
        """(n, J) rad, as a copy."""
        return self._of_angles()[:, self._joints :].copy()

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """(n,) as a copy."""
        return np.array(self._times, dtype=np.int64)

    @property
    def seq(self) -> NDArray[np.int64]:
        """(n,) as a copy."""
        return np.array(self._seq, dtype=np.int64)

    @property
    def swing(self) -> NDArray[np.bool_] | None:
        """(n,) whether the leg was in a swing, by its source; None where that is silent."""
        phases = np.array(self._phases, dtype=np.int8)
        return None if (phases < 0).any() else phases == 1

    def _of_angles(self) -> Array:
        return np.array(self._angles, dtype=np.float64).reshape(-1, 2 * self._joints)
