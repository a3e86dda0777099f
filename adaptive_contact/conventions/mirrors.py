"""Which signs explain how legs walk whose mirror image walks as well.

A leg that hangs down with a hip that rolls is its own mirror image: all its pitches turned round,
the foot has the same height and goes the other way, and feet that stand are as rigid wherever the
robot walks straight on.  So of all choices of signs only those are looked at that a hand makes: the
same joints of all legs, of one side, of one end, or of one leg.  Those that explain the motion as
well are told together, and a description among them is not accused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.conventions.rigid import BETTER, FLOOR, RIGID
from adaptive_contact.conventions.sign_choices import LegChoices
from adaptive_contact.conventions.together import LAG_S, LOOSE, SLOW_LAGS, Pairs

__all__ = ["Chosen", "choose_signs"]

# Feet of a trot stand two at a time.
LEAST_PARTNERS: Final = 1
# More choices than these explain a motion that shows nothing.
MOST_OTHERS: Final = 2


class Chosen(NamedTuple):
    """The pattern of a leg that explains its motion, and those that do as well."""

    pattern: int
    others: tuple[int, ...] = ()


def choose_signs(legs: Sequence[LegChoices], period_s: float) -> dict[str, Chosen]:
    """Patterns under which standing feet keep their distances, by leg; empty for none.

    Args:
        legs: of one kind.
        period_s: the control tick.

    Returns:
        Of every leg the description's pattern where it explains the motion and no other does;
        of the legs concerned another one where the description does not.
    """
    if len(legs) < 2 or len({leg.leg.joint_axes for leg in legs}) > 1:
        return {}
    described = (0,) * len(legs)
    ticks = max(round(LAG_S / period_s), 1)
    for lag in (ticks, SLOW_LAGS * ticks):
        pairs = Pairs(legs, lag)
        before = _cost(pairs, described)
        if np.isfinite(before):
            break
    tried = {}
    for chosen in dict.fromkeys(_by_hand(legs)):
        if all(leg.may_move(pattern) for leg, pattern in zip(legs, chosen, strict=True)):
            tried[chosen] = _cost(pairs, chosen)
    best = min(tried, key=lambda chosen: tried[chosen], default=described)
    least = max(tried.get(best, np.inf), FLOOR**2)
    if least >= RIGID**2:
        return {}
    # What is nearly as good; what a hand changes least comes first.
    rivals = [c for c, cost in tried.items() if cost < BETTER * least and c != best]
    if described == best or described in rivals:
        return {} if rivals else {leg.leg.id: Chosen(0) for leg in legs}
    sane = all(leg.sane(0) for leg in legs)
    if len(rivals) > MOST_OTHERS or before < (LOOSE**2 if sane else BETTER * least):
        return {}
    found = {}
    for k, leg in enumerate(legs):
        others = tuple(dict.fromkeys(rival[k] for rival in rivals if rival[k] != best[k]))
        if best[k]:
            found[leg.leg.id] = Chosen(best[k], others)
    return found


def _cost(pairs: Pairs, chosen: Sequence[int]) -> float:
    """rho² of the worst leg; infinite where one stands with no other."""
    return max(pairs.cost(chosen, k, LEAST_PARTNERS) for k in range(len(chosen)))


def _by_hand(legs: Sequence[LegChoices]) -> Iterator[tuple[int, ...]]:
    """The choices that are looked at, a pattern for each leg; the described one is the first."""
    at = np.array([leg.leg.mount.xyz_m for leg in legs])
    groups = [np.ones(len(legs), dtype=bool)]
    for axis in (1, 0):
        groups += [at[:, axis] > 0.0, at[:, axis] < 0.0]
    groups += list(np.eye(len(legs), dtype=bool))
    for group in groups:
        for pattern in range(len(legs[0].flips)):
            yield tuple(pattern if moved else 0 for moved in group)
