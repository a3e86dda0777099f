"""Holds the rows of a swing back until it is resolved, compiled.

``swing_labels.py`` says what they were.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled
from adaptive_contact.detect.flags import BROKE_OFF, ENTERED
from adaptive_contact.detect.swing import height_gradient
from adaptive_contact.model.noise import UNFIT_LEVEL

# Without calm, the first tick of a lift taken for free: a foot pressed in the stance before has let
# go by the 7th tick of the command (measured in pose, 62 of 62 cases).
FREE_LIFT_TICKS: Final = 8
# A swing longer than this keeps its newest ticks; 400 is a slow descent of 8 s.
MAX_ROWS: Final = 400


@compiled
def begin_labels(leg):
    """Begin the rows of a swing: none is held back."""
    leg.hole_ns = -1
    leg.lift_n = leg.row_n = leg.commanded_n = 0
    leg.topped = leg.closed = leg.broken = leg.top_seen = False
    leg.fit_n = leg.fit_before = 0


@compiled
def note_fit(leg, level):
    """Count ticks in a row that fit the model; ``level`` is a tick's NIS."""
    if level <= UNFIT_LEVEL:
        leg.fit_n += 1
    elif leg.fit_n:
        leg.fit_before, leg.fit_n, leg.misfit_ns = leg.fit_n, 0, leg.at_ns


@compiled
def note_hole(leg, rows):
    """Note lost or bad readings: what went on meanwhile shows in no residual."""
    if leg.row_n > leg.lift_n:
        leg.hole_ns = rows[leg.row_n - 1].t_ns


@compiled
def break_off(leg):
    """Break off the swing: what comes does not connect, and it is not learned."""
    leg.found |= BROKE_OFF
    leg.whole = leg.stood = leg.touching = False
    begin_labels(leg)
    leg.broken = True


@compiled
def push_from_ground(leg, row, aside, residual, target, whiten, unit, gradient, z):
    """Split a residual into a push from the ground and the rest."""
    joints = len(residual)
    length = along = 0.0
    for r in range(joints):
        g = w = 0.0
        for c in range(joints):
            at = whiten[leg.context, 0, r, c] / math.sqrt(unit[c])
            g += at * gradient[c]
            w += at * residual[c]
        length += g * g
        along += g * w
    length = math.sqrt(length)
    row.push = True
    if length == 0.0:
        row.sigma = np.inf
        for j in range(joints):
            aside[j] = target[j]
        return
    row.sigma = along / length
    for j in range(joints):
        aside[j] = target[j] - gradient[j] * (row.sigma / length)


@compiled
def enter_row(
    leg, rows, thetas, targets, asides, theta, history, distance, value, free, past_top,
    whiten, unit, last_measured, links, turns, gradient, target,
):  # fmt: skip
    """Hold a judged tick back until its swing is resolved."""
    joints = history.shape[2]
    leg.found |= ENTERED
    if not leg.gated:
        pass
    elif leg.broken or not (leg.topped or leg.rising or past_top):
        return
    elif leg.rising and not leg.topped:
        if not (free or leg.ticks >= FREE_LIFT_TICKS):
            return
    elif leg.closed or (leg.adds_up and leg.after):
        leg.topped = True
        return
    at = leg.row_n if leg.gated else 0  # ungated, each is learned at once
    first, most = (
        (0, leg.lift_n) if leg.rising and not leg.topped else (leg.lift_n, at - leg.lift_n)
    )
    if most >= MAX_ROWS:  # the oldest goes
        for k in range(first, at - 1):
            rows[k], thetas[k], targets[k], asides[k] = (
                rows[k + 1], thetas[k + 1], targets[k + 1], asides[k + 1],
            )  # fmt: skip
        at -= 1
        if first == 0:
            leg.lift_n -= 1
            leg.commanded_n = max(leg.commanded_n - 1, 0)
    row = rows[at]
    row.nis = distance * leg.variance_scale / joints
    row.value = value
    row.context = leg.context
    row.t_ns = leg.at_ns
    row.calm, row.cleared, row.push = free, leg.cleared, False
    for j in range(joints):
        target[j] = history[0, 0, j] + history[1, 0, j]
        targets[at, j] = target[j]
    thetas[at] = theta
    if leg.changed and not leg.rising and leg.has_lengths and leg.has_measured:
        height_gradient(last_measured, links, turns, gradient)
        push_from_ground(
            leg, row, asides[at], history[0, 0], target, whiten, unit, gradient, target
        )
    if not leg.gated:
        row.lift = leg.rising
        return
    leg.row_n = at + 1
    if leg.rising and not leg.topped:
        row.lift = True
        leg.lift_n = at + 1
        if not past_top:
            leg.commanded_n = leg.lift_n
        return
    leg.topped = True
    row.lift = False
