"""Finds signs, order and zeros of joints that explain how the legs move together.

Feet that stand do not move against each other (``feet.py``).  First signs are tried, then another
order of joints, then zeros.  What more than one choice explains is left open.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.checks.conventions.feet import (
    FLOOR,
    LOOSE,
    MOST,
    RIGID,
    Feet,
    Reading,
    Walker,
    refine,
)

# Feet of a slow gait go too little way in a displacement: then it is so many times as long.
SLOW_LAGS: Final = 3
# How many times better (in squares) the right reading must be than any other.
BETTER: Final = 4.0
# A zero is reported from so much on, rad (8.6 degrees): right ones are found within 0.06.  Zeros
# are few rad: rho² of the description must be so many times that of the right ones, and that of
# another joint's zero so many times.
LEAST_ZERO_RAD: Final = 0.15
ZERO_BETTER: Final = 2.0
ZERO_RIVAL: Final = 1.5
# Less than this of a joint's zero is what a fit leaves open, rad; two fits whose zeros are closer
# are the same; and their standard deviation is within the last.
OPEN_RAD: Final = 0.1
ALIKE_RAD: Final = 0.15
SURE_RAD: Final = 0.07
# Zeros are sought from these on, rad: of one joint, and of all together.
ZERO_STARTS: Final = (0.0, -math.pi / 2, math.pi / 2)
# A search over all signs and zeros takes a second or more: it is made with so much motion, s.
LEAST_S: Final = 15.0

Readings = Sequence[Reading]  # one of each leg


class Chosen(NamedTuple):
    """The reading of a leg that explains its motion, and those that do as well."""

    reading: Reading
    others: tuple[Reading, ...] = ()
    pushed: bool = False  # it is the ground's push that shows it


class _Tried(NamedTuple):
    """A reading of each leg."""

    cost: float  # rho²
    readings: Readings
    sure: bool = True  # the motion shows their zeros


class Search:
    """Looks for readings under which the standing feet keep their distances.

    Args:
        legs: two or more.
        period_s: the control tick.
        least_partners: legs with which a leg has to stand at a time.
    """

    def __init__(self, legs: Sequence[Walker], period_s: float, least_partners: int) -> None:
        self._legs, self._period_s, self._least = legs, period_s, least_partners
        self._plain = [leg.plain for leg in legs]
        self._all = range(len(legs))
        self._feet = Feet(legs, legs[0].lag)
        if not self._known():
            self._feet = Feet(legs, SLOW_LAGS * legs[0].lag)

    def _known(self) -> bool:
        """Whether every leg stands with others, and moves."""
        return bool(np.isfinite(self._feet.costs(self._plain, self._least)).all())

    def choose(self) -> dict[str, Chosen]:
        """Choose among all readings; empty for none.

        Legs that stay out are those that no choice, or more than one, explains.
        """
        if len(self._legs) < 3 or not self._known():
            return {}
        if self._feet.rigid(self._plain) and all(leg.sane(leg.plain) for leg in self._legs):
            found = self._near_zeros() or self._plain
        elif signs := self.signs():
            return signs
        else:
            found = self._order(self._all) or self._change_one_leg() or self._zeros_from_anywhere()
        return {leg.leg.id: Chosen(_settled(r)) for leg, r in zip(self._legs, found, strict=False)}

    def _order(self, group: Sequence[int]) -> Readings:
        """Another order of joints, with any signs, the same for a group of legs."""
        # Orders of so many joints are tried.
        if not self._are_alike(group) or len(self._plain[group[0]].order) > 4:
            return []
        first = self._legs[group[0]]
        orders, signs = itertools.permutations(first.plain.order), first.signs
        every = [sign._replace(order=order) for order, sign in itertools.product(orders, signs)]
        sane = [self._with(group, reading) for reading in every if self._sane(group, reading)]
        tried = [_Tried(self._cost(readings, group), readings) for readings in sane]
        return _only(tried, BETTER, LOOSE**2)

    def _change_one_leg(self) -> Readings:
        """Another order of the worst leg's joints, or another zero of one of them."""
        worst = self._only_wrong()
        return self._order(worst) or self._zero_of_one_joint(worst, ZERO_STARTS)

    def _only_wrong(self) -> list[int]:
        """The worst leg, where all others are described right; empty where they are not."""
        worst = int(np.argmax(self._feet.costs(self._plain)))
        rest = [k for k in self._all if k != worst]
        # In a tripod two are left that stand together.
        alone = Feet([self._legs[k] for k in rest], self._feet.lag)
        costs = alone.costs([self._plain[k] for k in rest], 1)
        right = (costs < RIGID**2).all() and all(self._legs[k].sane(self._plain[k]) for k in rest)
        return [worst] if right and len(rest) > 2 else []

    def _near_zeros(self) -> Readings:
        """Zeros near the described ones, of all legs alike or of one joint of one leg."""
        worst = self._only_wrong()
        alone = self._zero_of_one_joint(worst, ZERO_STARTS[:1])
        found = [self._zeros_of_all(self._plain[:1]), alone]
        return _only(
            [_Tried(self._cost(readings, self._all), readings) for readings in found if readings]
        )

    def _zero_of_one_joint(self, group: Sequence[int], starts_rad: Sequence[float]) -> Readings:
        """The zero of one joint that explains a leg's motion; the group has one leg, or none."""
        tried = []
        for plain, joint in [(self._plain[k], j) for k in group for j in self._plain[k].order]:
            one = np.eye(len(plain.order))[joint]
            shifted = sorted(
                (plain.shifted(start * one) for start in starts_rad),
                key=lambda reading: self._cost(self._with(group, reading), group),
            )
            fits = [self._fitted(group, reading, [joint]) for reading in shifted[:2]]
            tried += sorted((fit for fit in fits if fit.sure), key=lambda fit: fit.cost)[:1]
        found = _only(tried)
        # No leg may be left that is as bad: that one might be the wrong one.
        return found if found and self._explains(found, group) else []

    def _zeros_from_anywhere(self) -> Readings:
        """Signs and zeros, the same for all legs, from starts all over their range."""
        grid = self._legs[0].grid
        if (grid[-1] - grid[0]) * self._period_s < LEAST_S or not self._are_alike(self._all):
            return []
        starts = [
            reading
            for reading in self._starts()
            # A start is not yet the answer: this share of all ticks is below the axis.
            if all(np.mean(leg.height(reading)[::20] < 0.0) >= 0.8 for leg in self._legs)
        ]
        starts.sort(key=lambda start: self._cost(self._with(self._all, start), self._all))
        return self._zeros_of_all(starts[:6])

    def _starts(self) -> Iterator[Reading]:
        pitched = [
            joint for joint, axis in enumerate(self._legs[0].leg.joint_axes) if axis == "pitch"
        ]
        # Zeros of so many joints are sought together.
        if len(pitched) <= 3:
            zeros = itertools.product(ZERO_STARTS, repeat=len(pitched))
            for at, sign in itertools.product(zeros, self._legs[0].signs):
                by_rad = np.zeros(len(self._plain[0].order))
                by_rad[pitched] = at
                yield sign.shifted(by_rad)

    def _zeros_of_all(self, starts: Readings) -> Readings:
        """Zeros, the same for all legs, near any of the starts."""
        if not self._are_alike(self._all):
            return []
        joints = range(len(self._plain[0].order))
        fits = [self._fitted(self._all, reading, joints) for reading in starts]
        tried = [fit for fit in fits if self._sane(self._all, fit.readings[0])]
        found = _only(tried, BETTER)
        return found if found and self._explains(found, self._all) else []

    def _fitted(self, group: Sequence[int], start: Reading, joints: Sequence[int]) -> _Tried:
        """Readings with the best zeros of a group's joints near a start."""
        readings = self._with(group, start)
        moved = [[-1] * len(plain.order) for plain in self._plain]
        for k in group:
            for parameter, joint in enumerate(joints):
                moved[k][joint] = parameter
        found, spread_rad = refine(Feet(self._legs, self._feet.lag, readings), readings, moved)
        return _Tried(self._cost(found, group), found, spread_rad <= SURE_RAD)

    def _explains(self, readings: Readings, group: Sequence[int]) -> bool:
        """Whether zeros are far enough off, and make the feet so much more rigid."""
        before = self._feet.costs(self._plain)[group]
        after = np.maximum(self._feet.costs(readings), FLOOR**2)
        reading = readings[group[0]]
        return (
            max(map(abs, reading.offsets_rad)) >= LEAST_ZERO_RAD
            and bool(before.mean() >= ZERO_BETTER * after.mean())
            and self._sane(group, reading)
        )

    # -- signs -----------------------------------------------------------------------------------

    def signs(self) -> dict[str, Chosen]:
        """Choose the signs that explain how legs walk.

        Only choices are looked at that a hand makes: the same joints of all legs, of one side, of
        one end, or of one leg.  A leg that hangs down with a hip that rolls is its own mirror
        image: all its pitches turned round, the foot has the same height and goes the other way,
        and feet that stand are as rigid wherever the robot walks straight on.  So choices that
        explain the motion equally well are reported together, and a description among them is not
        accused.

        Returns:
            By leg, empty for none: of every leg the description's reading where it explains the
            motion and no other does; of the legs concerned another where the description does not.
        """
        if not self._are_alike(self._all):
            return {}
        legs, described = self._legs, tuple(self._plain)
        tried = {
            chosen: self._cost(chosen, self._all)
            for chosen in map(tuple, self._hands())
            if all(leg.sane(r) and leg.within(r) for leg, r in zip(legs, chosen, strict=True))
        }
        best = min(tried, key=lambda chosen: tried[chosen], default=described)
        least = tried.get(best, np.inf)
        if least >= RIGID**2:
            return {}
        # What is nearly as good; what a hand changes least comes first.
        limit = max(BETTER * least, LOOSE**2)
        rivals = [c for c, cost in tried.items() if cost < limit and c != best]
        if described == best or described in rivals:
            return {} if rivals else {leg.leg.id: Chosen(leg.plain) for leg in legs}
        sane = all(leg.sane(leg.plain) for leg in legs)
        # More choices than these explain a motion that shows nothing.
        if len(rivals) > 2 or self._cost(described, self._all) < (
            LOOSE**2 if sane else BETTER * least
        ):
            return {}
        found = {}
        for k, leg in enumerate(legs):
            others = tuple(dict.fromkeys(rival[k] for rival in rivals if rival[k] != best[k]))
            if best[k] != leg.plain:
                found[leg.leg.id] = Chosen(best[k], others)
        return found

    def _hands(self) -> Iterator[Readings]:
        """The choices that are looked at; the described one is the first."""
        at = np.array([leg.leg.mount.xyz_m for leg in self._legs])
        ahead, left = at[:, 0], at[:, 1]
        sides = (left > 0.0, left < 0.0, ahead > 0.0, ahead < 0.0)
        groups = [np.ones(len(at), dtype=bool), *sides, *np.eye(len(at), dtype=bool)]
        for group, sign in itertools.product(groups, self._legs[0].signs):
            yield self._with(np.flatnonzero(group).tolist(), sign)

    # -- helpers ---------------------------------------------------------------------------------

    def _are_alike(self, group: Sequence[int]) -> bool:
        """Whether one reading can hold for these legs."""
        return len({self._legs[k].leg.joint_axes for k in group}) == 1

    def _sane(self, group: Sequence[int], reading: Reading) -> bool:
        return all(self._legs[k].sane(reading) for k in group)

    def _with(self, group: Sequence[int], reading: Reading) -> list[Reading]:
        """A reading of a group, and the rest as described."""
        return [reading if k in group else plain for k, plain in enumerate(self._plain)]

    def _cost(self, readings: Readings, group: Sequence[int]) -> float:
        """rho² of the worst leg of a group."""
        costs = self._feet.costs(readings, self._least)[group]
        return float(np.clip(costs, FLOOR**2, MOST).max())


def _only(
    tried: Sequence[_Tried], better: float = ZERO_RIVAL, least_rival: float = 0.0
) -> Readings:
    """The readings that explain the motion where no others do; empty for none.

    Args:
        tried: all of them.
        better: how many times better (in squares) they must be than any others.
        least_rival: rho² below which others are as good.
    """
    if not tried:
        return []
    best = min(tried, key=lambda each: each.cost)
    limit = max(better * best.cost, least_rival)
    rivals = [each.cost for each in tried if not _alike(each.readings, best.readings)]
    explains = best.sure and best.cost < RIGID**2 and all(cost >= limit for cost in rivals)
    return best.readings if explains else []


def _alike(some: Readings, others: Readings) -> bool:
    """Whether readings are the same but for what a fit leaves open."""
    return all(
        a._replace(offsets_rad=()) == b._replace(offsets_rad=())
        and max(np.abs(a.shifted(np.negative(b.offsets_rad)).offsets_rad)) < ALIKE_RAD
        for a, b in zip(some, others, strict=True)
    )


def _settled(reading: Reading) -> Reading:
    """A reading without what a fit leaves open, in hundredths of a radian."""
    offsets = (0.0 if abs(off) < OPEN_RAD else round(off, 2) for off in reading.offsets_rad)
    return reading._replace(offsets_rad=tuple(offsets))
