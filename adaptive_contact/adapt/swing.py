"""Where a leg is in its swing: phase, direction, and whether the foot follows its command."""

from __future__ import annotations

from typing import Final

from adaptive_contact.adapt.tracker import LIFT_OFF_TICKS
from adaptive_contact.robot import Leg, height
from adaptive_contact.robot.phase import Direction, PhaseTracker
from adaptive_contact.wire import ServoSample

__all__ = ["SwingWatch"]

# A command that lifts less says nothing of whether the foot follows; one that is followed by less
# than this share of it is not followed (a free foot lags, but reaches more than two thirds).
LEAST_RISE_M: Final = 0.015
HELD_SHARE: Final = 0.3


class SwingWatch:
    """Follows the phase and the foot's heights of one leg.

    Attributes:
        ticks: samples since the swing began, 1 at its first, 0 in stance.
        direction: of the command in force.
        rising: the measured foot went up in this tick.
        untold: samples whose phase could not be told.
    """

    def __init__(self, leg: Leg) -> None:
        self.ticks = 0
        self.direction = Direction.DESCENT
        self.rising = False
        self.untold = 0
        self._leg = leg
        self._axes = leg.joint_axes
        self._phase = None if leg.lengths_m is None else PhaseTracker()
        self._commanded = self._measured = 0.0  # heights, m
        self._commanded_up = False
        self._start = self._top = self._rise = 0.0

    @property
    def blind(self) -> bool:
        """Whether swings cannot be told without the samples' own word."""
        return self._phase is None

    @property
    def descending(self) -> bool:
        """Whether the command in force is past the lift; without geometry, the time says so."""
        if self._leg.lengths_m is None:
            return self.ticks > 2 * LIFT_OFF_TICKS
        return self.direction is Direction.DESCENT and self.ticks > LIFT_OFF_TICKS

    @property
    def held(self) -> bool | None:
        """Whether the foot failed to rise with its command; None where little was asked of it.

        Counted from where the foot was: after a touch it starts higher than its command.
        """
        wanted = self._top - self._start
        return None if wanted <= LEAST_RISE_M else self._rise < HELD_SHARE * wanted

    def restart(self) -> None:
        """The source started anew."""
        self.ticks = 0
        if self._phase is not None:
            self._phase = PhaseTracker()

    def follow(self, sample: ServoSample) -> None:
        """Take in the sample's phase and the height of the command it brings."""
        phase = None
        if self._phase is not None:
            assert self._leg.lengths_m is not None
            now = height(sample.desired, self._leg.lengths_m, self._axes)
            self._commanded_up = now > self._commanded
            self._commanded = now
            phase = self._phase.update(now)
        if sample.phase is not None:
            phase = sample.phase
        if phase is None:
            self.untold += 1
        self.ticks = self.ticks + 1 if phase == "swing" else 0
        if self.ticks == 1:
            self._start, self._top, self._rise = self._measured, self._commanded, 0.0

    def observe(self, sample: ServoSample) -> None:
        """Take in the measured height."""
        if self._leg.lengths_m is None:
            return
        now = height(sample.measured, self._leg.lengths_m, self._axes)
        self.rising = now > self._measured
        self._measured = now
        self._rise = max(self._rise, now - self._start)
        self._top = max(self._top, self._commanded)

    def command(self) -> None:
        """The sample's command is now in force."""
        if self._leg.lengths_m is not None:
            self.direction = Direction.LIFT if self._commanded_up else Direction.DESCENT
