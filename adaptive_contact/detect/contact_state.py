"""Decides from test ratios whether a leg is loaded, free or in contact, compiled.

The phase gates and never causes: outside a swing nothing is decided.  A swing begins *loaded*:
after a pressed stance the foot comes off the ground 100 ms and more after its command does.  It is
*free* once the leg has followed the model for some ticks, or when the descent begins; only a free
leg can touch.  A contact ends in the next swing when the leg is free, or within its own when the
leg has followed the model again.
"""

from __future__ import annotations

from typing import Final

from adaptive_contact.compiled import compiled
from adaptive_contact.detect.flags import DECIDED, TOUCHED

# A tick is calm when its distance from the free model is below this share of the threshold: one
# free tick in a thousand is not, while a foot let go of is at several times the threshold.
CALM_SCORE: Final = 0.5
# Calm ticks in a row that show a foot to be off the ground.  A foot about to leave it may look
# calm for one tick, while the push along and the pull back cancel.
CALM_TICKS: Final = 3
# And within a swing, after a contact, one more.
REARM_TICKS: Final = 4


@compiled
def release(leg, t_ns, score):
    """End a contact, if there is one."""
    if not leg.contact:
        return
    leg.contact = False
    leg.found |= DECIDED
    leg.onset_ns = leg.calm_since if leg.calm else t_ns
    leg.score = score


@compiled
def swing_tick(leg, score, distance, onset_ns, past_lift):
    """Update loaded, free or contact by a tick's test ratio; NaN changes nothing.

    Args:
        leg: its scalars.
        score: test ratio of the tick, the largest over the windows.
        distance: squared length of the last whitened residual over the threshold, for calm.
        onset_ns: of the contact, if it begins here.
        past_lift: the descent has begun, after a lift that was seen: free even if not calm.
    """
    if score != score:
        return
    leg.calm = leg.calm + 1 if distance < CALM_SCORE else 0
    if leg.calm == 1:
        leg.calm_since = leg.at_ns
    if leg.loaded:
        if leg.calm < CALM_TICKS and not past_lift:
            return
        leg.loaded = False
        release(leg, leg.at_ns, score)
        return
    if leg.contact:
        if leg.calm >= REARM_TICKS:
            release(leg, leg.at_ns, score)
        return
    if score <= 1.0:
        return
    leg.contact, leg.calm = True, 0
    leg.found |= DECIDED | TOUCHED
    leg.onset_ns, leg.score = onset_ns, score


@compiled
def let_go(leg):
    """Forget whether the leg touches: it cannot be known."""
    leg.release_pending |= leg.reported
    leg.contact, leg.loaded, leg.calm = False, True, 0
