"""Computes one tick of several legs, compiled: from samples to events, and to predictions.

:func:`judge_tick` is the first half: all that an event needs, and nothing else.
:func:`finish_tick` is the second: commands, and the predictions of the next tick.  Between the two,
Python takes what the first half has flagged.
"""

from __future__ import annotations

import math

import numpy as np

from adaptive_contact.compiled import compiled
from adaptive_contact.detect.contact import (
    begin_labels,
    break_off,
    context_of,
    enter_row,
    keep_touch,
    let_go,
    model_uncertainty,
    note_contact,
    note_fit,
    note_hole,
    onset,
    statistic,
    swing_tick,
)
from adaptive_contact.detect.history import (
    UNSURE_TICKS,
    judged,
    leverage,
    predict_next,
    push_command,
    repair,
    restart_history,
    take,
)
from adaptive_contact.detect.layout import (
    BEGAN,
    DEPTH,
    RATE_OFF,
    RELEASE_PENDING,
    RESOLVED,
    RESTARTED,
    SLOT,
    TOPPED,
    TOUCHED,
    receive_finished,
    receive_judged,
)
from adaptive_contact.detect.regressors import predict, regressors
from adaptive_contact.detect.source import (
    NONE,
    PAUSE,
    begin_echo,
    follow_clock,
    follow_source,
    keep_sample,
    restart_clock,
    restart_phase,
    take_command,
    take_phase,
    vote_late,
)
from adaptive_contact.detect.swing import (
    QUIET_SCORE,
    RECENT_TICKS,
    UNKNOWN,
    descending,
    follow_command,
    follow_foot,
    forget_phase,
    height_gradient,
    place_foot,
)


@compiled
def vector(array, places, row, slot):
    """Return one leg's vector, of those of a kind."""
    return array[row, places[slot, 0] : places[slot, 1]]


@compiled
def unwrap(leg, measured, desired, preview, last, restart):
    """Take the encoder's seam out of a sample's angles, in place."""
    joints = len(measured)
    if leg.has_seam and not restart:
        near(desired, last)
    leg.has_seam = True
    for j in range(joints):
        last[j] = desired[j]
    near(measured, desired)
    for k in range(len(preview)):
        near(preview[k], desired if k == 0 else preview[k - 1])


@compiled
def near(angles, origin):
    """Move angles into the turn nearest to others, if one is further than half a turn off."""
    for j in range(len(angles)):
        if abs(angles[j] - origin[j]) > math.pi:
            for k in range(len(angles)):
                turns = np.rint((angles[k] - origin[k]) / (2.0 * math.pi))
                angles[k] -= 2.0 * math.pi * turns
            return


@compiled
def restart_leg(leg, command, before, desired, suspects):
    """Forget the past of a leg whose source has started again."""
    leg.found |= RESTARTED
    let_go(leg)
    leg.whole = leg.stood = False
    leg.ticks = leg.after = 0
    leg.obstructed = False
    leg.surface = leg.touch_at = leg.touch_before = -np.inf
    leg.heights_n = 0
    leg.has_desired = leg.has_measured = False
    forget_phase(leg)
    leg.open = False
    break_off(leg)
    for j in range(len(desired)):
        command[j] = before[j] = desired[j]
    restart_history(leg, suspects)


@compiled
def judge_tick(handed):
    """Judge a sample of every leg that has one: the first half of a tick, up to its events.

    Args:
        handed: arrays of a :class:`~adaptive_contact.detect.leg_batch.LegBatch`, a row per leg, by
            ``JUDGED`` of :mod:`adaptive_contact.detect.layout`.  ``legs`` are its scalars,
            ``floats``, ``ints`` and ``bools`` its vectors, ``kind`` to ``law`` a
            :class:`~adaptive_contact.detect.regressors.TermTable`.  The last four are scratch:
            ``some`` holds masks of joints, ``now`` a place of the foot, ``sums`` what a statistic
            or a prediction adds up, and ``room`` vectors.  Three of these pass between steps:
            ``room[6]`` the repaired reading, ``room[2]`` the reciprocal deviations of this tick,
            ``room[3]`` the gradient of the foot's height.

    Returns:
        The flags of all legs, in one.
    """
    (
        legs, floats, ints, bools, places, preview_in, ring, kept_angles, kept_stamps,
        echo_commands, echo_runs, parts, links, path, depths, history, thetas, kind, first, entry,
        weight, knee, law, xi0, coefficients, whiten, index, per_scale, root, domain, rows,
        row_values, free_ring, some, room, now, sums,
    ) = receive_judged(handed)  # fmt: skip
    lags, preview = depths[0], depths[1]
    joints = links.shape[1]
    table = (kind, first, entry, weight, knee, law)
    predicting = sums.reshape(2 * joints)
    for i in range(len(legs)):
        if not legs[i].accepted:
            continue
        leg = legs[i]
        leg.found = 0
        leg.unfinished = True
        measured = vector(floats, places, i, SLOT.measured)
        desired = vector(floats, places, i, SLOT.desired)
        seam = vector(floats, places, i, SLOT.seam)
        command = vector(floats, places, i, SLOT.command)
        before = vector(floats, places, i, SLOT.before)
        phase_before = vector(floats, places, i, SLOT.phase_before)
        low = vector(floats, places, i, SLOT.low)
        last_desired = vector(floats, places, i, SLOT.last_desired)
        last_measured = vector(floats, places, i, SLOT.last_measured)
        last_read = vector(floats, places, i, SLOT.last_read)
        asked = vector(floats, places, i, SLOT.asked)
        commanded = vector(floats, places, i, SLOT.commanded)
        foot = vector(floats, places, i, SLOT.foot)
        start = vector(floats, places, i, SLOT.start)
        heights = vector(floats, places, i, SLOT.heights)
        window = vector(floats, places, i, SLOT.window)
        began_window = vector(floats, places, i, SLOT.began_window)
        increment = vector(floats, places, i, SLOT.increment)
        theta = vector(floats, places, i, SLOT.theta)
        reach = vector(floats, places, i, SLOT.reach)
        last_good = vector(floats, places, i, SLOT.last_good)
        last = vector(floats, places, i, SLOT.last)
        values = vector(floats, places, i, SLOT.values)
        sigma = vector(floats, places, i, SLOT.sigma)
        unit = vector(floats, places, i, SLOT.unit)
        limits = vector(floats, places, i, SLOT.limits)
        limits_awaited = vector(floats, places, i, SLOT.limits_awaited)
        scores = vector(floats, places, i, SLOT.scores)
        lengths_ticks = vector(ints, places, i, SLOT.lengths_ticks)
        counts = vector(ints, places, i, SLOT.counts)
        echo_off = vector(ints, places, i, SLOT.echo_off)
        stale = vector(ints, places, i, SLOT.stale)
        turns = vector(ints, places, i, SLOT.turns)
        valid = vector(bools, places, i, SLOT.valid)
        echoing = vector(bools, places, i, SLOT.echoing)
        suspects = vector(bools, places, i, SLOT.suspects)
        refused = vector(bools, places, i, SLOT.refused)
        # The sample, as it connects to the stream.
        unwrap(leg, measured, desired, preview_in[i], seam, leg.restart)
        keep_sample(leg, measured, desired, kept_angles[i], kept_stamps[i])
        if leg.restart:
            restart_clock(leg)
        missed = follow_clock(leg, leg.t_ns, leg.seq, ring[i])
        leg.missed = missed
        leg.accepted_n += 1
        leg.total_n += 1
        if leg.late != 1:
            leg.lateness = 0.0
        if leg.restart:
            restart_leg(leg, command, before, desired, suspects)
            leg.began_ns, leg.began_n, leg.began_count = leg.at_ns, leg.total_n, 1
        elif missed and leg.known:
            if missed != PAUSE and missed < leg.length:
                note_hole(leg, rows[i])
                bridge(
                    leg, desired if leg.lost else command, missed, window, lags, preview,
                    history[i], increment, theta, thetas[i], reach, last_good,
                    last, suspects, stale, refused, values, counts,
                    table, xi0[i], coefficients[i], domain[i], predicting, some, room,
                )  # fmt: skip
            else:
                restart_history(leg, suspects)
                break_off(leg)
                leg.loaded, leg.calm = True, 0
        if leg.restart or missed:
            leg.echo_n = 0
            begin_echo(echo_runs[i])
            if leg.restart:
                restart_phase(leg, parts[i])
        take_command(leg, desired, echo_commands[i])
        height = 0.0
        if leg.has_lengths and leg.phase != UNKNOWN:
            place_foot(desired, links[i], turns, now)
            height = now[2]
        take_phase(leg, leg.phase, desired, height, phase_before, parts[i])
        # The swing, by the command.
        awaited = leg.known and not (leg.loaded or leg.contact)
        whole = leg.whole
        ends = follow_command(
            leg, leg.phase, measured, desired, leg.seq, links[i], turns, low,
            lengths_ticks, last_desired, last_measured, last_read, path[i], asked,
            commanded, foot, start, now, awaited,
        )  # fmt: skip
        if (ends or leg.ticks == 0) and leg.open and leg.known:
            leg.open = False
            leg.found |= RESOLVED
            leg.resolved_first, leg.resolved_last = leg.lift_n, leg.row_n
            leg.resolved_whole = whole
            if not ends:
                leg.resolved_rise, leg.resolved_fallen = leg.rise, leg.fallen
            leg.row_n = leg.lift_n
            leg.closed = True
        if leg.ticks == 1:
            leg.found |= BEGAN
            if leg.began_count == 2:
                leg.began_ns, leg.began_n = leg.began_next_ns, leg.began_next_n
            leg.began_next_ns, leg.began_next_n = leg.at_ns, leg.total_n
            leg.began_count = 2
            leg.open = True
            leg.touching = False
            begin_labels(leg)
            leg.withholds = leg.withholds_begun
            leg.broken = not (leg.whole or leg.has_lengths)
            leg.loaded, leg.calm = True, 0
            leg.began_full = leg.known and leg.filled >= leg.length and preview == 0
            if leg.known:
                leg.usable = 0
                began_window[:] = window
        follow_source(
            leg, measured, valid, leg.has_valid, echo_commands[i], echo_runs[i], echo_off,
            echoing, suspects,
        )  # fmt: skip
        void = leg.misread or leg.cause != NONE
        leg.release_pending |= leg.reported and (void or leg.withholds)
        if leg.release_pending:
            leg.found |= RELEASE_PENDING
        if not leg.known:
            continue
        # The reading.
        repair(
            leg, measured, valid, leg.has_valid, now_reading(room), window, lags, preview,
            history[i], increment, reach, last_good, last, suspects, stale,
            refused, values, counts, table, xi0[i], coefficients[i], domain[i], theta,
            predicting, some, room,
        )  # fmt: skip
        take(leg, room[6], window, lags, history[i], increment)
        can = judged(leg, theta, thetas[i])
        follow_foot(
            leg, room[6], links[i], turns, lengths_ticks, last_measured, heights,
            asked, commanded, foot, start, now,
        )  # fmt: skip
        if leg.rate_off:
            restart_history(leg, suspects)
            break_off(leg)
            leg.found |= RATE_OFF
            continue
        if void:  # what is high and low, or where the leg is, is not known
            break_off(leg)
            continue
        if not can:
            note_hole(leg, rows[i])
            continue
        if leg.ticks < 2:
            continue
        # The residual, against its variance.
        leg.context = context_of(leg, command, before)
        for j in range(joints):
            unit[j] = leg.variance_scale
            if leg.inflated:
                ratio = model_uncertainty(theta, index[i], per_scale[i], root[i], leg.root_n, j)
                unit[j] *= 1.0 + ratio
            unit[j] *= leg.inflation
        if leg.clock_left or leg.stretch:
            if leg.stretch:
                leg.clock_most, leg.clock_left = abs(leg.stretch), UNSURE_TICKS + 1
            leg.clock_left -= 1
            if leg.stretch and not (leg.loaded or leg.contact or leg.after):
                vote_late(leg, history[i, 0, 0], history[i, 1, 0], sigma)
            if leg.late < 0:
                for j in range(joints):
                    by = leg.clock_most * history[i, 1, 0, j] / sigma[j]
                    unit[j] += by * by
        for j in range(joints):
            room[2, j] = 1.0 / math.sqrt(unit[j])
        against = leg.after > 0 and leg.has_lengths
        if against:
            height_gradient(last_measured, links[i], turns, room[3])
        leg.distance = statistic(
            leg, history[i], whiten[i], room[2], limits, limits_awaited, scores, sums,
            room[3], against,
        )  # fmt: skip
        if leg.usable and not leg.bad:
            note_fit(leg, leg.distance * leg.variance_scale / joints)
        # Free, loaded, or contact.
        past_lift = descending(leg, lengths_ticks)
        topped = leg.topped and not leg.broken if leg.gated else not leg.broken
        loaded = leg.loaded
        score, onset_ns = scores[0], leg.at_ns
        for width in range(1, DEPTH):
            if scores[width] > score:
                score = scores[width]
        if leg.after:
            leg.quiet = leg.quiet + 1 if leg.sure and not leg.bad and score < QUIET_SCORE else 0
        if score > 1.0:
            up = leg.rising or not past_lift
            if leg.gated and up and not (leg.topped or leg.broken):
                score = 1.0
            elif not loaded:
                spread, score, widest = 0.0, 0.0, 1
                for width in range(min(leg.thetas_n, DEPTH)):
                    if leg.has_domain:
                        spread += leverage(thetas[i, width], domain[i])
                    within = scores[width] / (1.0 + spread / (width + 1))
                    if within > score:
                        score, widest = within, width + 1
                onset_ns = onset(leg, history[i], widest)
        swing_tick(leg, score, leg.distance / limits[0], onset_ns, past_lift and topped)
        if leg.found & TOUCHED:
            note_contact(leg)
        free = not (loaded or leg.contact)
        if loaded and not leg.loaded:
            leg.usable = 0
        elif free and not leg.after:
            for j in range(joints):
                free_ring[i, leg.free_n % len(free_ring[i]), j] = history[i, 0, 0, j]
            leg.free_n += 1
        # What is learned from it, later.
        if leg.learning:
            if leg.found & TOUCHED:
                leg.touching, leg.touch_n = True, 0
            if leg.touching:
                keep_touch(
                    leg, vector(floats, places, i, SLOT.touch), thetas[i], history[i], whiten[i],
                    unit, limits, limits_awaited,
                )  # fmt: skip
            if not (leg.bad or leg.after):  # after the turn, too soft a touch may be in it
                enter_row(
                    leg, rows[i], row_values[i], thetas[i, 0], history[i], leg.distance,
                    scores[0] * limits[0], free, past_lift, whiten[i], unit, last_measured,
                    links[i], turns, room[0], room[1],
                )  # fmt: skip
                if leg.topped and not leg.broken and not leg.top_seen:
                    leg.top_seen = True
                    leg.found |= TOPPED
    found = 0
    for i in range(len(legs)):
        if legs[i].accepted:
            found |= legs[i].found
    return found


@compiled
def now_reading(floats):
    """Return the scratch row that holds the repaired reading."""
    return floats[6]


@compiled
def bridge(
    leg, desired, missed, window, lags, preview, history, increment, theta, thetas, reach,
    last_good, last, suspects, stale, refused, values, counts, table, xi0, coefficients, domain,
    room, bools, floats,
):  # fmt: skip
    """Fill a short gap by the model's own predictions, with commands interpolated.

    The last three are scratch of :func:`judge_tick`: ``sums``, ``some`` and ``room``.
    """
    joints = len(desired)
    has_valid = np.bool_(False)  # a literal would have `repair` compiled once more
    origin = floats[7]
    for j in range(joints):
        origin[j] = window[lags * joints + j]
    for k in range(1, missed + 1):
        if not predict_next(leg, window, preview, table, xi0, coefficients, theta, increment, room):
            restart_history(leg, suspects)
            return
        for j in range(joints):
            floats[8, j] = window[j] + increment[j]
        repair(
            leg, floats[8], bools[0], has_valid, floats[6], window, lags, preview, history,
            increment, reach, last_good, last, suspects, stale, refused, values, counts, table,
            xi0, coefficients, domain, theta, room, bools, floats,
        )  # fmt: skip
        take(leg, floats[6], window, lags, history, increment)
        judged(leg, theta, thetas)
        leg.usable = 0
        share = k / (missed + 1)
        for j in range(joints):
            floats[8, j] = origin[j] + share * (desired[j] - origin[j])
        push_command(leg, floats[8], window, lags, preview)
        leg.predicted = False
        predict_next(leg, window, preview, table, xi0, coefficients, theta, increment, room)
    leg.unsure = UNSURE_TICKS


@compiled
def finish_tick(handed):
    """Put commands in force and predict the next tick: the second half.

    Args:
        handed: as for :func:`judge_tick`, by ``FINISHED``.

    Returns:
        Rows held back of the leg that has most.
    """
    (
        legs, floats, places, preview_in, depths, kind, first, entry, weight, knee, law, xi0,
        coefficients, sums,
    ) = receive_finished(handed)  # fmt: skip
    lags, preview = depths[0], depths[1]
    joints = coefficients.shape[2]
    predicting = sums.reshape(2 * joints)
    most = 0
    for i in range(len(legs)):
        if not legs[i].unfinished:
            continue
        leg = legs[i]
        leg.unfinished = False
        most = max(most, leg.row_n)
        desired = vector(floats, places, i, SLOT.desired)
        command = vector(floats, places, i, SLOT.command)
        before = vector(floats, places, i, SLOT.before)
        window = vector(floats, places, i, SLOT.window)
        theta = vector(floats, places, i, SLOT.theta)
        increment = vector(floats, places, i, SLOT.increment)
        for j in range(joints):
            before[j] = command[j]
            command[j] = desired[j]
        if leg.has_lengths:
            leg.descent = not leg.commanded_up
        if not leg.known:
            continue
        full = push_command(leg, desired, window, lags, preview)
        ready = full
        if preview:
            ready = full and leg.preview_n >= preview
            if leg.preview_n >= preview:
                begin = len(window) - preview * joints
                for k in range(preview):
                    for j in range(joints):
                        window[begin + k * joints + j] = preview_in[i, k, j]
            leg.lacking = RECENT_TICKS if full and not ready else max(leg.lacking - 1, 0)
        leg.predicted = False
        if ready and leg.ticks:
            regressors(window, kind, first, entry, weight, knee, law, xi0[i], theta, predicting)
            leg.predicted = predict(theta, coefficients[i], increment)
    return most
