"""Keeps the recent past of one leg, compiled: repaired readings, windows, residuals.

A reading that is missing, or that no leg could have made, is replaced by its prediction.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled, stage
from adaptive_contact.core.detect.layout import DEPTH, VALUES, copy_vector
from adaptive_contact.core.detect.regressors import predict, regressors

# No position servo of this class turns faster (AX-12A: 6.2 rad/s): a reading further from the one
# before is a fault of the bus, such as the -π that some return for "no answer".
MAX_STEP_RAD_S: Final = 25.0
# A joint that repeats its last reading to the step, while the model expects it to move by this
# many, is more likely stale than stopped dead: it waits a tick, while the other joints are judged;
# and one more while these move as predicted, to within so many steps: ground that stops one joint
# dead does not leave the others alone.  Where the leverage h of the motion is above 1, the model
# errs by √h times its noise, and the limit is as many times higher (decision 43).  A reading
# between the two limits is judged as it is, and not learned: a foot that is held stands, too.
STALE_QUANTA: Final = 3.0
FREE_QUANTA: Final = 2.0
# What a joint can do in a tick is learned from it: a reading off its prediction by more than this
# many times the largest movement ever seen or predicted, and so many steps, is bad.  Ground
# that stops a joint dead leaves the prediction by one such movement at most.
REACH: Final = 1.25
REACH_QUANTA: Final = 4.0
# Ticks predicted until the largest is known; about ten swings.
REACH_TICKS: Final = 200
# A value that was refused twice to the last bit is what a failed read leaves behind: where it is
# off the prediction by this many steps, it is suspect for one tick.
KNOWN_QUANTA: Final = 3.0
# So many impossible readings in a row are accepted (a horn slipped, an offset was set).
MAX_IMPOSSIBLE: Final = 3
# A reading earlier than this, in periods, is moved by no more: its noise would grow with it.
MOST_EARLY: Final = -0.5
# Ticks after a substitute in which the prediction leans on it most (velocity terms), and the
# factor on the residual's variance there: a substitute errs by a whole residual, a reading by two
# thirds of one.
UNSURE_TICKS: Final = 2
UNSURE_VARIANCE: Final = 2.5

# Rows of scratch: of `room`, (J,) rad each, and of `some`, (J,) each.
STEPS, JUMPS, LIMITS, RECENT, OFFS, BEFORE, NOW, ORIGIN = range(8)
BAD, IMPOSSIBLE, FOUND, REPEATED, MISSING, UNUSED = range(6)


@compiled
def leverage(theta, domain):
    """Compute the leverage of (p,) regressors by the (p, p) matrix of a training domain.

    How far they lie outside of what the fit has seen, as
    :meth:`~adaptive_contact.model.training_domain.Domain.leverage` has it.
    """
    total = 0.0
    for r in range(domain.shape[0]):
        z = 0.0
        for c in range(domain.shape[1]):
            z += domain[r, c] * theta[c]
        total += z * z
    return total


@compiled
def restart_history(leg, suspects):
    """Clear the past: the next sample does not connect to it."""
    leg.filled = 0
    leg.predicted = False
    leg.usable = 0
    leg.impossible = 0
    leg.unsure = 0
    suspects[:] = False


@compiled
def predict_next(leg, past, model):
    """Predict the next movement, unless that is done or needs a preview; True if predicted."""
    if not leg.predicted and leg.filled >= leg.length and model.depths[1] == 0:
        regressors(
            past.window, model.kind, model.first, model.entry, model.weight, model.knee, model.law,
            model.xi0, past.theta, model.forms,
        )  # fmt: skip
        leg.predicted = predict(past.theta, model.coefficients, past.increment)
    return leg.predicted


@compiled
def remember_refused(leg, past, measured, refused):
    """Count refused readings and keep their values; the one least often refused goes first."""
    values, counts = past.values, past.counts
    joints = len(measured)
    for j in range(joints):
        if not refused[j]:
            continue
        leg.refused_n += 1
        value = measured[j]
        again = False
        for i in range(j):
            if refused[i] and measured[i] == value:
                again = True
        if again:  # once for all joints that read it
            continue
        n = leg.values_n
        count = 0
        for k in range(n):
            if values[k] == value:
                count = counts[k]
                for m in range(k, n - 1):
                    values[m], counts[m] = values[m + 1], counts[m + 1]
                n -= 1
                break
        values[n], counts[n] = value, count + 1
        n += 1
        if n > VALUES:
            least = 0
            for k in range(1, n):
                if min(counts[k], 2) < min(counts[least], 2):
                    least = k
            for m in range(least, n - 1):
                values[m], counts[m] = values[m + 1], counts[m + 1]
            n -= 1
        leg.values_n = n


@stage
def beyond_reach(leg, past, model, measured, last, valid, has_valid, has_impossible):
    """Find joints that read what they cannot have reached since the last reading.

    ``measured`` and ``last`` are (J,) rad, this reading and the one before; ``valid`` says, if
    ``has_valid``, which joints have one.  Where ``has_impossible``, ``some[IMPOSSIBLE]`` holds
    joints that were found to read what is impossible.

    Returns:
        0 where there are none, 1 where ``some[FOUND]`` holds them, 2 where a joint reads so twice.
    """
    window, increment, reach, history = past.window, past.increment, past.reach, past.history
    suspects, values, counts, last_good = past.suspects, past.values, past.counts, past.last_good
    some, room = past.some, past.room
    impossible, found, repeats = some[IMPOSSIBLE], some[FOUND], some[REPEATED]
    jumps, limits, recent, offs = room[JUMPS], room[LIMITS], room[RECENT], room[OFFS]
    lags = model.depths[0]
    joints = len(measured)
    some_repeat = some_refused = suspect = False
    learned = leg.reach_ticks >= REACH_TICKS
    for j in range(joints):
        found[j] = suspects[j]  # of the reading before
        suspects[j] = False
    if leg.predicted:
        leg.reach_ticks += 1
        learned = leg.reach_ticks >= REACH_TICKS
    allowance = REACH_QUANTA * leg.quantum
    # A gap was bridged by predictions; what stopped the joint in it, they do not know.
    ticks = 1 + max(leg.missed, 0)
    known_step = KNOWN_QUANTA * leg.quantum
    for j in range(joints):
        moved = 0.0
        for lag in range(lags - 1):
            moved = max(moved, abs(window[(lag + 1) * joints + j] - window[lag * joints + j]))
        recent[j] = moved
        if leg.predicted:
            largest = max(abs(increment[j]), moved)
            if largest > reach[j]:
                reach[j] = min(largest, leg.max_step)
        limits[j] = min(REACH * reach[j] * ticks + allowance, leg.max_step)
        repeats[j] = False
        for k in range(leg.values_n):
            if values[k] == measured[j]:
                repeats[j] = counts[k] > 1
        some_repeat |= repeats[j]
        jumps[j] = abs(measured[j] - last_good[j])
    if not leg.predicted:
        for j in range(joints):
            if learned and jumps[j] > limits[j]:
                suspect = True
        if not suspect and not some_repeat:
            return 0
        if not predict_next(leg, past, model):
            return 2 if suspect else 0
        for j in range(joints):
            recent[j] = limits[j]
    else:
        for j in range(joints):
            most = max(abs(increment[j]), recent[j])
            for lag in range(DEPTH):
                most = max(most, abs(history[1, lag, j]))
            recent[j] = REACH * most * ticks + allowance
    agreed = False
    for j in range(joints):
        offs[j] = min(abs(measured[j] - window[j] - increment[j]), jumps[j])
        beyond = learned and offs[j] > limits[j]
        once = offs[j] > recent[j] or (repeats[j] and offs[j] > known_step)
        before = found[j]
        suspected = beyond or (once and not before)
        if has_valid and not valid[j]:
            suspected = beyond = False
        if beyond and before and not repeats[j] and abs(measured[j] - last[j]) <= limits[j]:
            agreed = True
        found[j] = suspected
        some_refused |= suspected or (has_impossible and impossible[j])
    if not some_refused:
        return 0
    if agreed:
        for j in range(joints):
            found[j] = False
        return 2
    for j in range(joints):  # `limits` is free now: 1 for a value that is refused for a joint
        limits[j] = 0.0
        for i in range(joints):
            if (found[i] or (has_impossible and impossible[i])) and measured[i] == measured[j]:
                limits[j] = 1.0
    for j in range(joints):
        if limits[j] > 0.0 and offs[j] > known_step and (not has_valid or valid[j]):
            found[j] = True
    remember_refused(leg, past, measured, found)
    for j in range(joints):
        suspects[j] = found[j]
    return 1


@compiled
def repair(leg, past, model, measured, valid, has_valid):
    """Fill the reading that enters the window, with substitutes for what is bad.

    A good one is moved from its stamp to its tick.  After ``MAX_IMPOSSIBLE``
    outliers in a row the new value is accepted and the history reset.

    ``measured`` is (J,) rad, as it was read; ``valid`` says, if ``has_valid``, which joints have a
    reading.  What is filled is ``past.reading``.
    """
    window, increment, reading, last = past.window, past.increment, past.reading, past.last
    last_good, stale, refused = past.last_good, past.stale, past.refused
    some, room = past.some, past.room
    bad, impossible, found, missing = some[BAD], some[IMPOSSIBLE], some[FOUND], some[MISSING]
    steps, jumps, before = room[STEPS], room[JUMPS], room[BEFORE]
    joints = len(measured)
    substituted = leg.bad
    leg.sound, leg.bad, leg.repeats = True, False, False
    seen = leg.seen
    leg.seen = True
    for j in range(joints):
        before[j] = last[j]
        last[j] = measured[j]
    if leg.filled == 0 or not seen:
        for j in range(joints):
            last_good[j] = reading[j] = measured[j]
        return
    # A literal would have `beyond_reach` compiled once more.
    some_missing = some_bad = has_impossible = np.bool_(False)
    largest = 0.0
    still = False
    for j in range(joints):
        steps[j] = abs(measured[j] - before[j])
        jump = abs(measured[j] - window[j]) if substituted else steps[j]
        missing[j] = has_valid and not valid[j]
        some_missing |= missing[j]
        if missing[j]:
            jump = 0.0
        jumps[j] = jump
        largest = max(largest, jump)
        bad[j] = impossible[j] = False
        if steps[j] == 0.0:
            still = True
    if largest > leg.max_step:
        leg.impossible += 1
        if leg.impossible > MAX_IMPOSSIBLE:
            restart_history(leg, past.suspects)
            for j in range(joints):
                last_good[j] = reading[j] = measured[j]
            return
        has_impossible = some_bad = True
        for j in range(joints):
            bad[j] = impossible[j] = refused[j] = jumps[j] > leg.max_step
    elif leg.impossible:
        again = False
        for j in range(joints):
            again |= missing[j] and refused[j]
        if not again:
            leg.impossible = 0
    said = beyond_reach(leg, past, model, measured, before, valid, some_missing, has_impossible)
    if said == 0 and has_impossible:
        remember_refused(leg, past, measured, impossible)
    elif said == 2:  # two in a row that agree
        restart_history(leg, past.suspects)
        for j in range(joints):
            last_good[j] = reading[j] = measured[j]
        return
    elif said == 1:
        some_bad = True
        for j in range(joints):
            bad[j] |= found[j]
    maybe_stale = False
    expected = STALE_QUANTA * leg.quantum
    if leg.predicted and still:
        for j in range(joints):
            if steps[j] == 0.0 and abs(increment[j]) > expected:
                maybe_stale = True
    if maybe_stale and leg.has_domain:
        expected *= math.sqrt(max(leverage(past.theta, model.domain), 1.0))
    if not maybe_stale:
        stale[:] = 0
    else:
        some_still, all_still, all_known = False, True, True
        for j in range(joints):
            repeats = steps[j] == 0.0 and not missing[j]
            found[j] = repeats and abs(increment[j]) > expected
            if repeats and not found[j]:
                leg.repeats |= abs(increment[j]) > STALE_QUANTA * leg.quantum
            some_still |= found[j]
            all_still &= found[j]
            free = abs(measured[j] - window[j] - increment[j]) < FREE_QUANTA * leg.quantum
            all_known &= free or found[j] or missing[j]
        if not some_still:
            stale[:] = 0
        else:
            most = 2 if all_known and not all_still else 1
            for j in range(joints):
                if found[j] and stale[j] < most:
                    stale[j] += 1
                    bad[j] = some_bad = True
                else:
                    stale[j] = 0
    for j in range(joints):
        if missing[j]:
            bad[j] = some_bad = True
    late = leg.lateness != 0.0
    scale = 1.0 / (1.0 + max(leg.lateness, MOST_EARLY))
    if some_bad:
        leg.bad, leg.sound = True, False
        for j in range(joints):
            if not bad[j]:
                leg.sound = True
        ahead = predict_next(leg, past, model)
    for j in range(joints):
        if some_bad and bad[j]:
            reading[j] = window[j] + increment[j] if ahead else window[j]
            continue
        last_good[j] = measured[j]
        reading[j] = window[j] + (measured[j] - window[j]) * scale if late else measured[j]


@compiled
def push_reading(reading, increment, window, history, lags):
    """Shift a reading into the window, and its residual and prediction into the history."""
    joints = len(reading)
    for lag in range(DEPTH - 1, 0, -1):
        for j in range(joints):
            history[0, lag, j] = history[0, lag - 1, j]
            history[1, lag, j] = history[1, lag - 1, j]
    for j in range(joints):
        history[1, 0, j] = increment[j]
        history[0, 0, j] = reading[j] - window[j] - increment[j]
    for at in range(lags * joints - 1, joints - 1, -1):
        window[at] = window[at - joints]
    for j in range(joints):
        window[j] = reading[j]


@compiled
def enter_residual(leg, theta, thetas):
    """Note what the residual of the reading just taken is judged by; return whether it can be.

    Shifts the regressors into the history; sets the variance of a reading near a substitute.
    """
    if leg.predicted:
        for lag in range(DEPTH - 1, 0, -1):
            copy_vector(thetas[lag - 1], thetas[lag])
        copy_vector(theta, thetas[0])
        leg.thetas_n = min(leg.thetas_n + 1, DEPTH)
    leg.reading_variance = 1.0
    if leg.bad:
        leg.unsure = UNSURE_TICKS
        leg.reading_variance = UNSURE_VARIANCE
    elif leg.unsure:
        leg.unsure -= 1
        leg.reading_variance = UNSURE_VARIANCE
    can = leg.predicted and leg.sound
    leg.usable = min(leg.usable + 1, DEPTH) if can else 0
    return can


@compiled
def push_command(leg, window, depths, desired):
    """Shift a command into the window; True if it is full."""
    lags, preview = depths[0], depths[1]
    joints = len(desired)
    first = lags * joints
    last = len(window) - preview * joints
    for at in range(last - 1, first + joints - 1, -1):
        window[at] = window[at - joints]
    for j in range(joints):
        window[first + j] = desired[j]
    if leg.filled < leg.length:
        leg.filled += 1
    return leg.filled >= leg.length
