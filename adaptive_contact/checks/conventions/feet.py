r"""Compares standing feet, whatever the body does over them, for any way to read the legs' angles.

With the legs' mounts known, the distance of two standing feet is constant.  How far commanded feet
break that is

.. math:: \rho^2 = \frac{\overline{(\Delta |p_i - p_j|)^2}}{\overline{|\Delta p|^2}}

over ticks in which both stand.  Where a description reads the angles right, it is 0.03 to 0.08,
and least.  :func:`refine` finds the zeros near a start for which it is.

A leg that walks is below its axis, and higher in its swings than where it stands; the ground
pushes it up.  Where that is turned round, all its pitch angles are.
"""

from __future__ import annotations

import functools
import itertools
import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, scipy
from adaptive_contact.checks.limits import Limits
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.robot.description import Leg

# Displacements are taken over this time, s: long against the jitter of a command's rounding, short
# against a stance.
LAG_S: Final = 0.08
# After a touch a controller may press the foot down for this long, s, and before the lift a
# phase may be reported late.
SETTLE_S: Final = 0.12
BEFORE_LIFT_S: Final = 0.06
# A pair of legs with fewer ticks in common shows nothing.
LEAST_ROWS: Final = 40
# Rows of a pair that are looked at; more add nothing, as they come from the same swings.
MOST_ROWS: Final = 120
# Of the ticks of a pair, the worst share is left out: feet that slip, and touches.
KEPT_SHARE: Final = 0.7
# Standing feet must move by so much per displacement, m, for their distance to show anything.
LEAST_WAY_M: Final = 0.002
# rho² beyond which a pair is as bad as can be.
MOST: Final = 4.0
# rho of feet that stand: 0.03 to 0.08 where the description is right, and of one that is wrong.
RIGID: Final = 0.1
LOOSE: Final = 0.12
# Below this rho nothing but rounding and slip is left: what is below is as good.
FLOOR: Final = 0.03
# A foot that carries is above its command by these shares of the leg's reach.  Three to six of six
# simulated legs that walk are by 0.001 to 0.012; of a real robot that hangs, feet are by 0.0002 at
# most, or, where a joint does not follow, by 0.01 to 0.2.
CARRIED: Final = 0.001
LIMP: Final = 0.03
# A leg's foot counts as above its axis, or below, in this share of its ticks.
SURE_SHARE: Final = 0.9
# A servo rests when its command has not changed for this long, s.
HOLD_S: Final = 0.36
# Patterns of signs grow as powers of two.
MOST_FLIPS: Final = 5
# Errors of rows are not independent: their mean square is as sure as that of so many.
SWINGS: Final = 30
# A fit of zeros ends where they move by less, rad.
NEAR_RAD: Final = 2e-3
# Ways to read a leg, and pairs of legs, whose feet are remembered.
_PLACES, _PAIRS = 256, 8192


class Reading(NamedTuple):
    """How a source's angles are read: ``directions * angles[order] + offsets_rad``."""

    order: tuple[int, ...]  # (J,) which of the source's values is each joint's
    directions: tuple[int, ...]  # (J,) 1 or -1
    offsets_rad: tuple[float, ...]  # (J,) rad

    def angles(self, source: Array) -> Array:
        """(n, J) rad of the description for (n, J) rad of the source."""
        turned = source[:, list(self.order)] * np.array(self.directions)
        return np.asarray(turned + np.array(self.offsets_rad))

    def shifted(self, by_rad: Sequence[float] | Array) -> Reading:
        """The same with zeros moved on, within half a turn."""
        moved = zip(self.offsets_rad, by_rad, strict=True)
        return self._replace(offsets_rad=tuple(math.remainder(o + d, math.tau) for o, d in moved))


class Walker:
    """One leg and its motion, by any reading.

    Args:
        leg: its description, with a geometry.
        motion: what it did.
        grid: (n,) control ticks.
        period_s: the control tick.

    Attributes:
        chain: its geometry.
        plain: the reading of the description.
        signs: readings with every choice of signs; the plain one is the first.
        lag: ticks of a displacement.
    """

    def __init__(self, leg: Leg, motion: LegMotion, grid: Ints, period_s: float) -> None:
        self.leg, self.motion, self.grid, self._period_s = leg, motion, grid, period_s
        assert leg.chain is not None
        self.chain = leg.chain
        joints = len(leg.joints)
        self.plain = Reading(tuple(range(joints)), (1,) * joints, (0.0,) * joints)
        lifts = self.chain.lifts
        free = range(joints) if joints <= MOST_FLIPS else np.flatnonzero(lifts)[:MOST_FLIPS]
        choices = [(1, -1) if joint in free else (1,) for joint in range(joints)]
        self.signs = [self.plain._replace(directions=of) for of in itertools.product(*choices)]
        self.lag = max(round(LAG_S / period_s), 1)
        self.place = functools.lru_cache(_PLACES)(self._locate)
        self.stands = functools.lru_cache(_PLACES)(self._stands)

    def _locate(self, reading: Reading) -> Array:
        """(n, 3) m, the commanded foot on the body."""
        return self.leg.on_body(self.chain.foot(reading.angles(self.motion.desired)))

    def height(self, reading: Reading) -> Array:
        """(n,) m of it over the leg's axis."""
        return np.asarray(self.place(reading)[:, 2] - self.leg.mount.xyz_m[2])

    def _stands(self, reading: Reading, lag: int) -> Ints:
        """(m,) rows in which the foot stands, and has for ``lag`` ticks."""
        if self.motion.swing is not None:
            down = ~self.motion.swing
        else:  # by its height, the lower half of its range
            height = self.height(reading)
            down = height < np.quantile(height, (0.05, 0.95)).mean()
        count = np.concatenate([[0], np.cumsum(down)])
        n = len(down)
        settle = round(SETTLE_S / self._period_s) + lag
        first = np.maximum(np.arange(n) - settle, 0)
        last = np.minimum(np.arange(n) + round(BEFORE_LIFT_S / self._period_s) + 1, n)
        steady = count[last] - count[first] == last - first
        steady[:settle] = False
        steady[lag:] &= self.grid[lag:] - self.grid[:-lag] == lag
        return np.flatnonzero(steady)

    # -- alone -----------------------------------------------------------------------------------

    def _upright(self, reading: Reading) -> list[float]:
        """Shares of ticks below the axis, and of swings that rise over the stance before."""
        height, swing = self.height(reading), self.motion.swing
        found = [float(np.mean(height < 0.0))]
        if swing is None:
            return found
        parts = np.split(height, np.flatnonzero(np.diff(swing.astype(np.int8))) + 1)
        levels: list[float] = [statistics.median(part.tolist()) for part in parts]
        rises = np.diff(levels)[int(swing[0]) :: 2]
        clear = rises[np.abs(rises) > 0.004]
        # Swings of a leg before its phase is compared with its height.
        if len(clear) >= 4:
            found.append(float(np.mean(clear > 0.0)))
        return found

    def sane(self, reading: Reading, share: float = SURE_SHARE) -> bool:
        """Whether a leg that walks may move so, by such a share of its ticks and swings."""
        return min(self._upright(reading)) >= share

    def within(self, reading: Reading) -> bool:
        """Whether commands stay within the joints' limits, where there are any."""
        turned, limits = reading.angles(self.motion.desired), Limits.from_leg(self.leg)
        inside = (turned >= limits.lower) & (turned <= limits.upper)
        return bool(inside.all(axis=1).mean() >= SURE_SHARE)

    def upside_down(self) -> bool:
        """Whether a leg that walks moves the other way round, by all that its phase can show."""
        shown = self._upright(self.plain)
        whole = len(shown) == (1 if self.motion.swing is None else 2)
        return whole and max(shown) <= 1 - SURE_SHARE

    def carries(self, reading: Reading) -> bool:
        """Whether the foot is above its command where it stands, as the ground pushes it up."""
        at = self.stands(reading, self.lag)
        read = self.chain.foot(reading.angles(self.motion.measured[at]))[:, 2]
        up = float(np.median(read - self.height(reading)[at])) if len(at) else 0.0
        return CARRIED * self.chain.reach_m < up < LIMP * self.chain.reach_m

    def up_at_rest_m(self) -> Array:
        """By how much the foot is above its command at the end of each hold, (m,) m."""
        desired, hold = self.motion.desired, round(HOLD_S / self._period_s)
        still = (desired[hold:] == desired[:-hold]).all(axis=1)
        ends = np.flatnonzero(still & np.append(~still[1:], True)) + hold
        read, told = (self.chain.foot(of[ends])[:, 2] for of in (self.motion.measured, desired))
        return np.asarray(read - told)


class _Pair(NamedTuple):
    """What becomes of the distance of two feet, in ticks in which both stand."""

    weight: float
    change: Array  # (m,) m
    way2: Array  # (m,) m², mean of both
    ratio: float  # rho²; infinite where they hardly move, or stand together in few ticks


class Feet:
    """Standing feet of legs, each of which is read in many ways.

    Args:
        legs: three or more, or two that stand together.
        lag: ticks of a displacement.
        stance: by which reading each leg stands; by the one that is asked about where absent.
            Where the source reports the phase, all are alike.
        place: the foot of a leg for a choice, (n, 3) m on the body; that of a reading where absent.
    """

    def __init__(
        self,
        legs: Sequence[Walker],
        lag: int,
        stance: Sequence[Reading] | None = None,
        place: Callable[[int, Any], Array] | None = None,
    ) -> None:
        self.legs, self.lag = legs, lag
        self._stance = stance
        self._place = place or (lambda i, reading: legs[i].place(reading))
        self._meeting = functools.lru_cache(_PAIRS)(self._meet)
        self._pair = functools.lru_cache(_PAIRS)(self._compare)

    def _stands_by(self, i: int, choice: Any) -> Any:
        """The reading of a leg that shows where it stands."""
        if self.legs[i].motion.swing is not None:
            return self.legs[i].plain
        return choice if self._stance is None else self._stance[i]

    def _meet(self, i: int, j: int, a: Reading, b: Reading) -> tuple[Ints, Ints, int]:
        """Rows of two legs in ticks in which both stand, and the number of such ticks."""
        mine, theirs = self.legs[i].stands(a, self.lag), self.legs[j].stands(b, self.lag)
        grids = self.legs[i].grid[mine], self.legs[j].grid[theirs]
        _, rows, columns = np.intersect1d(*grids, return_indices=True)
        step = max(-(-len(rows) // MOST_ROWS), 1)
        return mine[rows[::step]], theirs[columns[::step]], len(rows)

    def _compare(self, i: int, j: int, a: Any, b: Any) -> _Pair:
        """Two legs by a choice of each."""
        by = self._stands_by(i, a), self._stands_by(j, b)
        rows, columns, count = self._meeting(i, j, *by)
        p, q = self._place(i, a), self._place(j, b)
        now, then = p[rows], p[rows - self.lag]
        other, before = q[columns], q[columns - self.lag]
        change = np.sqrt(_squared(now - other)) - np.sqrt(_squared(then - before))
        way2 = (_squared(now - then) + _squared(other - before)) / 2.0
        kept = np.argsort(np.abs(change))[: math.ceil(KEPT_SHARE * len(change))]
        if count < LEAST_ROWS:
            return _Pair(0.0, change, way2, np.inf)
        way = float(way2[kept].mean())
        ratio = float(np.square(change[kept]).mean() / way) if way >= LEAST_WAY_M**2 else np.inf
        # Legs that stand by turns meet in few ticks, those of a touch and a lift.
        return _Pair(float(count) ** 2, change, way2, ratio)

    def _pairs(self, chosen: Sequence[Any]) -> list[tuple[int, int, _Pair]]:
        return [
            (i, j, self._pair(i, j, chosen[i], chosen[j]))
            for i, j in itertools.combinations(range(len(self.legs)), 2)
        ]

    def costs(self, chosen: Sequence[Any], least_partners: int = 2) -> Array:
        """(n,) rho² of every leg with the others; infinite where it stands with too few of them.

        Args:
            chosen: how each leg is read.
            least_partners: others with which a leg has to stand.
        """
        total, weight, partners = np.zeros((3, len(self.legs)))
        for i, j, pair in self._pairs(chosen):
            if np.isfinite(pair.ratio):
                for k in (i, j):
                    total[k] += pair.weight * pair.ratio
                    weight[k] += pair.weight
                    partners[k] += 1
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(partners >= least_partners, total / weight, np.inf)

    def rigid(self, chosen: Sequence[Any]) -> bool:
        """Whether every leg that stands keeps its distances from the others."""
        return bool((self.costs(chosen) < RIGID**2).all())

    def errors(self, readings: Sequence[Reading]) -> Array:
        """(m,) changes of distance over each pair's way, weighed: their squares add to rho²."""
        pairs = [pair for _, _, pair in self._pairs(readings) if pair.weight]
        whole = sum(pair.weight * len(pair.change) for pair in pairs)
        parts = [
            pair.change * math.sqrt(pair.weight / whole / max(pair.way2.mean(), LEAST_WAY_M**2))
            for pair in pairs
        ]
        return np.concatenate(parts) if parts else np.zeros(0)


def _squared(vectors: Array) -> Array:
    """(m,) squared lengths of (m, 3) vectors."""
    return np.asarray(np.square(vectors).sum(axis=1))


def refine(
    feet: Feet, readings: Sequence[Reading], moved: Sequence[Sequence[int]]
) -> tuple[list[Reading], float]:
    """Find the zeros near a start for which the feet are most rigid, by least squares.

    Feet that slip, and touches, weigh little, by a loss that grows as a logarithm.

    Args:
        feet: that stand, by one stance of each leg.
        readings: (n,) of the legs, to start from.
        moved: of every leg, the parameter that shifts each joint's zero, -1 for none; legs that
            share a parameter are shifted alike.

    Returns:
        The readings, and the largest standard deviation of a parameter, rad: where the motion does
        not show a zero, as that of feet that go to and fro in a line, it is large.
    """

    def at(x: Array) -> list[Reading]:
        padded = np.append(x, 0.0)
        return [r.shifted(padded[list(own)]) for r, own in zip(readings, moved, strict=True)]

    rows = max(len(feet.errors(readings)), 1)
    fit = scipy.optimize.least_squares(
        lambda x: feet.errors(at(x)), np.zeros(1 + max(max(own) for own in moved)),
        loss="cauchy", f_scale=2.0 * RIGID / math.sqrt(rows), xtol=NEAR_RAD, max_nfev=15,
    )  # fmt: skip
    weakest = float(np.linalg.eigvalsh(fit.jac.T @ fit.jac)[0])
    found = at(fit.x)
    floor = float(np.clip(feet.costs(found, 1), FLOOR**2, MOST).mean()) / SWINGS
    return found, math.sqrt(floor / weakest) if weakest > 0 else math.inf
