"""What the bus reports: positions in whole steps with noise, and now and then a bad reading.

A reading is the joint's angle in the servo's own frame (the link's plus the horn's offset) with
noise, rounded to whole steps.  Real buses add, about once in 3,000 reads or more: a reading that
did not come (the last value again, marked invalid), one that is stale but looks fine, and one of
exactly minus pi.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact_sim.elements import N_SERVOS
from adaptive_contact_sim.limits import check_number
from adaptive_contact_sim.servo import QUANTUM_RAD


@dataclass(frozen=True)
class EncoderSettings:
    """Noise and faults of position readings."""

    noise_steps: float = 0.5  # standard deviation before rounding, in steps
    # probability that a reading does not come: the last value, `valid` False
    dropped: float = 0.0
    repeated: float = 0.0  # probability that the last value comes again, silently
    bogus: float = 0.0  # probability of a reading of -pi

    def __post_init__(self) -> None:
        for name in ("dropped", "repeated", "bogus"):
            check_number(f"probability of {name} readings", getattr(self, name), 0.0, 0.5)
        check_number("reading noise", self.noise_steps, 0.0, 10.0, "steps")


class Reading(NamedTuple):
    """One tick's positions: (S,) rad, and (S,) whether each is known to be good."""

    angle_rad: Array
    valid: Mask


class Encoder:
    """Reads all positions once a tick.

    Every tick draws the same amount of randomness, so that a fault's probability changes
    nothing but the faults.
    """

    def __init__(
        self,
        settings: EncoderSettings,
        rng: np.random.Generator,
        servos: int = N_SERVOS,
        quantum_rad: float = QUANTUM_RAD,
    ) -> None:
        self.settings = settings
        self.dropped = np.full(servos, settings.dropped)
        self._quantum_rad = quantum_rad
        self._rng = rng
        self._last: Array | None = None  # the last true readings; None before the first

    def read(self, angle_rad: Array) -> Reading:
        """Read positions.

        Args:
            angle_rad: (S,) rad, in the servos' own frames.

        Returns:
            What the bus reports.
        """
        noise = self._rng.standard_normal(self.dropped.size)
        chance = self._rng.random((3, self.dropped.size))
        steps = np.rint(angle_rad / self._quantum_rad + self.settings.noise_steps * noise)
        fresh = np.asarray(steps * self._quantum_rad)
        if self._last is None:
            self._last = fresh
            return Reading(fresh, np.ones(fresh.size, dtype=np.bool_))
        dropped = chance[0] < self.dropped
        stale = dropped | (chance[1] < self.settings.repeated)
        bogus = ~stale & (chance[2] < self.settings.bogus)
        reading = np.where(stale, self._last, fresh)
        # The bus buffer keeps the last true value, so a stale reading never repeats a bogus one.
        self._last = reading.copy()
        reading[bogus] = -math.pi
        self._last[bogus] = fresh[bogus]
        return Reading(reading, ~dropped)
