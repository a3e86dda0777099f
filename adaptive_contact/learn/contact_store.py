"""Stores contacts that were reported, to try new models on.

A sparse refit is chosen on free ticks, which say nothing about what it would make of a touch: one
that explains how legs stop on the ground would win there, and detect no contact.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.model.glr import statistic
from adaptive_contact.model.labelled_swing import Touch

__all__ = ["StoredContacts"]

Array = NDArray[np.float64]

# As many as a minute of walking brings, half of them of the ground.
MOST: Final = 40


class StoredContacts:
    """Stores the newest contacts of one leg in its present era."""

    def __init__(self) -> None:
        self._kept: deque[tuple[Touch, ...]] = deque(maxlen=MOST)

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, ticks: Sequence[Touch]) -> None:
        """Store a contact, the ticks from its alarm on; the oldest goes if there are too many."""
        self._kept.append(tuple(ticks))

    def clear(self) -> None:
        """Drop all, as the leg has changed: they may have been the change."""
        self._kept.clear()

    def found(self, coefficients: Array) -> NDArray[np.bool_]:
        """Tell which of them a model reports, whatever happened before.

        In any of their ticks: an alarm that came too early, which a better model would not raise,
        is followed by the touch itself.

        Args:
            coefficients: (p, J).

        Returns:
            (n,), oldest first.
        """
        if not self._kept:
            return np.zeros(0, dtype=np.bool_)
        ticks = [touch for contact in self._kept for touch in contact]
        theta, target, whiten, limits, usable = map(np.array, zip(*ticks, strict=True))
        increment = theta @ coefficients
        said = statistic(target - increment, increment, whiten, usable)
        alarm = (np.nan_to_num(said.value) / limits).max(axis=-1) > 1.0
        begins = np.cumsum([0, *(len(contact) for contact in self._kept)])[:-1]
        return np.asarray(np.logical_or.reduceat(alarm, begins))
