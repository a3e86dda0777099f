"""Computes the statistic of a tick: its residuals against their variance, compiled."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled
from adaptive_contact.detect.layout import DEPTH
from adaptive_contact.model.noise import SPEED_EDGES_QUANTA

# A coefficient that is off puts ticks in a row off alike: the variance of sums of w grows towards
# w² times one's, not w times.  By so much more its share counts in windows of 1, 2 and 3 ticks of a
# leg known from a prior; in full (1.1 and 2.3 times) it delays the first contact by two swings.
ADDS_UP: Final = (0.0, 0.25, 0.5)
SPEEDS: Final = len(SPEED_EDGES_QUANTA) + 1


@compiled
def context_of(leg, command, before):
    """Compute the context of a tick, from its command and the one before."""
    speed = 0.0
    for j in range(len(command)):
        speed = max(speed, abs(command[j] - before[j]))
    speed /= leg.quantum
    at = SPEEDS if leg.descent else 0
    for edge in SPEED_EDGES_QUANTA:
        if speed >= edge:
            at += 1
    return at


@compiled
def model_doubt(theta, index, per_scale, root, size, joint):
    """Compute a prediction's variance that comes from its coefficients, over the noise's."""
    total = 0.0
    for c in range(size):
        v = 0.0
        for k in range(size):
            v += theta[index[joint, k]] * per_scale[joint, k] * root[joint, k, c]
        total += v * v
    return total


@compiled
def leverage(theta, reach):
    """Compute the leverage of regressors: how far they lie outside of what the fit has seen."""
    total = 0.0
    for r in range(reach.shape[0]):
        z = 0.0
        for c in range(reach.shape[1]):
            z += reach[r, c] * theta[c]
        total += z * z
    return total


@compiled
def statistic(
    leg, history, whiten, unit, shrink, limits, awaited, scores, sums, gradient, against
):  # fmt: skip
    """Fill the (windows,) test ratios, NaN where a window reaches too far back.

    A foot about to stand has arrived, and what it is predicted to do says nothing of where the
    ground is: ``against`` the ground, a residual must be one of a push up, by the (J,) gradient of
    the foot's height.  A window that lies after the turn to stance has the thresholds ``awaited``:
    one that reaches back into the swing would apply them to motion judged before.  The first
    residual after the turn is of the swing, too: it is of the way to that sample.

    ``unit`` are the (J,) variances of this tick over the baseline's, ``shrink`` their reciprocal
    roots.

    Returns:
        The squared distance of the last residual from zero, whitened.
    """
    joints = history.shape[2]
    distance = 0.0
    for j in range(joints):
        sums[0, j] = sums[1, j] = 0.0
    for width in range(DEPTH):
        if leg.adds_up and width > 0:
            for j in range(joints):
                more = ADDS_UP[width] * max(unit[j] - leg.variance_scale * leg.inflation, 0.0)
                shrink[j] = 1.0 / math.sqrt(unit[j] + more)
        for j in range(joints):
            sums[0, j] += history[0, width, j]
            sums[1, j] += history[1, width, j]
        square = product = 0.0
        for r in range(joints):
            of_residual = of_increment = 0.0
            for c in range(joints):
                w = whiten[leg.context, width, r, c] * shrink[c]
                of_residual += w * sums[0, c]
                of_increment += w * (-gradient[c] if against else sums[1, c])
            square += of_residual * of_residual
            product += of_residual * of_increment
        if width == 0:
            distance = square
        if width + 1 > leg.usable:
            scores[width] = np.nan
        else:
            limit = awaited[width] if width + 1 < leg.after else limits[width]
            scores[width] = square / limit if product < 0.0 else 0.0
    return distance


@compiled
def onset(leg, history, width):
    """Estimate when a contact began, from the window that shows it; ns."""
    first = width - 1
    power = along = 0.0
    for j in range(history.shape[2]):
        power += history[1, first, j] ** 2
        along += history[0, first, j] * history[1, first, j]
    share = min(max(-along / power, 0.0), 1.0) if power > 0.0 else 1.0
    return leg.at_ns - first * leg.period_ns - np.int64(np.rint(share * leg.period_ns))
