r"""Compares legs by their standing feet, which do not move against each other.

rho² of two legs is the mean squared change of their feet's distance over a time, divided by the
mean squared way that they go in it: near 0 where both sit where they are described.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.conventions.rigid import (
    LEAST_ROWS,
    RIGID,
    SETTLE_S,
    on_body,
    pushed_up,
    rigidity,
)
from adaptive_contact.robot import Leg
from adaptive_contact.robot.gait_phase import infer_phase

# Standing feet: over this time, s; rho of a body that is not rigid (see conventions.rigid).
LAG_S: Final = 0.08
LOOSE: Final = 0.12


@dataclasses.dataclass(frozen=True)
class LegRows:
    """Holds one leg's samples in order, in the frame of its description."""

    seq: Ints  # (n,) numbers of the control ticks, counted alike in all legs
    # measured, desired: (n, J) rad
    measured: Array
    desired: Array
    swing: Mask | None  # (n,) as the source reports; None where it does not


def standing_feet(
    legs: Sequence[Leg], rows: Sequence[LegRows], period_s: float
) -> StandingFeet | None:
    """Return the places of legs on the body, where the description says enough of them."""
    alike = len({leg.joint_axes for leg in legs}) == 1
    if (
        not alike
        or not 3 <= len(legs) <= 6
        or any(leg.chain is None or not leg.chain.is_straight for leg in legs)
    ):
        return None
    if len({leg.mount for leg in legs}) < len(legs):
        return None
    return StandingFeet(legs, rows, period_s)


_Seat = tuple[int, int, bool]  # whose samples, at which place, with the yaw turned


class StandingFeet:
    """Computes rho² of pairs of legs at every two places of the body.

    Args:
        legs: described; where they sit.
        rows: the samples that come under their names.
        period_s: control tick.
    """

    def __init__(self, legs: Sequence[Leg], rows: Sequence[LegRows], period_s: float) -> None:
        self._legs, self._rows = legs, rows
        self._lag, settle = (max(round(time / period_s), 1) for time in (LAG_S, SETTLE_S))
        self._at = [
            _standing(leg, of_leg, self._lag, settle)
            for leg, of_leg in zip(legs, rows, strict=True)
        ]
        self._feet: dict[tuple[int, int, bool], Array] = {}
        self._pairs: dict[tuple[_Seat, _Seat], tuple[float, float]] = {}

    def rigid_orders(self) -> list[tuple[int, ...]]:
        """Find the places at which standing feet keep their distances.

        Returns:
            For each answer the place of every leg's samples; those that move fewest legs first.
            Empty where nothing is known.
        """
        own = tuple(range(len(self._legs)))
        known = [cost for cost in self.costs(own) if math.isfinite(cost)]
        loose = bool(known) and (self.rigid(own) or max(known) >= LOOSE**2)
        if not loose or 2 * sum(map(self._carries, own)) < len(own):
            return []
        orders = [order for order in itertools.permutations(own) if self.rigid(order)]
        return sorted(orders, key=lambda order: sum(i != k for i, k in enumerate(order)))

    def rigid_with_yaw_turned(self, legs: Sequence[int]) -> bool:
        """Whether feet keep their distances if these legs' yaw has the other sign."""
        own = range(len(self._legs))
        return self.rigid(own, [i in legs for i in own])

    def costs(self, order: Sequence[int], turned: Sequence[bool] | None = None) -> list[float]:
        """rho² of every leg with the others; infinite where it stands with less than two."""
        n = len(order)
        turned = [False] * n if turned is None else turned
        seats = [(i, order[i], turned[i]) for i in range(n)]
        found = []
        for i in range(n):
            pairs = [self._pair(seats[i], seats[j]) for j in range(n) if j != i]
            known = [(weight, ratio) for weight, ratio in pairs if weight > 0]
            if len(known) < 2:
                found.append(math.inf)
            else:
                found.append(sum(w * r for w, r in known) / sum(w for w, _ in known))
        return found

    def rigid(self, order: Sequence[int], turned: Sequence[bool] | None = None) -> bool:
        """Whether every leg keeps its distances from the others."""
        return all(cost < RIGID**2 for cost in self.costs(order, turned))

    def _carries(self, leg: int) -> bool:
        """Whether the ground pushes a foot up where it stands; of one that hangs nothing shows."""
        chain, rows, at = self._legs[leg].chain, self._rows[leg], self._at[leg]
        assert chain is not None
        angles = (rows.desired[at], rows.measured[at])
        return pushed_up(chain.reach_m, *(chain.foot(of)[:, 2] for of in angles))

    def _pair(self, one: _Seat, other: _Seat) -> tuple[float, float]:
        key = (min(one, other), max(one, other))
        if key not in self._pairs:
            self._pairs[key] = self._compare(*key)
        return self._pairs[key]

    def _foot(self, seat: _Seat) -> Array:
        """(m, 2, 3) m, where a foot that stands is and was."""
        if seat not in self._feet:
            leg, place, turned = seat
            at, desired = self._at[leg], self._rows[leg].desired
            if turned:
                desired = desired * [
                    -1.0 if a == "yaw" else 1.0 for a in self._legs[leg].joint_axes
                ]
            seated = self._legs[place]
            assert seated.chain is not None
            feet = on_body(seated, seated.chain.foot(desired))
            self._feet[seat] = np.stack([feet[at], feet[at - self._lag]], axis=1)
        return self._feet[seat]

    def _compare(self, one: _Seat, other: _Seat) -> tuple[float, float]:
        mine, theirs = (self._rows[leg].seq[self._at[leg]] for leg, *_ in (one, other))
        _, rows, columns = np.intersect1d(mine, theirs, assume_unique=True, return_indices=True)
        if len(rows) < LEAST_ROWS:
            return 0.0, math.inf
        rho2 = rigidity(self._foot(one)[rows], self._foot(other)[columns])
        return (float(len(rows)) ** 2 if math.isfinite(rho2) else 0.0), rho2


def _standing(leg: Leg, rows: LegRows, lag: int, settle: int) -> Ints:
    """Rows at which a foot stands, and has for ``lag`` ticks after settling."""
    swing = rows.swing if rows.swing is not None else infer_phase(rows.desired, leg)
    assert swing is not None
    # After a gap the foot counts as just put down.
    down = np.cumsum(~swing)
    n = settle + lag
    if len(down) <= n:
        return np.zeros(0, dtype=np.int64)
    at = np.arange(n, len(down))
    steady = (down[n:] - down[:-n] == n) & (rows.seq[n:] - rows.seq[:-n] == n)
    return np.asarray(at[steady])
