"""Computes one leg's angles under every choice of signs, and their plausibility.

A leg that walks is below its axis, and higher in its swings than where it stands; the ground
pushes it up.  Where that is turned round, all its pitch angles are.
"""

from __future__ import annotations

import itertools
import math
import statistics
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.checks.conventions.motion import LegMotion
from adaptive_contact.checks.conventions.rigid import LAG_S, Reading, Stream, pushed_up, standing
from adaptive_contact.robot.description import Leg

# A leg's foot counts as above its axis, or below, in this share of its ticks.
SURE_SHARE: Final = 0.9
# Patterns of signs grow as powers of two.
MOST_FLIPS: Final = 5


class Chosen(NamedTuple):
    """The pattern of a leg that explains its motion, and those that do as well."""

    pattern: int
    others: tuple[int, ...] = ()
    pushed: bool = False  # it is the ground's push that shows it


class LegChoices:
    """One leg under every pattern of signs, and under others that are looked at.

    Args:
        leg: its description, with a geometry.
        motion: what it did.
        grid: (n,) control ticks.
        period_s: the control tick.

    Attributes:
        chain: its geometry.
        lifts: (J,) the joints that can raise its foot.
        flips: (F, J) 1 or -1; the description's is the first.
        readings: those of the flips, and others that were looked at.
        stream: what it was commanded.
    """

    def __init__(self, leg: Leg, motion: LegMotion, grid: Ints, period_s: float) -> None:
        self.leg, self.motion = leg, motion
        self.stream = Stream(leg, motion.desired, grid, motion.swing)
        assert leg.chain is not None
        self.chain = leg.chain
        self.lifts = leg.chain.lifts
        flippable = self.lifts.copy()
        if len(flippable) <= MOST_FLIPS:
            flippable |= ~self.lifts
        free = np.flatnonzero(flippable)[:MOST_FLIPS]
        self.flips = np.ones((2 ** len(free), len(leg.joints)))
        for row, signs in zip(
            self.flips, itertools.product((1.0, -1.0), repeat=len(free)), strict=True
        ):
            row[free] = signs
        plain = Reading.plain(len(leg.joints))
        self.readings = [
            plain._replace(directions=tuple(int(sign) for sign in flip)) for flip in self.flips
        ]
        self._period_s = period_s
        self._places: dict[int, Array] = {}

    def look_at(self, reading: Reading) -> int:
        """The pattern of a reading, to be asked about."""
        if reading not in self.readings:
            self.readings.append(reading)
        return self.readings.index(reading)

    def place(self, pattern: int) -> Array:
        """(n, 3) m, the commanded foot in the leg's frame."""
        if pattern not in self._places:
            self._places[pattern] = self.stream.place(self.readings[pattern])
        return self._places[pattern]

    def height(self, pattern: int) -> Array:
        """(n,) m of it."""
        return self.place(pattern)[:, 2]

    # -- alone -----------------------------------------------------------------------------------

    def rises(self, pattern: int) -> float | None:
        """Share of swings in which the commanded foot is higher than in the stance before."""
        swing = self.motion.swing
        if swing is None:
            return None
        edges = np.flatnonzero(np.diff(swing.astype(np.int8)))
        parts = np.split(self.height(pattern), edges + 1)
        if len(parts) < 3:
            return None
        first_swings = bool(swing[0])
        levels: list[float] = [statistics.median(part.tolist()) for part in parts]
        pairs = [
            levels[i] - levels[i - 1] for i in range(1, len(levels)) if (i % 2 == 0) == first_swings
        ]
        clear = [rise for rise in pairs if abs(rise) > 0.004]
        # Swings of a leg before its phase is compared with its height.
        if len(clear) < 4:
            return None
        return sum(rise > 0 for rise in clear) / len(clear)

    def below(self, pattern: int) -> float:
        """Share of ticks in which the commanded foot is below its first joint."""
        return float(np.mean(self.height(pattern) < 0.0))

    def sane(self, pattern: int) -> bool:
        """Whether a leg that walks may move so."""
        rises = self.rises(pattern)
        return self.below(pattern) >= SURE_SHARE and (rises is None or rises >= SURE_SHARE)

    def insane(self, pattern: int) -> bool:
        """Whether a leg that walks cannot move so; not the opposite of :meth:`sane`."""
        rises = self.rises(pattern)
        return self.below(pattern) < 0.5 or (rises is not None and rises < 0.5)

    def may_move(self, pattern: int) -> bool:
        """Whether a leg that walks may move so, within its limits."""
        return self.sane(pattern) and self._within(pattern)

    def upside_down(self, pattern: int) -> bool:
        """Whether a leg that walks moves the other way round."""
        rises = self.rises(pattern)
        return (
            self.below(pattern) <= 1 - SURE_SHARE
            and rises is not None
            and (rises <= 1 - SURE_SHARE)
        )

    def sags_rad(self) -> Array:
        """By how much the first pitch joint gives way to gravity in each hold, (m,) rad.

        Plus is down, by the description; holds in which the foot is under the joint are left out.
        The leg is straight.
        """
        motion = self.motion
        grid = self.stream.grid
        same = (np.diff(motion.desired, axis=0) == 0.0).all(axis=1) & (np.diff(grid) == 1)
        # A servo rests when its command has not changed for this long, s; the last part of it is
        # looked at.
        hold, rest = round(0.36 / self._period_s), round(0.16 / self._period_s)
        # The last tick of every stretch of unchanged commands.
        ends = np.flatnonzero(same & np.append(~same[1:], True)) + 1
        begins = np.flatnonzero(same & np.append(True, ~same[:-1]))
        first = int(np.flatnonzero(self.lifts)[0])
        # Gravity pulls at a joint where its foot is this share of its links' reach away from it.
        least = 0.3 * sum(length for length, _, _ in self.chain.origins_m[first:])
        sags = []
        for begin, end in zip(begins, ends, strict=True):
            if end - begin < hold:
                continue
            command = motion.desired[end]
            lever = self.chain.height_gradients(command)[first]
            off = float(np.mean(motion.measured[end - rest : end + 1, first]) - command[first])
            if abs(lever) >= least:
                sags.append(-math.copysign(off, off * lever))
        return np.array(sags)

    def alone(self) -> Chosen | None:
        """What this leg shows by itself; None for nothing that is sure."""
        upside_down = self.upside_down(0)
        pushed = not upside_down and self.motion.swing is None and self.below(0) <= 1 - SURE_SHARE
        if not upside_down and not pushed:
            return None
        lifting = [k for k, flip in enumerate(self.flips) if (flip[~self.lifts] > 0).all()]
        left = [k for k in lifting if not self.insane(k) and self._within(k)]
        # That all of them are turned round is the usual case: half of all robots are.
        left.sort(key=lambda k: not (self.flips[k][self.lifts] < 0).all())
        best = next((k for k in left if self.sane(k)), None)
        lag = max(round(LAG_S / self._period_s), 1)
        if best is None or (pushed and not self.carries(best, lag)):
            return None
        return Chosen(best, tuple(k for k in left if k != best), pushed)

    def _within(self, pattern: int) -> bool:
        """Whether commands stay within the joints' limits, where there are any."""
        limits = self.leg.limits
        if limits is None:
            return True
        turned = self.motion.desired * self.flips[pattern]
        inside = (turned >= limits.lower_rad) & (turned <= limits.upper_rad)
        return bool(inside.all(axis=1).mean() >= SURE_SHARE)

    def carries(self, pattern: int, lag: int) -> bool:
        """Whether the ground pushes the foot up where it stands."""
        at = self.stands(pattern, lag)
        read = self.chain.foot(self.readings[pattern].angles(self.motion.measured[at]))
        return pushed_up(self.chain.reach_m, self.height(pattern)[at], read[:, 2])

    # -- with others -----------------------------------------------------------------------------

    def stands(self, pattern: int, lag: int) -> Ints:
        """(m,) rows in which the foot stands, and has for ``lag`` ticks."""
        return np.flatnonzero(standing(self.stream, self.height(pattern), lag, self._period_s))

    def stood(self, place: Array, pattern: int, lag: int) -> tuple[Array, Ints]:
        """Of (n, 3) places those where it stands and ``lag`` before, (m, 2, 3), and their ticks."""
        rows = self.stands(pattern, lag)
        return np.stack([place[rows], place[rows - lag]], axis=1), self.stream.grid[rows]
