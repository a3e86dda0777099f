"""Names what a tick finds of a leg, as bits: Python looks only at legs that have one."""

from __future__ import annotations

from typing import Final

RESTARTED: Final = 1  # the source began again
BROKE_OFF: Final = 2  # a gap or fault: the swing is not learned
RESOLVED: Final = 4  # the swing before has ended: its rows can be labelled
BEGAN: Final = 8  # a swing begins
ENTERED: Final = 16  # a row was entered
TOPPED: Final = 32  # the top of the lift has just been passed
DECIDED: Final = 64  # a contact began or ended: an event
TOUCHED: Final = 128  # and it began
TOUCHING: Final = 256  # one of the first ticks of a contact
RATE_OFF: Final = 512  # ticks are not as far apart as described
SOURCE: Final = 2048  # the source begins or ceases to copy commands or swap phases
RELEASE_PENDING: Final = 1024  # a contact is to end that no tick can decide any more
