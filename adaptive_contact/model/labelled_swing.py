"""Defines the parts of a swing, with labels, that detection passes to the learning.

Detection makes them, the learning learns from them.  The value that passes the other way is
:class:`~adaptive_contact.model.free_motion.FreeMotion`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.model.noise import WINDOWS

__all__ = ["SEGMENTS", "Label", "LabelledSwing", "Push", "Row", "Touch", "residuals_of"]

Array = NDArray[np.float64]

# 120 segments are the lifts and descents of 60 swings: about a minute of walking.
SEGMENTS: Final = 120


class Push(NamedTuple):
    """Holds the part of a residual that a push from the ground can have made.

    Attributes:
        sigma: how far it lies that way, in its own standard deviations; negative for a foot below
            where it was predicted.
        aside: (J,) rad, the movement measured, without that part.
    """

    sigma: float
    aside: Array


class Row(NamedTuple):
    """Holds one tick to learn from: regressors, target, NIS and what was known of it.

    Attributes:
        theta: (p,) regressors that predicted it.
        target: (J,) rad, the movement that was measured.
        nis: normalised innovation squared, over J: 1 on average for a good model.
        value: the statistic of this tick alone, by which it was judged.
        context: by which its covariance was chosen.
        t_ns: of the tick.
        lift: the foot was rising.
        calm: the leg had been found free before.
        cleared: the foot had left the ground before, by its height; only then it is learned.
        push: what it shows of a push from the ground, where the leg has changed, its geometry is
            known and the foot does not rise; None elsewhere.
    """

    theta: Array
    target: Array
    nis: float
    value: float
    context: int
    t_ns: int
    lift: bool
    calm: bool
    cleared: bool
    push: Push | None = None


def residuals_of(rows: Sequence[Row], coefficients: Array) -> tuple[Array, Array]:
    """Compute regressors (n, p) and residuals (n, J) rad of rows under (p, J) coefficients."""
    theta = np.array([row.theta for row in rows])
    return theta, np.array([row.target for row in rows]) - theta @ coefficients


class Touch(NamedTuple):
    """Holds a tick in contact with the two before it, and how they were judged.

    Attributes:
        theta: (3, p) regressors, lag 0 first; zero before the first usable one.
        target: (3, J) rad, movements that were measured.
        whiten: (windows, J, J).
        limits: (windows,) thresholds.
        usable: how many of the ticks count.
    """

    theta: Array
    target: Array
    whiten: Array
    limits: Array
    usable: int

    @classmethod
    def of(
        cls, thetas: Sequence[Array], target: Array, whiten: Array, limits: Array, usable: int
    ) -> Touch:
        """Make one from the regressors of the last ticks, newest first; some may be missing."""
        theta = np.zeros((max(WINDOWS), len(thetas[0])))
        known = min(usable, len(thetas))
        theta[:known] = thetas[:known]
        return cls(theta, target, whiten, limits, known)


class Label(enum.Enum):
    """Names what a part of a swing is."""

    BEGIN = enum.auto()  # a swing begins
    TICK = enum.auto()  # a tick that may be learned was judged
    TRAVEL = enum.auto()  # the top of the lift was passed: has the foot followed its command?
    LIFT = enum.auto()  # rows of a lift, all free
    DESCENT = enum.auto()  # rows of a descent that are confirmed to be free
    UNGATED = enum.auto()  # a row that is learned whatever it is of
    CONTACT = enum.auto()  # the first ticks of a contact that was reported
    END = enum.auto()  # the swing is resolved


class LabelledSwing(NamedTuple):
    """Holds a part of a swing and its label.

    Attributes:
        label: what; says which of the others are given.
        rows: of a lift, of a descent, or ungated.
        region: of the workspace, 0 to 5.
        t_ns: of the newest tick.
        touch: ticks of a contact.
        nis: of a tick, per joint and in units of the baseline's variance.
        obstructed: the foot did not follow its command.
        travel_ratio: share of its command's way that the foot went.
        early: the swing's contact was reported before the foot had begun to come down; None where
            that is not known.
    """

    label: Label
    rows: Sequence[Row] = ()
    region: int = 0
    t_ns: int = 0
    touch: Sequence[Touch] = ()
    nis: float = math.nan
    obstructed: bool = False
    travel_ratio: float = 1.0
    early: bool | None = None
