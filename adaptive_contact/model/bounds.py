"""Bounds the numbers that a baseline or a saved state may hold.

What lies beyond is no leg's; it would overflow, or silence the detection.  Beside each stands what
the shipped baselines and that of a real robot have.
"""

from __future__ import annotations

from typing import Annotated, Final, TypeGuard

from msgspec import Meta

from adaptive_contact.model.peaks import LEAST_TICKS
from adaptive_contact.model.tail import MIN_EXCEEDANCES, SHAPE_RANGE
from adaptive_contact.robot.description import MAX_JOINTS
from adaptive_contact.robot.load import MAX_LEGS

# Of anything: coefficients have up to 7.3, factors of a domain 375, readings 12.
MOST: Final = 1e6
MOST_WHITEN: Final = 1e9  # 1/rad, of a residual: 1,159
_MOST_COUNT: Final = 1 << 62  # a status counts on from it, in 64 bits

Count = Annotated[int, Meta(ge=0, le=_MOST_COUNT)]
Weight = Annotated[float, Meta(ge=0, le=1e12)]  # ticks: 0 to 55,181
Number = Annotated[float, Meta(ge=-MOST, le=MOST)]
Size = Annotated[float, Meta(ge=1e-9, le=MOST)]  # root mean square of a regressor: 0.005 to 1.9
Inflation = Annotated[float, Meta(ge=0, le=MOST)]
Variance = Annotated[float, Meta(ge=-1e3, le=1e3)]  # rad²: up to 1.3e-4
Level = Annotated[float, Meta(ge=1e-2, le=1e4)]  # of the statistic: 9 to 16
Excess = Annotated[float, Meta(ge=1e-9, le=1e4)]  # its mean above that: 2.2 to 5.2
Peak = Annotated[float, Meta(ge=1e-3, le=1e4)]  # the largest free statistic: 8 to 120
PeakTicks = Annotated[int, Meta(ge=LEAST_TICKS, le=_MOST_COUNT)]
Share = Annotated[float, Meta(ge=1e-6, lt=1)]  # of free ticks above a level: 0.01
TailTicks = Annotated[int, Meta(ge=MIN_EXCEEDANCES, le=_MOST_COUNT)]  # 14,000 to 400,000
Shape = Annotated[float, Meta(ge=SHAPE_RANGE[0], le=SHAPE_RANGE[1])]
Quantum = Annotated[float, Meta(ge=1e-6, le=0.2)]  # rad
Period = Annotated[float, Meta(ge=1e-4, le=1.0)]  # s
Slope = Annotated[float, Meta(ge=1e-3, le=3.2)]  # rad
Lag = Annotated[int, Meta(ge=0, le=20)]  # ticks
Name = Annotated[str, Meta(min_length=1, max_length=1000)]
Text = Annotated[str, Meta(max_length=100_000)]
OfJoints = Meta(min_length=1, max_length=MAX_JOINTS)
OfLegs = Meta(min_length=1, max_length=MAX_LEGS)


def is_count(value: object) -> TypeGuard[int]:
    """Return whether a saved value is a valid count."""
    return isinstance(value, int) and 0 <= value <= _MOST_COUNT
