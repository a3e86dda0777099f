r"""Finds where servos stop whatever is commanded, and what they follow instead: the clipped goals.

A servo whose goal lies beyond its own limit goes to the limit.  Who sends the goal need not know.
With :math:`[l, h]` of a joint the command that its model sees is :math:`\min(\max(u, l), h)`.  A
limit is described (``limits`` in ``robot.toml``), until readings go beyond it, or observed: the
readings end at one value however far the command goes, while the foot is at different places, so
that no ground stops it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.robot import Leg
from adaptive_contact.robot.kinematics import Chain

# Where a joint stops differs by friction: by so much, rad, and so many steps.
STOP_RAD: Final = 0.01
STOP_STEPS: Final = 3.0
# Ticks in a row beyond, after which a servo has come to its stop; ticks and times that show one.
SETTLED: Final = 6
LEAST_TICKS: Final = 20
LEAST_TIMES: Final = 3
# Of these ticks, the share that reads the stop; and how the command varies in them, rad.
STOPPED_SHARE: Final = 0.9
LEAST_SPREAD_RAD: Final = 0.05
# A joint that never goes so far from the stop, rad, is held; a share of all ticks is at no stop.
LEAST_TRAVEL_RAD: Final = 0.15
MOST_SHARE: Final = 0.7
# Places of the foot differ by so much, m of the hexapod's leg, or those of another joint, rad.
LEAST_HEIGHT_M: Final = 0.01
LEAST_ANGLE_RAD: Final = 0.1
# A bus may have spoilt so many readings.
SPOILT: Final = 2
# Readings, so many of them, so far beyond a limit, rad, show that there is none.
PASSED_RAD: Final = 0.03
PASSED: Final = 10


class Limits(NamedTuple):
    """Holds where the servos of a leg stop, -inf and inf where they do not."""

    lower: Array  # (J,) rad
    upper: Array  # (J,) rad

    @classmethod
    def none(cls, joints: int) -> Limits:
        """Return those of joints that stop nowhere."""
        return cls(np.full(joints, -np.inf), np.full(joints, np.inf))

    @classmethod
    def from_leg(cls, leg: Leg) -> Limits:
        """Return what is described of a leg."""
        if leg.limits is None:
            return cls.none(len(leg.joints))
        return cls(np.array(leg.limits.lower_rad), np.array(leg.limits.upper_rad))

    @classmethod
    def saved(cls, saved: object, joints: int) -> Limits | None:
        """Return what was saved as lists, None where that is not usable."""
        try:
            lower, upper = np.array(saved, dtype=np.float64).reshape(2, joints)
        except (TypeError, ValueError):
            return None
        return cls(lower, upper) if (lower < upper).all() else None

    def clip(self, desired: Array) -> Array:
        """Return what servos follow of (n, J) rad."""
        return np.clip(desired, *self)

    def reached(self, joints: Sequence[str], desired: Array) -> str:
        """Name the limits that commands, (n, J) rad, are at or beyond; empty where there are none.

        Args:
            joints: names.
            desired: (n, J) rad.
        """
        ends = [
            f"{name} stops at {at:.3f} rad"
            for name, u, low, high in zip(joints, desired.T, *self, strict=True)
            for at, beyond in ((low, -np.inf < low >= u.min()), (high, u.max() >= high < np.inf))
            if beyond
        ]
        return ", ".join(ends)


# What is said, with what :meth:`Limits.reached` names.
SAID: Final = (
    "goals go beyond what the servos do ({ends}), and count as ending there: send none beyond, and "
    "write limits into robot.toml"
)


def find_limits(
    chain: Chain | None, described: Limits, known: Limits, step_rad: float, measured: Array,
    desired: Array,
) -> Limits:  # fmt: skip
    """Find the limits that samples in a row show.

    Args:
        chain: the leg's geometry, where it is known.
        described: limits that hold as soon as one stop is seen.
        known: limits that were known, by which commands may be clipped already.
        step_rad: of the encoder.
        measured: (n, J) rad.
        desired: (n, J) rad.

    Returns:
        ``known`` where nothing is new.
    """
    stop_rad = max(STOP_RAD, STOP_STEPS * step_rad)
    found = Limits(known.lower.copy(), known.upper.copy())
    reads, asked = measured.T.copy(), desired.T.copy()  # numpy is ten times as fast along rows
    for j, (y, u) in enumerate(zip(reads, asked, strict=True)):
        for side, said, of in (
            (-1.0, described.lower, found.lower),
            (1.0, described.upper, found.upper),
        ):
            top, most = (-y.min(), -u.min()) if side < 0.0 else (y.max(), u.max())
            at, limit = side * of[j], side * said[j]
            # Most joints go to no limit, and this is asked at every swing.
            if most - top < LEAST_SPREAD_RAD and most <= limit + stop_rad and at == np.inf:
                continue
            if np.sum(side * y > at + max(PASSED_RAD, stop_rad)) >= PASSED:
                at = np.inf
            elif _settled(side * u, limit + stop_rad).any() and (
                np.sum(side * y > limit + stop_rad) <= SPOILT
            ):  # it has come to a described limit and not beyond, though it should have
                at = min(at, limit)
            at = min(at, _stop(chain, j, side * y, side * u, stop_rad, measured))
            of[j] = side * at
    return known if all(map(np.array_equal, found, known)) else found


def _settled(u: Array, beyond: float) -> Mask:
    """Whether commands have been beyond for so long that a servo has come to its stop."""
    return np.asarray(np.convolve(u > beyond, np.ones(SETTLED))[: len(u)] == SETTLED)


def _stop(
    chain: Chain | None, joint: int, y: Array, u: Array, stop_rad: float, measured: Array
) -> float:
    """Find where a joint stops however far its command goes, inf where it does not."""
    if len(y) < LEAST_TICKS or u.max() - y.max() < LEAST_SPREAD_RAD:
        return np.inf
    top = np.sort(y)[-1 - SPOILT]
    settled = _settled(u, top + stop_rad)
    times = int(np.count_nonzero(np.diff(settled.astype(np.int8)) == 1))
    near = y > top - 2.0 * stop_rad
    if (
        settled.sum() < LEAST_TICKS
        or times < LEAST_TIMES
        or near[settled].mean() < STOPPED_SHARE
        or np.ptp(np.quantile(u[settled], (0.05, 0.95))) < LEAST_SPREAD_RAD
        or near.mean() > MOST_SHARE
        or np.ptp(y) < LEAST_TRAVEL_RAD
    ):
        return np.inf
    stopped = measured[settled & near]
    if chain is not None:
        apart = np.ptp(np.quantile(chain.foot(stopped)[:, 2], (0.1, 0.9))) / chain.size
        differ = apart > LEAST_HEIGHT_M
    else:
        others = np.delete(stopped, joint, axis=1)
        differ = np.ptp(others, axis=0).max(initial=0.0) > LEAST_ANGLE_RAD
    return float(np.median(y[settled & near])) if differ else np.inf
