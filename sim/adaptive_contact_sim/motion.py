"""What a controller of the simulated robot sees, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from adaptive_contact.arrays import Array
from adaptive_contact.wire import Phase


@dataclass(frozen=True, eq=False)
class World:
    """What is known at the start of a control tick."""

    tick: int  # control ticks made so far
    # step, step_s: physics steps made so far, and their length
    step: int
    step_s: float
    measured_rad: Array  # (L, J), what the servos reported this tick
    # position_m, rotation: (3,) and (3, 3), the body in the world
    position_m: Array
    rotation: Array
    feet_m: Array  # (L, 3), the true feet in the world: for those who set the stage, not for gaits
    # per leg, the physics step at which it last came down; None in the air
    touch_step: tuple[int | None, ...]
    # per leg, the tick at which another process (the service) last reported that it touches; None
    # when taken back
    reported_tick: tuple[int | None, ...]


class Goal(NamedTuple):
    """A controller's answer: (L, J) rad, and each leg's phase."""

    joints_rad: Array
    phase: tuple[Phase, ...]
