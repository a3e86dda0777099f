"""Gaits: which leg swings when, and how a foot swings.

A gait is a clock from 0 to 1 and an offset per leg; a leg swings in the first ``share`` of its
own cycle.  A swing lifts, transfers and descends; its height follows quintics (no jerk at the
ends), and the descent aims below the ground one expects, so that a foot that finds none goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["DESCENT", "GAITS", "Gait", "GaitName", "Swings", "quintic"]

Array = NDArray[np.float64]
GaitName = Literal["tripod", "ripple", "wave", "trot", "walk"]

# Parts of a swing, as shares of it: rising until, falling from, moving forward between.
RISE: Final = 0.32
DESCENT: Final = 0.42
TRANSFER: Final = (0.05, 0.65)


class Gait(NamedTuple):
    """A periodic gait.

    Attributes:
        share: of the cycle that a leg swings.
        offsets: per leg, in the order of the robot's legs.
    """

    share: float
    offsets: tuple[float, ...]


# Legs are lf, lm, lr, rf, rm, rr.  Shares leave a little of the cycle with all feet down, for
# the weight to be handed over.
GAITS: Final[dict[GaitName, Gait]] = {
    "tripod": Gait(0.46, (0.0, 0.5, 0.0, 0.5, 0.0, 0.5)),
    # Metachronal on each side, rear to front, sides half a cycle apart: two legs in the air.
    "ripple": Gait(0.31, (2 / 3, 1 / 3, 0.0, 1 / 6, 5 / 6, 1 / 2)),
    "wave": Gait(0.155, (4 / 6, 5 / 6, 0.0, 1 / 6, 2 / 6, 3 / 6)),
    # Four legs: fl, fr, rl, rr.  Diagonal pairs; and one at a time, rear to front on each side.
    "trot": Gait(0.38, (0.0, 0.5, 0.5, 0.0)),
    "walk": Gait(0.22, (0.75, 0.25, 0.0, 0.5)),
}


def quintic(x: Array) -> Array:
    """Smooth step from 0 at 0 to 1 at 1, with no speed and acceleration at either end."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 + x * (6.0 * x - 15.0)))


@dataclass(eq=False)
class Swings:
    """The legs' present or last swing, in the body's frame.

    Attributes:
        start_m, target_m: (L, 3) where it began, and where it goes; the target's height is where
            the descent would end.
        top_m: (L,) height of the transfer.
        began_step: (L,) physics step at which it began.
    """

    start_m: Array
    target_m: Array
    top_m: Array
    began_step: NDArray[np.int64]

    @classmethod
    def at(cls, feet_m: Array) -> Swings:
        """No swing yet: feet (L, 3) m where they are."""
        n = len(feet_m)
        return cls(
            feet_m.copy(),
            feet_m.copy(),
            feet_m[:, 2].copy(),
            np.full(n, -1, dtype=np.int64),
        )

    def feet(self, progress: Array) -> Array:
        """Foot points at a progress (L,) of 0 to 1 through the swing: (L, 3) m."""
        forward = quintic((progress - TRANSFER[0]) / (TRANSFER[1] - TRANSFER[0]))
        feet = self.start_m + forward[:, None] * (self.target_m - self.start_m)
        rising = quintic(progress / RISE)
        falling = quintic((progress - DESCENT) / (1.0 - DESCENT))
        up = self.start_m[:, 2] + rising * (self.top_m - self.start_m[:, 2])
        feet[:, 2] = up + falling * (self.target_m[:, 2] - self.top_m)
        return feet
