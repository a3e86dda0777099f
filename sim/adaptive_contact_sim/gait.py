"""Gaits: which leg swings when, and how a foot swings.

A gait is a clock from 0 to 1 and an offset per leg; a leg swings in the first ``share`` of its
own cycle.  A swing lifts, transfers and descends; its height follows quintics (no jerk at the
ends), and the descent aims below the ground one expects, so that a foot that finds none goes on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints

GaitName = Literal["tripod", "ripple", "wave", "trot", "walk"]

# Parts of a swing, as shares of it: falling from, moving forward between.
DESCENT: Final = 0.42
TRANSFER: Final = (0.05, 0.65)
# Points of a cycle at which the body's shift is computed, and how many of its harmonics count:
# servos do not follow faster ones.
_POINTS: Final = 240
_HARMONICS: Final = 6


class Gait(NamedTuple):
    """A periodic gait."""

    share: float  # of the cycle that a leg swings
    offsets: tuple[float, ...]  # per leg, in the order of the robot's legs


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


class Sway:
    r"""Shift of the body over the feet that stand, a function of the gait's clock.

    The wanted centre of pressure :math:`z` is the centroid of the standing feet.  A body of
    constant height :math:`h` has its own at :math:`c - (h/g)\,\ddot c`, so that each harmonic of
    the cycle's angular frequency :math:`\omega` obeys

    .. math:: c_k = z_k / (1 + (h/g)\,k^2\omega^2)

    and servos that lag by :math:`\tau` are given :math:`(1 + i k \omega \tau)\,c_k`.  A gait whose
    standing feet always have the same centroid, such as a trot, has no shift.

    Args:
        gait: which legs stand when.
        feet_m: (L, 3) neutral feet in the body's frame.
        height_m: of the body over its feet.
        cycle_s: nominal time of a cycle.
        lag_s: of the servos.

    Reference:
        S. Kajita et al., Biped walking pattern generation by using preview control of
        zero-moment point, ICRA 2003 (the cart-table model).
    """

    def __init__(
        self, gait: Gait, feet_m: Array, *, height_m: float, cycle_s: float, lag_s: float
    ) -> None:
        clock = np.arange(_POINTS)[:, None] / _POINTS
        stands = (clock + np.array(gait.offsets)) % 1.0 >= gait.share
        pressure = stands @ feet_m[:, :2] / stands.sum(axis=1, keepdims=True)
        harmonics = np.fft.rfft(pressure - feet_m[:, :2].mean(axis=0), axis=0) / _POINTS
        k = np.arange(1, _HARMONICS + 1)
        omega = 2.0 * np.pi * k / cycle_s
        body = harmonics[1 : _HARMONICS + 1].T / (1.0 + height_m / 9.81 * omega**2)
        self._turns = 2j * np.pi * k
        self._coefficients = 2.0 * body * (1.0 + 1j * omega * lag_s)

    def at(self, clock: float) -> Array:
        """(2,) m, x and y, the body's command at a clock of 0 to 1."""
        return np.asarray((self._coefficients * np.exp(self._turns * clock)).real.sum(axis=1))


def quintic(x: Array) -> Array:
    """Smooth step from 0 at 0 to 1 at 1, with no speed and acceleration at either end."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 + x * (6.0 * x - 15.0)))


@dataclass(eq=False)
class Swings:
    """The legs' present or last swing, in the body's frame."""

    # start_m, target_m: (L, 3) where it began, and where it goes; the target's height is where the
    # descent would end
    start_m: Array
    target_m: Array
    top_m: Array  # (L,) height of the transfer
    began_step: Ints  # (L,) physics step at which it began

    @classmethod
    def at(cls, feet_m: Array) -> Swings:
        """No swing yet: feet (L, 3) m where they are."""
        began = np.full(len(feet_m), -1, dtype=np.int64)
        return cls(feet_m.copy(), feet_m.copy(), feet_m[:, 2].copy(), began)

    def feet(self, progress: Array) -> Array:
        """Foot points at a progress (L,) of 0 to 1 through the swing: (L, 3) m."""
        forward = quintic((progress - TRANSFER[0]) / (TRANSFER[1] - TRANSFER[0]))
        feet = self.start_m + forward[:, None] * (self.target_m - self.start_m)
        rising = quintic(progress / 0.32)
        falling = quintic((progress - DESCENT) / (1.0 - DESCENT))
        up = self.start_m[:, 2] + rising * (self.top_m - self.start_m[:, 2])
        feet[:, 2] = up + falling * (self.target_m[:, 2] - self.top_m)
        return feet
