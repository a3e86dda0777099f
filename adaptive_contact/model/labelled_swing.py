"""Defines the parts of a swing, with labels, that detection passes to the learning.

Detection makes them, the learning learns from them.  The value that passes the other way is
:class:`~adaptive_contact.model.free_motion.FreeMotion`.
"""

from __future__ import annotations

import enum
import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Ints, Mask

# 120 segments are the lifts and descents of 60 swings: about a minute of walking.
SEGMENTS: Final = 120


# What is known of one tick of a swing; the tick holds these back until the swing is resolved.
ROW: Final = np.dtype(
    [
        ("nis", np.float64),  # normalised innovation squared, over J: 1 for a good model
        ("value", np.float64),  # statistic of this tick alone, by which it was judged
        ("ratio", np.float64),  # test ratio, the largest over the windows
        ("sigma", np.float64),  # part along a push from the ground, in deviations; below 0: lower
        ("t_ns", np.int64),
        ("context", np.int32),  # by which its covariance was chosen
        ("lift", np.bool_),  # the foot was rising
        ("was_free", np.bool_),  # the leg had been found free before
        ("cleared", np.bool_),  # the foot had left the ground before, by its height
        ("high", np.bool_),  # the foot was above half of its rise
        ("after", np.bool_),  # after the turn to stance
        ("push", np.bool_),  # `sigma` and what was moved aside from it are set
        ("repeats", np.bool_),  # a reading repeated itself where the model expected motion
    ],
    align=True,
)


class Rows:
    """Holds n ticks of a swing, in order, to learn from.

    Args:
        values: (n, p + 2 J), side by side: :attr:`theta`, :attr:`target` and :attr:`aside`.
        records: (n,) of :data:`ROW`, what was known of them.
        joints: J.
    """

    __slots__ = ("joints", "records", "values")

    def __init__(self, values: Array, records: NDArray[np.void], joints: int) -> None:
        self.values, self.records, self.joints = values, records, joints

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, which: slice | Mask) -> Rows:
        return Rows(self.values[which], self.records[which], self.joints)

    def then(self, later: Rows) -> Rows:
        """Return these rows, followed by later ones."""
        if not (self and later):
            return self or later
        values, records = (self.values, later.values), (self.records, later.records)
        return Rows(np.concatenate(values), np.concatenate(records), self.joints)

    def residual(self, coefficients: Array) -> Array:
        """Compute the (n, J) residuals, rad, under (p, J) coefficients."""
        return np.asarray(self.target - self.theta @ coefficients)

    @property
    def theta(self) -> Array:
        """Return the regressors that predicted the rows, (n, p)."""
        return self.values[:, : self._terms]

    @property
    def target(self) -> Array:
        """Return the movements that were measured, (n, J) rad."""
        return self.values[:, self._terms : self._terms + self.joints]

    @property
    def aside(self) -> Array:
        """Return the movements, (n, J) rad, without what a push from the ground can have made.

        Where the leg has changed, its geometry is known and the foot does not rise.
        """
        return self.values[:, self._terms + self.joints :]

    @property
    def lifting(self) -> bool:
        """Return whether the foot was rising in the first row."""
        return bool(self.records[0]["lift"])

    @property
    def _terms(self) -> int:
        return int(self.values.shape[1]) - 2 * self.joints

    @property
    def t_ns(self) -> Ints:
        """Return the times of the rows, (n,) ns."""
        return np.asarray(self.records["t_ns"])

    @property
    def nis(self) -> Array:
        """Return the normalised innovations squared, (n,)."""
        return np.asarray(self.records["nis"])


NO_ROWS: Final = Rows(np.zeros((0, 0)), np.zeros(0, ROW), 0)


class Label(enum.Enum):
    """Names what a part of a swing is."""

    BEGIN = enum.auto()  # a swing begins
    TICK = enum.auto()  # a tick that may be learned was judged
    TRAVEL = enum.auto()  # the top of the lift was passed: has the foot followed its command?
    LIFT = enum.auto()  # rows of a lift, all free
    DESCENT = enum.auto()  # rows of a descent that are confirmed to be free
    END = enum.auto()  # the swing is resolved


class LabelledSwing(NamedTuple):
    """Holds a part of a swing and its label."""

    label: Label  # what; says which of the others are given
    rows: Rows = NO_ROWS  # of a lift or of a descent
    region: int = 0  # of the workspace, 0 to 5
    t_ns: int = 0  # of the newest tick
    nis: float = math.nan  # of a tick, per joint and in units of the baseline's variance
    way_rad: float = math.nan  # in which its joints were predicted to move, all together
    obstructed: bool = False  # the foot did not follow its command
    travel_ratio: float = 1.0  # share of its command's way that the foot went
    # the swing's contact was reported before the foot had begun to come down; None where that is
    # not known
    early: bool | None = None
    # the last swing's contact: the stance after it showed no load; at its end, where it was early:
    # the foot came down all the same
    refuted: bool = False
    whole: bool = True  # rows of a lift are most of it
