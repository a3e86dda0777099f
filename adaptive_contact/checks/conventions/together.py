"""Finds signs, order and zeros of all legs' joints that explain how they move together.

Feet that stand do not move against each other (``rigid.py``).  First signs
are tried, then another order of joints, then zeros.  What more than one choice explains is left
open.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.checks.conventions.rigid import (
    BETTER,
    FLOOR,
    LAG_S,
    LEAST_ROWS,
    MOST,
    MOST_ROWS,
    RIGID,
    SURE_RAD,
    Feet,
    Reading,
    fit_readings,
    meetings,
    on_body,
    refine,
    rigidity,
)
from adaptive_contact.checks.conventions.sign_choices import LegChoices

# Feet of a slow gait go too little way in it: then it is so many times as long.
SLOW_LAGS: Final = 3
# rho of a description that is wrong.
LOOSE: Final = 0.12
# A zero is reported from so much on, rad (8.6 degrees): right ones are found within 0.06.  Zeros
# are few rad: rho² of the description must be so many times that of the right ones, and that of
# another joint's zero so many times.
LEAST_ZERO_RAD: Final = 0.15
ZERO_BETTER: Final = 2.0
ZERO_RIVAL: Final = 1.5
# Less than this of a joint's zero is what a fit leaves open, rad.
OPEN_RAD: Final = 0.1
# Zeros of one joint are sought from these on, rad.
ZERO_STARTS: Final = (0.0, -0.5, 0.5, -1.0, 1.0, -math.pi / 2, math.pi / 2)


# Of leg i with pattern k, in ticks in which it stands: (m, 2, 3) m where its foot is and was on the
# body, (m,) their number.
Stands = Callable[[int, int], tuple[Array, Ints]]


def stands_of(legs: Sequence[LegChoices], lag: int) -> Stands:
    """Where legs stand under each of their patterns; ``lag``: ticks of a displacement."""

    def stands(i: int, pattern: int) -> tuple[Array, Ints]:
        leg = legs[i]
        return leg.stood(on_body(leg.leg, leg.place(pattern)), pattern, lag)

    return stands


class Pairs:
    """rho² of pairs of legs, by the patterns of both, as it is asked for.

    Args:
        stands: the legs that are compared.
    """

    def __init__(self, stands: Stands) -> None:
        self._pair = functools.cache(functools.partial(_compare, functools.cache(stands)))

    def cost(self, chosen: Sequence[int], i: int, least_partners: int = 2) -> float:
        """rho² of a leg with the others, weighed by how often they stand together.

        Infinite where it stands with too few.
        """
        found = [
            self._pair(i, j, chosen[i], k) if i < j else self._pair(j, i, k, chosen[i])
            for j, k in enumerate(chosen)
            if j != i
        ]
        known = [(weight, ratio) for weight, ratio in found if weight > 0]
        if len(known) < least_partners:
            return np.inf
        return sum(w * r for w, r in known) / sum(w for w, _ in known)

    def rigid(self, chosen: Sequence[int]) -> bool:
        """Whether every leg that stands keeps its distances from the others."""
        return all(self.cost(chosen, i) < RIGID**2 for i in range(len(chosen)))

    def best(self, among: Sequence[Sequence[int]]) -> list[int]:
        """The choice of one of its patterns for each leg under which rho² is least, on average."""
        n = len(among)
        weighed = [np.zeros([1] * n) for _ in range(n)]
        weights = [np.zeros([1] * n) for _ in range(n)]
        for i, j in itertools.combinations(range(n), 2):
            found = np.array([[self._pair(i, j, a, b) for b in among[j]] for a in among[i]])
            shape = [len(among[k]) if k in (i, j) else 1 for k in range(n)]
            weight = found[..., 0].reshape(shape)
            share = np.where(weight > 0, weight * np.minimum(found[..., 1].reshape(shape), MOST), 0)
            for k in (i, j):
                weighed[k] = weighed[k] + share
                weights[k] = weights[k] + weight
        with np.errstate(invalid="ignore"):
            total = np.nan_to_num(
                np.stack([a / b for a, b in zip(weighed, weights, strict=True)]).sum(axis=0),
                nan=np.inf,
            )
        place = np.unravel_index(int(np.argmin(total)), total.shape)
        return [among[i][int(k)] for i, k in enumerate(place)]


def _compare(stands: Stands, i: int, j: int, a: int, b: int) -> tuple[float, float]:
    """(weight, rho²) of legs i and j with patterns a and b; weight 0 where rho² is unknown.

    Legs that stand by turns meet in few ticks, those of a touch and a lift, which show little.
    The weight is the square of the number of ticks.
    """
    (p, mine), (q, theirs) = stands(i, a), stands(j, b)
    _, rows, columns = np.intersect1d(mine, theirs, return_indices=True)
    count = len(rows)
    if count < LEAST_ROWS:
        return 0.0, np.inf
    step = -(-count // MOST_ROWS)
    ratio = rigidity(p[rows[::step]], q[columns[::step]])
    return (float(count) ** 2, ratio) if np.isfinite(ratio) else (0.0, np.inf)


def pairs_of(
    legs: Sequence[LegChoices], period_s: float, least_partners: int = 2
) -> tuple[Pairs, int]:
    """Compare legs over a displacement by which all of them move as described; and its ticks."""
    lag = max(round(LAG_S / period_s), 1)
    pairs = Pairs(stands_of(legs, lag))
    described = [0] * len(legs)
    if all(np.isfinite(pairs.cost(described, i, least_partners)) for i in range(len(legs))):
        return pairs, lag
    return Pairs(stands_of(legs, SLOW_LAGS * lag)), SLOW_LAGS * lag


def choose(legs: Sequence[LegChoices], period_s: float) -> dict[str, int]:
    """Patterns under which the standing feet keep their distances; empty for none.

    Legs that stay out are those that no choice, or more than one, explains.
    """
    if len(legs) < 3:
        return {}
    described = [0] * len(legs)
    pairs, lag = pairs_of(legs, period_s)
    if not all(np.isfinite(pairs.cost(described, i)) for i in range(len(legs))):
        return {}
    others = _Others(legs, lag, period_s)
    if pairs.rigid(described) and all(leg.sane(0) for leg in legs):
        return others.near_zeros() or dict.fromkeys((leg.leg.id for leg in legs), 0)
    return _choose_signs(legs, pairs) or others.orders() or others.one_leg() or others.zeros()


def _choose_signs(legs: Sequence[LegChoices], pairs: Pairs) -> dict[str, int]:
    """Signs that explain the motion, by leg."""
    sane = [[k for k in range(len(leg.flips)) if leg.sane(k)] for leg in legs]
    # Choices of signs grow with the legs.
    if not all(sane) or math.prod(map(len, sane)) > 300_000:
        return {}
    best = pairs.best(sane)
    if not pairs.rigid(best):
        return {}
    chosen = {}
    for i, leg in enumerate(legs):
        # Every other pattern of this leg must be worse, or nothing is said of it.
        least = BETTER * pairs.cost(best, i)
        others = [pairs.cost([*best[:i], k, *best[i + 1 :]], i) for k in sane[i] if k != best[i]]
        if all(cost > max(least, LOOSE**2) for cost in others):
            chosen[leg.leg.id] = best[i]
    return chosen


class _Others:
    """Orders and zeros under which the standing feet keep their distances, as patterns by leg.

    Args:
        legs: all of them stand with two others or more.
        lag: ticks of a displacement.
        period_s: the control tick.
    """

    def __init__(self, legs: Sequence[LegChoices], lag: int, period_s: float) -> None:
        self._legs, self._lag, self._period_s = legs, lag, period_s
        self._streams = [leg.stream for leg in legs]
        self._plain = [Reading.plain(len(leg.leg.joints)) for leg in legs]
        self._shared: Feet | None = None
        self._met = meetings(self._streams)

    def orders(self) -> dict[str, int]:
        """Another order of joints, the same for all legs."""
        if not self._of_a_kind():
            return {}
        tried = []
        for reading in self._orders(0):
            if all(leg.sane(leg.look_at(reading)) for leg in self._legs):
                tried.append((float(self._costs([reading] * len(self._legs)).max()), reading))
        best = _only(tried)
        return {} if best is None else self._patterns([best] * len(self._legs))

    def near_zeros(self) -> dict[str, int]:
        """Zeros near the described ones, of all legs alike or of one joint of one leg."""
        choices = []
        if self._of_a_kind():
            joints = len(self._plain[0].order)
            found = refine(self._feet(), self._plain, [range(joints)] * len(self._legs))
            if found.spread_rad <= SURE_RAD:
                choices.append([self._plain[0].shifted(found.moved_rad[0])] * len(self._legs))
        alone = self._one_leg(zeros_only=True, starts=ZERO_STARTS[:1])
        if alone is not None:
            choices.append(alone)
        choices.sort(key=self._mean_cost)
        if not choices or not self._explains(choices[0]):
            return {}
        if any(self._mean_cost(o) < ZERO_RIVAL * self._mean_cost(choices[0]) for o in choices[1:]):
            return {}
        return self._patterns(choices[0])

    def zeros(self) -> dict[str, int]:
        """Signs and zeros, the same for all legs, from anywhere."""
        grid = self._streams[0].grid
        # A search over all signs and zeros takes a second or more: it is made with so much motion,
        # s.
        if not self._of_a_kind() or (grid[-1] - grid[0]) * self._period_s < 15.0:
            return {}
        best = fit_readings(
            self._streams,
            self._lag,
            self._period_s,
            lambda k, reading: self._legs[k].sane(self._legs[k].look_at(reading)),
        )
        if best is None or not self._explains([best] * len(self._legs)):
            return {}
        return self._patterns([best] * len(self._legs))

    def one_leg(self) -> dict[str, int]:
        """Another order of the worst leg's joints, or another zero of one of them."""
        readings = self._one_leg()
        return {} if readings is None else self._patterns(readings)

    def _one_leg(
        self, *, zeros_only: bool = False, starts: Sequence[float] = ZERO_STARTS
    ) -> list[Reading] | None:
        costs = self._costs(self._plain)
        worst = int(np.argmax(costs))
        rest = [k for k in range(len(self._legs)) if k != worst]
        if len(rest) < 3:
            return None
        feet = Feet(
            [self._streams[k] for k in rest],
            self._lag,
            self._period_s,
            [self._plain[k] for k in rest],
        )
        # In a tripod two are left that stand together.
        alone = feet.costs([self._plain[k] for k in rest], least_partners=1)
        if not (alone < RIGID**2).all() or not all(self._legs[k].sane(0) for k in rest):
            return None
        best = None
        if not zeros_only:
            leg = self._legs[worst]
            tried = [
                (self._cost_with(worst, reading), reading)
                for reading in self._orders(worst)
                if leg.sane(leg.look_at(reading))
            ]
            best = _only(tried)
        best = best or self._zero_of(worst, float(costs[worst]), starts)
        if best is None:
            return None
        readings = list(self._plain)
        readings[worst] = best
        return readings

    def _explains(self, readings: Sequence[Reading]) -> bool:
        """Whether zeros that are far enough off make the feet so much more rigid."""
        far = max(abs(offset) for reading in readings for offset in reading.offsets_rad)
        before, after = self._costs(self._plain), self._costs(readings)
        if len(set(readings)) > 1:  # of one leg alone, whose cost is what falls
            moved = [k for k, reading in enumerate(readings) if reading != self._plain[k]]
            before, after = before[moved], after[moved]
        return far >= LEAST_ZERO_RAD and bool(before.mean() >= ZERO_BETTER * after.mean())

    def _mean_cost(self, readings: Sequence[Reading]) -> float:
        return float(self._costs(readings).mean())

    def _zero_of(self, worst: int, before: float, starts: Sequence[float]) -> Reading | None:
        """The zero of one joint of a leg that explains its motion."""
        joints = len(self._plain[worst].order)
        tried = []
        for joint in range(joints):
            shifts = [np.eye(joints)[joint] * start for start in starts]
            shifts.sort(key=lambda by: self._cost_with(worst, self._plain[worst].shifted(by)))
            found = [self._refined(worst, joint, by) for by in shifts[:2]]
            tried.append(min(found, key=lambda each: each[0]))
        tried.sort(key=lambda each: each[0])
        (least, best), *rivals = tried
        moved = max(abs(offset) for offset in best.offsets_rad)
        leg = self._legs[worst]
        readings = list(self._plain)
        readings[worst] = best
        if (
            least < RIGID**2
            # No leg may be left that is as bad: that one might be the wrong one.
            and before >= ZERO_BETTER * float(self._costs(readings).max())
            and all(cost >= ZERO_RIVAL * least for cost, _ in rivals)
            and moved >= LEAST_ZERO_RAD
            and leg.sane(leg.look_at(best))
        ):
            return best
        return None

    def _refined(self, worst: int, joint: int, by_rad: Array) -> tuple[float, Reading]:
        moved = [[-1] * len(plain.order) for plain in self._plain]
        moved[worst][joint] = 0
        readings = list(self._plain)
        readings[worst] = self._plain[worst].shifted(by_rad)
        found = refine(self._feet(readings), readings, moved)
        best = readings[worst].shifted(found.moved_rad[worst])
        sure = found.spread_rad <= SURE_RAD
        return self._cost_with(worst, best) if sure else MOST, best

    def _cost_with(self, worst: int, reading: Reading) -> float:
        readings = list(self._plain)
        readings[worst] = reading
        return float(self._costs(readings)[worst])

    def _orders(self, k: int) -> list[Reading]:
        """Every order of a leg's joints, with every pattern of its signs."""
        leg = self._legs[k]
        joints = len(leg.leg.joints)
        # Orders of so many joints are tried.
        if joints > 4:
            return []
        signs = leg.readings[: len(leg.flips)]
        return [
            sign._replace(order=order)
            for order in itertools.permutations(range(joints))
            for sign in signs
        ]

    def _of_a_kind(self) -> bool:
        """Whether one reading can hold for all legs."""
        return len({leg.leg.joint_axes for leg in self._legs}) == 1

    def _feet(self, readings: Sequence[Reading] | None = None) -> Feet:
        phase_given = all(stream.swing is not None for stream in self._streams)
        if phase_given and self._shared is not None:
            return self._shared
        feet = Feet(self._streams, self._lag, self._period_s, readings or self._plain, self._met)
        if phase_given:
            self._shared = feet
        return feet

    def _costs(self, readings: Sequence[Reading]) -> Array:
        return np.clip(self._feet(readings).costs(readings), FLOOR**2, MOST)

    def _patterns(self, readings: Sequence[Reading]) -> dict[str, int]:
        return {
            leg.leg.id: leg.look_at(_settled_offsets(reading))
            for leg, reading in zip(self._legs, readings, strict=True)
        }


def _only(tried: Sequence[tuple[float, Reading]]) -> Reading | None:
    """The reading that explains the motion where no other does."""
    if not tried:
        return None
    least, best = min(tried, key=lambda each: each[0])
    rivals = [cost for cost, reading in tried if reading != best]
    if least >= RIGID**2 or any(cost < max(BETTER * least, LOOSE**2) for cost in rivals):
        return None
    return best


def _settled_offsets(reading: Reading) -> Reading:
    """A reading without what a fit leaves open, in hundredths of a radian."""
    return reading._replace(
        offsets_rad=tuple(
            0.0 if abs(offset) < OPEN_RAD else round(offset, 2) for offset in reading.offsets_rad
        )
    )
