"""Lays out the state of several legs' ticks: one row of every array is one leg.

Scalars stand in one structured array, so that compiled code names them; what has as many entries
as a leg has joints, or as its library has terms, is an array of its own.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["DEPTH", "LEG", "ROW", "new_legs"]

DEPTH: Final = 3  # ticks of the longest window of the statistic
HEIGHTS: Final = 12  # of the foot, remembered
LOW_TICKS: Final = 10  # of the commanded foot, whose low a swing rises from
ASKED: Final = 4  # ways commanded, remembered
SWINGS: Final = 5  # lengths of swings, remembered
PATH_TICKS: Final = 400  # commands of a swing, remembered
RING: Final = 101  # ticks by which the rate is judged, at most
VALUES: Final = 8  # refused readings remembered

f8, i8, i4, b1 = np.float64, np.int64, np.int32, np.bool_

# The scalars of one leg, in the order in which a tick uses them.
LEG: Final = np.dtype(
    [
        # Description.
        ("has_lengths", b1),
        ("quantum", f8),  # rad
        ("max_step", f8),  # rad per tick
        ("length", i4),  # samples in a row before a prediction
        ("period_ns", i8),
        ("known", b1),  # a model is in force
        ("gated", b1),  # learns only what is confirmed
        ("learning", b1),
        # Stream and clock.
        ("at_ns", i8),
        ("lateness", f8),
        ("stretch", f8),
        ("late", i4),  # -1 unknown, 0 on time, 1 late
        ("rate_off", b1),
        ("seq", i8),
        ("t_ns", i8),
        ("due_ns", i8),
        ("found_ns", f8),  # NaN while unknown
        ("told_by", i4),
        ("ring_n", i8),
        ("lacking", i4),  # samples for which the lack of a preview is still told
        ("missed", i8),  # ticks since the last sample; -1 after a pause
        ("accepted_n", i8),
        ("total_n", i8),  # samples, never reset
        ("jitter_mean", f8),
        ("jitter_square", f8),
        ("spread", f8),
        ("votes", f8),
        ("shown", f8),
        ("misread", b1),
        # Swing: the command.
        ("ticks", i4),
        ("after", i4),  # of these after the turn to stance, while a touch is awaited
        ("same", i4),  # samples in a row that repeat the one before
        ("swing_phase", b1),  # as inferred
        ("told", b1),
        ("untold", i4),
        ("whole", b1),
        ("stood", b1),
        ("heights_n", i4),
        ("low_n", i4),
        ("low_at", i4),
        ("apex", f8),
        ("still", i4),
        ("has_desired", b1),
        ("has_measured", b1),
        ("commanded_up", b1),
        ("descent", b1),  # direction of the command in force
        ("asked_n", i4),
        ("lengths_n", i4),
        ("path_n", i4),
        ("path_first", i8),
        ("path_last", i8),
        # Swing: the foot.
        ("rising", b1),
        ("cleared", b1),
        ("obstructed", b1),
        ("rise", f8),
        ("moved", f8),
        ("surface", f8),
        ("touch_at", f8),
        ("touch_before", f8),
        ("top", f8),
        ("low_at_m", f8),
        ("fallen", f8),
        # History.
        ("filled", i4),
        ("predicted", b1),
        ("inflation", f8),
        ("usable", i4),
        ("sound", b1),
        ("bad", b1),
        ("seen", b1),  # a raw reading before
        ("impossible", i4),
        ("unsure", i4),
        ("refused", i8),
        ("reach_ticks", i8),
        ("values_n", i4),
        ("thetas_n", i4),
        # Statistic.
        ("context", i4),
        ("variance_scale", f8),  # in force
        ("__", f8),
        ("inflated", b1),  # the covariance is
        ("clock_most", f8),
        ("clock_left", i4),
        # Contact.
        ("contact", b1),
        ("loaded", b1),
        ("calm", i4),
        ("calm_since", i8),
        # Labels of the swing in hand.
        ("open", b1),
        ("lift_n", i4),  # rows of the lift
        ("commanded_n", i4),  # of these, those whose command went up
        ("row_n", i4),  # rows
        ("topped", b1),
        ("closed", b1),
        ("broken", b1),
        ("top_seen", b1),
        ("touching", b1),
        ("resolved_first", i4),
        ("resolved_last", i4),
        ("resolved_whole", b1),
        ("resolved_rise", f8),
        ("resolved_fallen", f8),
        # Swings without a touch.
        ("sure", b1),  # the leg is judged by a model that fits it
        ("quiet", i4),  # ticks in a row after the turn without a sign of a touch
        ("untouched", i8),
        ("untouched_ns", i8),  # -1 before the first
        # What the source sends.
        ("phase_part", i4),  # -1 unknown, 0 stance, 1 swing
        ("part_whole", b1),
        ("swapped", b1),
        ("slow_swings", i4),
        ("has_before", b1),
        ("echo_n", i4),  # commands known
        ("echoes", b1),
        ("suspected", b1),
        ("cause", i4),  # 0 none, 1 echo, 2 phase
        ("began_ns", i8),  # of the last swing but one
        ("began_n", i8),
        ("began_next_ns", i8),  # and of the last
        ("began_next_n", i8),
        ("began_count", i4),
        ("reported", b1),  # the contact by the last event
        ("withholds", b1),  # contacts are not reported
        ("withholds_begun", b1),  # nor those of a swing that has just begun
        ("began_full", b1),
        ("has_seam", b1),
        ("has_theta", b1),
        ("release_pending", b1),
        ("hole_ns", i8),  # -1 for none
        ("changed", b1),
        ("has_domain", b1),
        # What this tick found.
        ("found", i8),
        ("score", f8),
        ("onset_ns", i8),
        ("distance", f8),
        ("free_n", i8),
    ],
    align=True,
)

# One row of a swing in hand.
ROW: Final = np.dtype(
    [
        ("nis", f8),
        ("value", f8),
        ("sigma", f8),
        ("t_ns", i8),
        ("context", i4),
        ("lift", b1),
        ("calm", b1),
        ("cleared", b1),
        ("push", b1),
    ],
    align=True,
)


def new_legs(count: int) -> NDArray[np.void]:
    """Make the scalars of legs that have seen nothing."""
    legs = np.zeros(count, dtype=LEG)
    for name, value in _BEGINNING.items():
        legs[name] = value
    return legs


_BEGINNING: Final = {
    "late": -1, "told_by": 9, "found_ns": np.nan, "descent": True, "inflation": 1.0,
    "sound": True, "variance_scale": 1.0, "loaded": True, "hole_ns": -1, "surface": -np.inf,
    "touch_at": -np.inf, "touch_before": -np.inf, "top": -np.inf, "fallen": np.nan,
    "apex": -np.inf, "asked_n": 1, "low_at_m": np.inf, "untouched_ns": -1, "phase_part": -1,
    "resolved_fallen": np.nan, "began_count": 1,
}  # fmt: skip
