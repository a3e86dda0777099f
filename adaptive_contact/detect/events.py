"""From scores to contact events: free, contact, released at lift-off.

The phase gates and never causes: outside a swing nothing is decided, and no event rests on the
edge from swing to stance or on a stream that ends.  A contact ends when the next swing lifts off,
or within its swing when the leg has moved freely again for :data:`REARM_TICKS`.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["REARM_TICKS", "ContactState", "Decision", "onset_fraction"]

Array = NDArray[np.float64]

# A leg that follows the free model for so long within a swing touches nothing any more.
REARM_TICKS: Final = 4
# "Follows": the score of every one of those ticks stays below this.
REARM_SCORE: Final = 0.5


class _State(enum.Enum):
    FREE = "free"
    CONTACT = "contact"


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
    """State machine of one leg."""

    _state: _State = _State.FREE
    _calm: int = 0

    @property
    def contact(self) -> bool:
        """Whether the leg is held to touch."""
        return self._state is _State.CONTACT

    def reset(self) -> None:
        """Forget; the source started anew."""
        self._state, self._calm = _State.FREE, 0

    def lift_off(self, t_ns: int) -> Decision | None:
        """A swing has begun: a contact of the stance before is over."""
        if self._state is _State.FREE:
            return None
        self.reset()
        return Decision(contact=False, onset_ns=t_ns, score=0.0)

    def swing_tick(self, score: float, t_ns: int, onset_ns: int) -> Decision | None:
        """Judge a swing tick.

        Args:
            score: statistic over threshold; NaN when nothing can be said, which changes nothing.
            t_ns: of the tick.
            onset_ns: when the touch began, should this be one.

        Returns:
            The change of state, if there is one.
        """
        if score != score:
            return None
        if self._state is _State.FREE:
            if score <= 1.0:
                return None
            self._state, self._calm = _State.CONTACT, 0
            return Decision(contact=True, onset_ns=onset_ns, score=score)
        self._calm = self._calm + 1 if score < REARM_SCORE else 0
        if self._calm < REARM_TICKS:
            return None
        self.reset()
        return Decision(contact=False, onset_ns=t_ns, score=score)


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
