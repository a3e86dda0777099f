"""From scores to contact events: loaded, free, contact.

The phase gates and never causes: outside a swing nothing is decided, and no event rests on the
edge from swing to stance or on a stream that ends.

A swing begins *loaded*: after a pressed stance the foot comes off the ground 100 ms and more
after its command does, and until then residuals say nothing about the swing.  It is *free* once
the leg has followed the free model for :data:`CALM_TICKS`, in every direction, or when the
descent begins.  Only a free leg can touch.  A contact ends in the next swing when the leg is
free, or within its own swing when the leg has followed the model again for :data:`REARM_TICKS`.
"""

from __future__ import annotations

import dataclasses
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["CALM_SCORE", "CALM_TICKS", "ContactState", "Decision", "onset_fraction"]

Array = NDArray[np.float64]

# A tick is calm when its distance from the free model is below this share of the threshold: one
# free tick in a thousand is not, while a foot let go of is at several times the threshold.
CALM_SCORE: Final = 0.5
# Calm ticks in a row that show a foot to be off the ground.  A foot about to leave it may look
# calm for one tick, while the push along and the pull back cancel.
CALM_TICKS: Final = 3
# And within a swing, after a contact, one more.
REARM_TICKS: Final = 4


class Decision(NamedTuple):
    """A change of state.

    Attributes:
        contact: the new state.
        onset_ns: estimated time of the physical change.
        score: that decided.
    """

    contact: bool
    onset_ns: int
    score: float


@dataclasses.dataclass
class ContactState:
    """State machine of one leg.

    Attributes:
        contact: whether the leg is held to touch.
        loaded: whether the foot may still be on the ground from the stance before.
    """

    contact: bool = False
    loaded: bool = True
    _calm: int = 0
    _calm_since_ns: int = 0

    def reset(self) -> None:
        """Forget; the source started anew."""
        self.contact, self.loaded, self._calm = False, True, 0

    def begin_swing(self) -> None:
        """The command lifts off; the foot may not have yet."""
        self.loaded, self._calm = True, 0

    def swing_tick(
        self, score: float, distance: float, t_ns: int, onset_ns: int, *, descending: bool
    ) -> Decision | None:
        """Judge a swing tick.

        Args:
            score: statistic over threshold; NaN when nothing can be said, which changes nothing.
            distance: from the free model in any direction, over the threshold.
            t_ns: of the tick.
            onset_ns: when the touch began, should this be one.
            descending: the command is past the lift: what holds the leg now is no stance.

        Returns:
            The change of state, if there is one.
        """
        if score != score:
            return None
        self._calm = self._calm + 1 if distance < CALM_SCORE else 0
        if self._calm == 1:
            self._calm_since_ns = t_ns
        if self.loaded:
            if self._calm < CALM_TICKS and not descending:
                return None
            self.loaded = False
            return self._release(t_ns, score)
        if self.contact:
            return self._release(t_ns, score) if self._calm >= REARM_TICKS else None
        if score <= 1.0:
            return None
        self.contact, self._calm = True, 0
        return Decision(contact=True, onset_ns=onset_ns, score=score)

    def _release(self, t_ns: int, score: float) -> Decision | None:
        if not self.contact:
            return None
        self.contact = False
        return Decision(
            contact=False, onset_ns=self._calm_since_ns if self._calm else t_ns, score=score
        )


def onset_fraction(residual: Array, increment: Array) -> float:
    """Share of a tick that a stopped leg did not move, for the onset's place within the tick.

    A leg that stops dead a share f before the end of the tick misses that share of its predicted
    movement: f is the projection of the residual on it.

    Args:
        residual: (J,) rad at the first tick of the deciding window.
        increment: (J,) rad, predicted.

    Returns:
        f in 0 .. 1.
    """
    power = float(increment @ increment)
    if power <= 0.0:
        return 1.0
    return float(np.clip(-(residual @ increment) / power, 0.0, 1.0))
