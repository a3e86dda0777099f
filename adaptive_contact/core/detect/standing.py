"""Decides whether a robot stands or hangs, by the loads of all its legs.

The load of one leg (``state.py``) parts a foot on soft ground from one in the air only after many
stances; the mean of all legs does so within two strides (decision 53).
"""

from __future__ import annotations

from typing import Final

from adaptive_contact.core.detect.leg_batch import LegPlace

# A robot stands above the first mean load, in sizes of free motion, and hangs below the second; in
# between it goes on standing, or is not known to do either.  Of 48 robots that hang, two came to
# the first; stiff drives walk at 1 to 1.6.
STANDS_LOAD: Final = 2.0
HANGS_LOAD: Final = 0.8
# Loads of the first stances are too low, as the model has still to be learned: before so many of
# each leg, none hangs.
HANGS_STANCES: Final = 5
# One that stood hangs below this share of its usual load, which is a mean over so many stances, and
# so falls again in time.  Lifted robots come below it within 8 s.
LIFTED_SHARE: Final = 0.55
USUAL_STANCES: Final = 200
# Of one leg or two the mean says no more than each load does.
LEAST_LEGS: Final = 3


class Standing:
    """Tells the legs of one robot, as their ``stands``, whether it stands or hangs."""

    def __init__(self) -> None:
        self._places: list[LegPlace] = []
        self._stands = 0  # 1 stands, -1 hangs; 0 while it is not known
        self._usual = 0.0
        self._usual_n = 0

    def track(self, place: LegPlace) -> None:
        """Add a leg; without geometry it has no load."""
        if place.leg.has_lengths:
            self._places.append(place)

    def end_stance(self) -> None:
        """Update by the loads of all legs, as a stance of one of them is over."""
        legs = [place.leg for place in self._places]
        loads = [leg.load for leg in legs if leg.load_n]
        stances = sum(leg.load_n for leg in legs)
        if len(legs) < LEAST_LEGS or 2 * len(loads) < len(legs) or stances < len(legs):
            return
        load = sum(loads) / len(loads)
        lifted = LIFTED_SHARE * self._usual
        if load > max(STANDS_LOAD, lifted):
            self._stands = 1
        elif load < max(HANGS_LOAD, lifted):
            self._stands = -1 if stances >= HANGS_STANCES * len(legs) else 0
        elif self._stands < 0:
            self._stands = 0
        self._usual_n = min(self._usual_n + 1, USUAL_STANCES)
        self._usual += (load - self._usual) / self._usual_n
        for leg in legs:
            leg.stands = self._stands
