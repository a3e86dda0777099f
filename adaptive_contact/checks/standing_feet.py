"""Compares the places of legs on the body by their standing feet (``conventions.rigid``)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.checks.conventions.motion import LegMotion, control_ticks
from adaptive_contact.checks.conventions.rigid import LAG_S, on_body
from adaptive_contact.checks.conventions.sign_choices import LegChoices
from adaptive_contact.checks.conventions.together import LOOSE, Pairs
from adaptive_contact.robot import Robot


class StandingFeet:
    """Finds the places of the body at which the feet that stand keep their distances.

    Args:
        robot: its description, with chains of all legs.
        motions: what came under the names of three legs or more.

    Attributes:
        ids: of these legs.
    """

    def __init__(self, robot: Robot, motions: Mapping[str, LegMotion]) -> None:
        ticks = control_ticks(motions, robot.period_s)
        self._lag = max(round(LAG_S / robot.period_s), 1)
        self._legs = legs = [
            LegChoices(leg, motions[leg.id], ticks[leg.id], robot.period_s)
            for leg in robot.legs
            if leg.id in motions
        ]
        self.ids = [leg.leg.id for leg in legs]
        lag, n = self._lag, len(legs)

        def stands(i: int, pattern: int) -> tuple[Array, Ints]:
            """A leg's samples at the place of leg ``pattern``; with n at their own, yaws turned."""
            seat = legs[i if pattern == n else pattern]
            yaws = pattern == n and np.array(seat.leg.joint_axes) == "yaw"
            place = seat.chain.foot(legs[i].motion.desired * np.where(yaws, -1.0, 1.0))
            return legs[i].stood(on_body(seat.leg, place), 0, lag)

        self._pairs = Pairs(stands)

    @property
    def rigid(self) -> bool:
        """Return whether the feet keep their distances where the legs are described."""
        return self._pairs.rigid(range(len(self._legs)))

    def rigid_orders(self) -> list[tuple[int, ...]]:
        """Return for each answer the place of every leg's samples; least moved legs first."""
        own = range(len(self._legs))
        known = [cost for i in own if np.isfinite(cost := self._pairs.cost(own, i))]
        loose = bool(known) and (self.rigid or max(known) >= LOOSE**2)
        # Of a robot that hangs nothing shows.
        if not loose or 2 * sum(leg.carries(0, self._lag) for leg in self._legs) < len(own):
            return []
        orders = [order for order in itertools.permutations(own) if self._pairs.rigid(order)]
        return sorted(orders, key=lambda order: sum(i != k for i, k in enumerate(order)))

    def rigid_with_yaw_turned(self, moved: list[int]) -> bool:
        """Return whether they keep them if the yaws of these legs have the other sign."""
        own = range(len(self._legs))
        return self._pairs.rigid([len(own) if i in moved else i for i in own])
