"""Computes one tick of several legs, compiled: from samples to events, and to predictions.

:func:`evaluate_tick` is the first half: up to the events, and what is to be kept of the tick.
:func:`predict_next_tick` is the second: commands, and the predictions of the next tick.
Between the two, Python takes what the first half has flagged.
"""

from __future__ import annotations

import math

import numpy as np

from adaptive_contact.compiled import compiled, stage
from adaptive_contact.core.detect.contact import (
    PRIOR_STRIKE,
    USUAL_CONTACTS,
    add_push,
    assess_fit_before_contact,
    begin_labels,
    break_off,
    context_of,
    count_fitting_ticks,
    drop_pushed_rows,
    enter_row,
    is_high,
    let_go,
    may_stick,
    model_uncertainty,
    onset,
    push_ratio,
    record_hole,
    statistic,
    strikes,
    swing_tick,
)
from adaptive_contact.core.detect.history import (
    NOW,
    ORIGIN,
    UNSURE_TICKS,
    UNUSED,
    enter_residual,
    leverage,
    predict_next,
    push_command,
    push_reading,
    repair,
    restart_history,
)
from adaptive_contact.core.detect.layout import (
    BEGAN,
    DEPTH,
    RATE_OFF,
    RELEASE_PENDING,
    RESOLVED,
    RESTARTED,
    TOPPED,
    TOUCHED,
    TURNED,
    copy_vector,
    kept_of,
    model_of,
    noise_of,
    past_of,
    receive_tick,
    sample_of,
    source_of,
    swing_of,
)
from adaptive_contact.core.detect.regressors import predict, regressors
from adaptive_contact.core.detect.source import (
    NONE,
    PAUSE,
    UNJUDGED_TURNS,
    count_turns,
    keep_sample,
    restart_clock,
    restart_phase,
    update_clock,
    update_phase_parts,
    update_source_cause,
    vote_late,
)
from adaptive_contact.core.detect.state import airborne, forget_state, hangs, update_state
from adaptive_contact.core.detect.swing import (
    QUIET_SCORE,
    RECENT_TICKS,
    descending,
    forget_phase,
    height_gradient,
    locate_foot,
    resolve_heights,
    update_commanded_foot,
    update_measured_foot,
)
from adaptive_contact.model.noise import DESCENT, LIFT


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
    """Move angles into the revolution nearest to others, if one is further off than half of one."""
    for j in range(len(angles)):
        if abs(angles[j] - origin[j]) > math.pi:
            for k in range(len(angles)):
                turns = np.rint((angles[k] - origin[k]) / (2.0 * math.pi))
                angles[k] -= 2.0 * math.pi * turns
            return


@compiled
def clip(desired, preview, lower, upper):
    """Clip commands to where the servos stop; those of another turn are left."""
    for j in range(len(desired)):
        if lower[j] - math.pi < desired[j] < upper[j] + math.pi:
            desired[j] = min(max(desired[j], lower[j]), upper[j])
            for k in range(len(preview)):
                preview[k, j] = min(max(preview[k, j], lower[j]), upper[j])


@compiled
def evaluate_tick(handed):
    """Evaluate a sample of every leg that has one: the first half of a tick, up to its events.

    Args:
        handed: arrays of a :class:`~adaptive_contact.core.detect.leg_batch.LegBatch`, a row per
            leg, by ``TICK`` of :mod:`adaptive_contact.core.detect.layout`.

    Returns:
        The flags of all legs, in one.
    """
    batch = receive_tick(handed)
    found = 0
    for i in range(len(batch.legs)):
        leg = batch.legs[i]
        if not leg.accepted:
            continue
        leg.found, leg.unfinished = 0, True
        sample, source, swing = sample_of(batch, i), source_of(batch, i), swing_of(batch, i)
        past, model = past_of(batch, i), model_of(batch, i)
        noise, kept = noise_of(batch, i), kept_of(batch, i)
        connect(leg, sample, source, past, model, kept)
        update_swing(leg, sample, source, swing, past, model)
        watch_source(leg, past)
        if leg.has_model and read(leg, sample, swing, past, model, kept):
            weigh(leg, sample, swing, past, noise)
            was_free, past_lift = decide(leg, swing, past, model, noise, kept)
            leg.weighed |= past_lift and leg.usable > 0 and not leg.loaded
            hold_back(leg, swing, past, noise, kept, was_free, past_lift)
        update_state(leg, sample, swing, past, noise)
        found |= leg.found
    return found


@stage
def connect(leg, sample, source, past, model, kept):
    """Connect a sample to those before it: its revolution, its tick, what was lost between."""
    measured, desired, restart = sample.measured, sample.desired, leg.restart
    unwrap(leg, measured, desired, sample.preview_in, sample.seam, restart)
    clip(desired, sample.preview_in, sample.lower, sample.upper)
    keep_sample(leg, measured, desired, source.kept_angles, source.kept_stamps)
    if restart:
        restart_clock(leg)
    missed = update_clock(leg, leg.t_ns, leg.seq, source.ring)
    leg.missed = missed
    leg.accepted_n += 1
    leg.total_n += 1
    if leg.late != 1:
        leg.lateness = 0.0
    if restart:
        restart_leg(leg, sample.command, sample.before, desired, past.suspects)
        restart_phase(leg, source.parts)
        leg.began_ns, leg.began_n, leg.began_count = leg.at_ns, leg.total_n, 1
    elif missed and leg.has_model:
        if missed != PAUSE and missed < leg.length:
            record_hole(leg, kept.rows)
            bridge(leg, past, model, desired if leg.lost else sample.command, missed)
        else:
            restart_history(leg, past.suspects)
            break_off(leg)
            leg.loaded, leg.calm = True, 0


@stage
def update_swing(leg, sample, source, swing, past, model):
    """Update the swing by its commands: it goes on, ends, or the next one begins."""
    desired = sample.desired
    height = 0.0
    if leg.has_lengths:
        locate_foot(desired, swing.links, swing.axis_kinds, swing.now)
        height = leg.command_m = swing.now[2]
    lifts = count_turns(leg, desired, height, source.turn_at, source.turning, source.turns)
    update_phase_parts(leg, leg.phase, desired, height, source.phase_before, source.parts)
    awaited = leg.has_model and not (leg.loaded or leg.contact)
    whole, swung = leg.whole, leg.ticks > 0 and leg.after == 0
    ends = update_commanded_foot(leg, swing, sample.measured, desired, awaited)
    if swung and (leg.after > 0 or leg.ticks == 0):
        leg.found |= TURNED
    if leg.weighed and (lifts or ends or leg.after or leg.ticks == 0):
        leg.weighed, leg.unjudged = False, 0
        source.turns[:] = 0
    if (ends or leg.ticks == 0) and leg.unresolved and leg.has_model:
        leg.unresolved = False
        leg.found |= RESOLVED
        leg.resolved_first, leg.resolved_last = leg.lift_n, leg.row_n
        leg.resolved_whole = whole
        if not ends:
            resolve_heights(leg, swing.foot[2], swing.commanded[2])
        leg.row_n = leg.lift_n
        leg.closed = True
    if leg.ticks == 1:
        leg.found |= BEGAN
        if leg.began_count == 2:
            leg.began_ns, leg.began_n = leg.began_next_ns, leg.began_next_n
        leg.began_next_ns, leg.began_next_n = leg.at_ns, leg.total_n
        leg.began_count = 2
        leg.unresolved = True
        begin_labels(leg)
        leg.withholds = leg.withholds_begun
        leg.broken = not (leg.whole or leg.has_lengths)
        leg.loaded, leg.calm = True, 0
        leg.began_full = leg.has_model and leg.filled >= leg.length and model.depths[1] == 0
        if leg.has_model:
            leg.usable = 0
            copy_vector(past.window, past.began_window)


@stage
def watch_source(leg, past):
    """Watch for false readings and swapped phases.

    A contact is released under them, where angles are misread, and where contacts are withheld or
    nothing is judged.
    """
    update_source_cause(leg, past.suspects)
    unjudged = leg.unjudged >= UNJUDGED_TURNS and not leg.weighed
    leg.release_pending |= leg.reported and (is_void(leg) or leg.withholds or unjudged)
    if leg.release_pending:
        leg.found |= RELEASE_PENDING


@compiled
def is_void(leg):
    """Return whether samples cannot be judged: heights or positions of the leg are unknown."""
    return leg.misread or leg.cause != NONE


@stage
def read(leg, sample, swing, past, model, kept):
    """Take in the reading; return whether its residual can be judged.

    It can in a swing, from its second tick on: nothing is predicted in a stance.
    """
    repair(leg, past, model, sample.measured, sample.valid, leg.has_valid)
    push_reading(past.reading, past.increment, past.window, past.history, model.depths[0])
    can = enter_residual(leg, past.theta, past.thetas)
    update_measured_foot(leg, swing, past.reading)
    if leg.rate_off:
        restart_history(leg, past.suspects)
        break_off(leg)
        leg.found |= RATE_OFF
        can = False
    elif is_void(leg):
        break_off(leg)
        can = False
    elif not can:
        record_hole(leg, kept.rows)
    return can and leg.ticks >= 2


@stage
def weigh(leg, sample, swing, past, noise):
    """Weigh the residual: its variance in this tick, the statistic, the test ratios."""
    history, sigma, unit = past.history, noise.sigma, noise.unit
    joints = len(unit)
    leg.context = context_of(leg, sample.command, sample.before)
    for j in range(joints):
        unit[j] = leg.variance_scale
        if leg.inflated:
            ratio = model_uncertainty(
                past.theta, noise.index, noise.per_scale, noise.root, leg.root_n, j
            )
            unit[j] *= 1.0 + ratio
        unit[j] *= leg.reading_variance
    if leg.clock_left or leg.stretch:
        if leg.stretch:
            leg.clock_most, leg.clock_left = abs(leg.stretch), UNSURE_TICKS + 1
        leg.clock_left -= 1
        if leg.stretch and not (leg.loaded or leg.contact or leg.after):
            vote_late(leg, history[0, 0], history[1, 0], sigma)
        if leg.late < 0:
            for j in range(joints):
                by = leg.clock_most * history[1, 0, j] / sigma[j]
                unit[j] += by * by
    for j in range(joints):
        noise.shrink[j] = 1.0 / math.sqrt(unit[j])
    upward = leg.after > 0 and leg.has_lengths and not leg.after_known
    if upward:
        height_gradient(swing.last_measured, swing.links, swing.axis_kinds, swing.gradient)
    leg.squared = statistic(leg, noise, history, swing.gradient, upward)
    if not leg.bad:
        count_fitting_ticks(leg, leg.squared * leg.variance_scale / joints)


@stage
def decide(leg, swing, past, model, noise, kept):
    """Decide whether the leg is free, loaded or touches.

    Returns:
        Whether the leg had been free before this tick and does not touch, and whether the command
        is past the lift.
    """
    history = past.history
    past_lift = descending(leg, swing.lengths_ticks)
    loaded = leg.loaded
    sticks = past_lift and may_stick(leg, swing)
    # Once it is known how the leg touches, what pushes there is learned.
    learned = airborne(leg) or (sticks and leg.usual_n >= USUAL_CONTACTS)
    if past_lift and not (leg.bad or loaded or leg.contact or learned):
        add_push(leg)
    score, onset_ns = leg_score(leg, past_lift, past, model, noise)
    if sticks and score < PRIOR_STRIKE:
        score = min(score, 1.0)
    topped = not leg.broken and (leg.topped or not leg.learning)
    calm = DESCENT if leg.descent else LIFT
    swing_tick(leg, score, leg.squared / noise.limits[calm, 0], onset_ns, past_lift and topped)
    if leg.found & TOUCHED:
        assess_fit_before_contact(leg)
    was_free = not (loaded or leg.contact)
    if loaded and not leg.loaded:
        leg.usable = 0  # windows do not reach back to where it was loaded
    elif was_free and not leg.after:
        at = leg.free_n % len(kept.free_ring)
        for j in range(len(noise.unit)):
            kept.free_ring[at, j] = history[0, 0, j]
        leg.free_n += 1
    return was_free, past_lift


@stage
def hold_back(leg, swing, past, noise, kept, was_free, past_lift):
    """Hold the tick's row back until its swing is resolved."""
    if not leg.learning:
        return
    air = airborne(leg)  # then no row is of a touch
    leg.cleared |= air
    if past_lift and not (leg.bad or air) and (was_free or leg.found & TOUCHED):
        drop_pushed_rows(leg, kept.rows)
    # After the turn, a low foot may touch too softly to be seen.
    if not leg.bad and (air or not leg.after or is_high(leg, swing)):
        enter_row(leg, swing, past, noise, kept, was_free, past_lift, air)
        if leg.topped and not leg.broken and not leg.top_seen:
            leg.top_seen = True
            leg.found |= TOPPED


@stage
def leg_score(leg, past_lift, past, model, noise):
    """Compute the test ratio that decides, and when a contact that it shows began, ns.

    Counts quiet ticks after the turn, too.
    """
    scores = noise.scores
    score, onset_ns = scores[0], leg.at_ns
    for width in range(1, DEPTH):
        if scores[width] > score:
            score = scores[width]
    pushed = push_ratio(leg) if past_lift and not (leg.loaded or leg.contact) else 0.0
    score = max(score, pushed)
    if leg.after:
        leg.quiet = leg.quiet + 1 if leg.sure and not leg.bad and score < QUIET_SCORE else 0
    if score > 1.0 and leg.after and hangs(leg):
        score = 1.0
    if score > 1.0:
        up = leg.rising or not past_lift
        if (
            leg.learning
            and up
            and not (
                leg.topped or leg.broken or (not past_lift and strikes(leg, past.history, score))
            )
        ):
            score = 1.0  # other than a strike, no alarm before the command's top (decision 19)
        elif not leg.loaded:
            spread, score, widest = 0.0, 0.0, 1
            for width in range(min(leg.thetas_n, DEPTH)):
                if leg.has_domain:
                    spread += leverage(past.thetas[width], model.domain)
                within = scores[width] / (1.0 + spread / (width + 1))
                if within > score:
                    score, widest = within, width + 1
            onset_ns = onset(leg, past.history, widest)
            pushed /= 1.0 + spread / min(max(leg.thetas_n, 1), DEPTH)
            if pushed > score:
                score, onset_ns = pushed, leg.push_ns - leg.period_ns
    return score, onset_ns


@compiled
def restart_leg(leg, command, before, desired, suspects):
    """Forget the past of a leg whose source has started again."""
    leg.found |= RESTARTED
    let_go(leg)
    forget_state(leg)
    leg.whole = leg.stood = False
    leg.ticks = leg.after = 0
    leg.obstructed = False
    leg.surface = leg.touch_at = leg.touch_before = -np.inf
    leg.heights_n = 0
    leg.has_desired = leg.has_measured = False
    forget_phase(leg)
    leg.unresolved = False
    break_off(leg)
    for j in range(len(desired)):
        command[j] = before[j] = desired[j]
    restart_history(leg, suspects)


@compiled
def bridge(leg, past, model, desired, missed):
    """Fill a short gap by the model's own predictions, with commands interpolated."""
    joints = len(desired)
    has_valid = np.bool_(False)  # a literal would have `repair` compiled once more
    origin, now = past.room[ORIGIN], past.room[NOW]
    for j in range(joints):
        origin[j] = past.window[model.depths[0] * joints + j]
    for k in range(1, missed + 1):
        if not predict_next(leg, past, model):
            restart_history(leg, past.suspects)
            return
        for j in range(joints):
            now[j] = past.window[j] + past.increment[j]
        repair(leg, past, model, now, past.some[UNUSED], has_valid)
        push_reading(past.reading, past.increment, past.window, past.history, model.depths[0])
        enter_residual(leg, past.theta, past.thetas)
        leg.usable = 0
        share = k / (missed + 1)
        for j in range(joints):
            now[j] = origin[j] + share * (desired[j] - origin[j])
        push_command(leg, past.window, model.depths, now)
        leg.predicted = False
        predict_next(leg, past, model)
    leg.unsure = UNSURE_TICKS


@compiled
def predict_next_tick(handed):
    """Put commands in force and predict the next tick: the second half.

    Args:
        handed: as for :func:`evaluate_tick`.

    Returns:
        Largest number of pending rows of any leg.
    """
    batch = receive_tick(handed)
    preview = batch.depths[1]
    most = 0
    for i in range(len(batch.legs)):
        leg = batch.legs[i]
        if not leg.unfinished:
            continue
        leg.unfinished = False
        most = max(most, leg.row_n)
        sample, past, model = sample_of(batch, i), past_of(batch, i), model_of(batch, i)
        joints = len(sample.desired)
        for j in range(joints):
            sample.before[j] = sample.command[j]
            sample.command[j] = sample.desired[j]
        if leg.has_lengths:
            leg.descent = not leg.commanded_up
        if not leg.has_model:
            continue
        full = push_command(leg, past.window, model.depths, sample.desired)
        ready = full
        if preview:
            ready = full and leg.preview_n >= preview
            if leg.preview_n >= preview:
                begin = len(past.window) - preview * joints
                for k in range(preview):
                    for j in range(joints):
                        past.window[begin + k * joints + j] = sample.preview_in[k, j]
            leg.lacking = RECENT_TICKS if full and not ready else max(leg.lacking - 1, 0)
        leg.predicted = leg.foreseen = False
        if ready:
            regressors(
                past.window, model.kind, model.first, model.entry, model.weight, model.knee,
                model.law, model.xi0, past.theta, model.forms,
            )  # fmt: skip
            if leg.ticks:
                leg.predicted = predict(past.theta, model.coefficients, past.increment)
            elif leg.has_lengths:  # for the state alone: no contact is decided here
                leg.foreseen = predict(past.theta, model.coefficients, past.ahead)
    return most
