"""The arrays of several legs, and the two halves of their tick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from adaptive_contact.detect.layout import (
    ASKED,
    DEPTH,
    HEIGHTS,
    LEG,
    LOW_TICKS,
    PATH_TICKS,
    RING,
    ROW,
    SWINGS,
    VALUES,
)
from adaptive_contact.detect.noise import CONTEXTS
from adaptive_contact.detect.regressors import term_table
from adaptive_contact.detect.tick import finish_tick, judge_tick
from adaptive_contact.identify import Library
from adaptive_contact.robot import Leg

__all__ = ["LegBatch"]

STATUS_TICKS: Final = 256


class LegBatch:
    """The arrays of L legs whose models share a library of J joints and p terms.

    Args:
        legs: L descriptions.
        library: of their models.
        quantum_rad: position step of each leg's servos.
        period_ns: control tick.
        capacity: rows of a swing held back at first; grows.
    """

    def __init__(
        self, legs: Sequence[Leg], library: Library, quantum_rad: Sequence[float], period_ns: int,
        *, max_step: float, capacity: int = 96,
    ) -> None:  # fmt: skip
        rows, joints = len(legs), len(library.joints)
        shape = library.window
        self.table = term_table(library)
        self.lags = shape.past_measured + 1
        self.preview = shape.preview
        depth = self.lags + shape.past_desired + 1 + shape.preview
        q, p, n = len(self.table.kind), library.size, library.size
        f, b, i = np.float64, np.bool_, np.int64

        def zeros(*shape: int, dtype: Any = f) -> Any:
            return np.zeros((rows, *shape), dtype=dtype)

        self.legs = legs_ = np.zeros(rows, dtype=LEG)
        # A tick's samples.
        self.accepted, self.restart = zeros(dtype=b), zeros(dtype=b)
        self.lost, self.t_ns, self.seq = zeros(dtype=i), zeros(dtype=i), zeros(dtype=i)
        self.phase = zeros(dtype=np.int8)
        self.measured, self.desired = zeros(joints), zeros(joints)
        self.valid, self.has_valid = zeros(joints, dtype=b), zeros(dtype=b)
        self.preview_in, self.preview_n = zeros(shape.preview, joints), zeros(dtype=i)
        # Stream and clock.
        self.ring = zeros(RING, 3, dtype=i)
        self.seam, self.command, self.before = zeros(joints), zeros(joints), zeros(joints)
        # Swing.
        self.lengths, self.pitched = zeros(joints), zeros(joints, dtype=b)
        self.low, self.lengths_ticks = zeros(LOW_TICKS), zeros(SWINGS, dtype=i)
        self.last_desired, self.last_measured = zeros(joints), zeros(joints)
        self.path, self.asked = zeros(PATH_TICKS, joints), zeros(ASKED)
        self.commanded, self.foot, self.start = zeros(3), zeros(3), zeros(3)
        self.heights = zeros(HEIGHTS)
        # History.
        self.window = zeros(depth * joints)
        self.history = zeros(2, DEPTH, joints)
        self.increment = zeros(joints)
        self.theta, self.thetas = zeros(p), zeros(DEPTH, p)
        self.began_window = zeros(depth * joints)
        self.reach, self.believed, self.last = zeros(joints), zeros(joints), zeros(joints)
        self.doubts = zeros(joints, dtype=b)
        self.stale, self.refused = zeros(joints, dtype=i), zeros(joints, dtype=b)
        self.values, self.counts = zeros(VALUES + 1), zeros(VALUES + 1, dtype=i)
        # What is known of free motion.
        self.xi0, self.coefficients = zeros(q, joints), zeros(p, joints)
        self.whiten = zeros(CONTEXTS, DEPTH, joints, joints)
        self.limits, self.sigma, self.unit = zeros(DEPTH), zeros(joints), zeros(joints)
        self.index = zeros(joints, n, dtype=i)
        self.per_scale, self.root = zeros(joints, n), zeros(joints, n, n)
        self.sizes = zeros(dtype=i)
        self.domain = zeros(p, p)
        # Labels.
        self.rows = np.zeros((rows, capacity), dtype=ROW)
        self.row_thetas, self.row_targets = zeros(capacity, p), zeros(capacity, joints)
        self.row_asides = zeros(capacity, joints)
        self.free_ring = zeros(STATUS_TICKS, joints)
        self.scores = zeros(DEPTH)
        # Scratch.
        self.bools = np.zeros((6, joints), dtype=b)
        self.floats, self.room = np.zeros((9, joints)), np.zeros(2 * joints)
        self.now, self.sums = np.zeros(3), np.zeros((2, joints))
        for row, leg in enumerate(legs):
            legs_[row]["quantum"] = quantum_rad[row]
            legs_[row]["max_step"] = max_step
            legs_[row]["length"] = shape.length
            legs_[row]["period_ns"] = period_ns
            legs_[row]["has_lengths"] = leg.lengths_m is not None
            if leg.lengths_m is not None:
                self.lengths[row] = leg.lengths_m
            self.pitched[row] = [axis == "pitch" for axis in leg.joint_axes]
        for name, value in {
            "late": -1, "told_by": 9, "found_ns": np.nan, "descent": True, "inflation": 1.0,
            "sound": True, "level": 1.0, "loaded": True, "hole_ns": -1, "surface": -np.inf,
            "touch_at": -np.inf, "touch_before": -np.inf, "top": -np.inf, "fallen": np.nan,
            "apex": -np.inf, "asked_n": 1,
        }.items():  # fmt: skip
            legs_[name] = value

    def judge(self) -> None:
        """The first half of a tick."""
        judge_tick(
            self.legs, self.accepted, self.restart, self.lost, self.t_ns, self.seq, self.phase,
            self.measured, self.desired, self.valid, self.has_valid, self.preview_in, self.ring,
            self.seam, self.command, self.before, self.lengths, self.pitched, self.low,
            self.lengths_ticks, self.last_desired, self.last_measured, self.path, self.asked,
            self.commanded, self.foot, self.start, self.heights, self.window, self.lags,
            self.preview, self.history, self.increment, self.theta, self.thetas, self.began_window,
            self.reach, self.believed, self.last, self.doubts, self.stale, self.refused,
            self.values, self.counts, *self.table, self.xi0, self.coefficients, self.whiten,
            self.limits, self.sigma, self.unit, self.index, self.per_scale, self.root, self.sizes,
            self.domain, self.rows, self.row_thetas, self.row_targets, self.row_asides,
            self.free_ring, self.scores, self.bools, self.floats, self.room, self.now, self.sums,
        )  # fmt: skip

    def finish(self) -> None:
        """The second half."""
        finish_tick(
            self.legs, self.accepted, self.desired, self.preview_in, self.preview_n, self.command,
            self.before, self.window, self.lags, self.preview, self.increment, self.theta,
            *self.table, self.xi0, self.coefficients, self.room,
        )  # fmt: skip
