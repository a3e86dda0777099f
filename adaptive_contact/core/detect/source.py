"""Follows what a leg's source sends, compiled: its clock, swapped phases, what else is wrong.

The reasons and the evidence stand in ``source_watch.py``.

Parts, swings and stances, are (3, 4): ticks, travel, the furthest fall and the peak of the
commanded foot; the part in hand first, then the last stance and the last swing.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled, stage
from adaptive_contact.core.detect.contact import break_off, let_go
from adaptive_contact.core.detect.history import restart_history
from adaptive_contact.core.detect.layout import RING, SOURCE, copy_vector
from adaptive_contact.core.detect.swing import UNKNOWN

# Steps over which the rate of a steady source is judged: a rate that changes by 20 % shows in the
# fifth tick, before the ticks held back at the end of a swing are used up.
RATE_STEPS: Final = 8
# Where stamps are off, as many more as it takes until the mean is known to this many standard
# errors within the limit; two seconds at 50 Hz at most.
RATE_ERRORS: Final = 8.0
MOST_RATE_STEPS: Final = 100
# The latest tick that is no pause, 3 periods late, moves the mean of so many steps by MOST_OFF.
MEAN_STEPS: Final = 30
# A model's velocities are per tick: at a rate further off than this it predicts another leg.
MOST_OFF: Final = 0.10
STEADY_OFF: Final = 0.05
# Standard errors by which the mean of a loop whose delays add up is beyond the limit before it
# counts: without them 331 of 365 touches are found where one tick in four slips, with them 360.
RATE_SURE: Final = 2.0
# A step longer than so many periods is a whole tick that came late, where ticks are known to.
LATE_PERIODS: Final = 1.6
# A step this many times too long is a pause of the source, counted by `seq` or not.
PAUSE_PERIODS: Final = 4.0
# Ticks closer than so many periods arrive together; so many of them are a burst, as what comes
# between fewer is no pause.  It is over after as many ticks that come alone as there were bursts,
# up to so many.
TOGETHER: Final = 0.5
LEAST_BURST: Final = 4
MOST_BURSTS: Final = 8
# Share of a stamp's deviation by which the schedule follows it.  Higher follows a loop that slips
# sooner, lower averages the jitter of more stamps.  Measured, the level of residuals is near its
# least at 0.2 for loops late against a fixed schedule and for ones that slip (decision 30).
SCHEDULE_GAIN: Final = 0.2
# Share of ticks that slip from which on the schedule has their pace: at that gain it has caught up
# to a twentieth after 13 ticks.  Slips of d in a share f of the ticks have the mean f d, and the
# mean square f d^2.
SLIP_SHARE: Final = 0.07
# Memory of the figures on jitter, in ticks.
JITTER_MEMORY: Final = 64
# A stamp off by less (in periods) is on schedule: the fastest joint of a leg goes a tenth of a step
# of its servo in that time.
ON_SCHEDULE: Final = 0.01
# Whether stamps or ticks are late is known after so many whole votes, each of a tick in which
# that makes a difference of far more than the residual's noise; what is forgotten in a few swings.
VOTES: Final = 3.0
VOTE_MEMORY: Final = 200
# Share of the deviations that readings show, above which they are taken for late, and below which
# no longer.
LATE_SHARE: Final = 0.6
ON_TIME_SHARE: Final = 0.4

PAUSE: Final = -1

# Mean speed of a swing's command over that of the stance beside it: 1.28 and more of correct
# phases, at most 0.61 of swapped ones (decision 24).
SWAPPED_RATIO: Final = 0.8
# And the foot's command comes down by less than this share of what it does in stances: by 18 mm and
# more in a swing that meets the ground, by 5 mm at most in 95 of 100 stances.
FALL_SHARE: Final = 0.5
# It comes down in stances by this much, as in any swing.
LEAST_FALL_M: Final = 0.01
# Without geometry, a joint that goes so far and back is a lift and a lowering: the shipped robots'
# median swings turn one to and fro by 0.18 to 0.73 rad.
LEAST_TURN_RAD: Final = 0.1
# After so many of them of which none could be judged, a leg is not valid.
UNJUDGED_TURNS: Final = 2
# Without geometry the speed alone must say so, in so many swings in a row: a leg that is put
# somewhere else in its stance may be fast, too.
SLOW_SWINGS: Final = 2
# Parts of fewer ticks have no mean speed worth comparing, nor has the beginning of one.
LEAST_TICKS: Final = 3
BEGINNING: Final = 8

NONE: Final = 0  # causes
ECHO: Final = 1
PHASE: Final = 2
STALE: Final = 3
LOW: Final = 0  # of a command, see `count_turns`
LIFTED: Final = 1
LOWERED: Final = 2
TICKS: Final = 0  # of a part
TRAVEL: Final = 1
FALL: Final = 2
PEAK: Final = 3


@compiled
def keep_sample(leg, measured, desired, angles, stamps):
    """Keep a sample, of the newest since the source began."""
    if leg.restart:
        leg.kept_n = 0
    at = leg.kept_n % len(stamps)
    joints = len(measured)
    for j in range(joints):
        angles[at, j], angles[at, joints + j] = measured[j], desired[j]
    stamps[at, 0], stamps[at, 1], stamps[at, 2] = leg.t_ns, leg.seq, leg.phase
    leg.kept_n += 1


@compiled
def anchor(leg, t_ns, seq, ring):
    """Set the schedule to this tick."""
    leg.at_ns, leg.due_ns = t_ns, t_ns + np.int64(np.rint(leg.pace * leg.period_ns))
    leg.lateness = leg.stretch = 0.0
    at = leg.ring_n % RING
    ring[at, 0], ring[at, 1], ring[at, 2] = t_ns, seq, t_ns
    leg.ring_n += 1


@compiled
def update_jitter(leg, by):
    """Update the jitter by a deviation from the schedule, periods."""
    leg.jitter_mean += (by - leg.jitter_mean) / JITTER_MEMORY
    leg.jitter_square += (by * by - leg.jitter_square) / JITTER_MEMORY
    if by == 0.0:
        leg.spread -= leg.spread / JITTER_MEMORY
        if leg.jitter_square < ON_SCHEDULE**2:
            leg.jitter_mean = leg.jitter_square = leg.spread = 0.0


@compiled
def off_schedule(leg, t_ns, seq, missed, periods, ring):
    """Follow a stamp that is off the schedule, its step so many periods a tick."""
    period = leg.period_ns
    count = min(leg.ring_n, RING)
    oldest, newest = (leg.ring_n - count) % RING, (leg.ring_n - 1) % RING
    due_ns = leg.due_ns + missed * period
    by_ns = t_ns - due_ns
    steps = ring[newest, 1] - ring[oldest, 1]
    mean = 1.0
    if steps >= JITTER_MEMORY:
        mean = (ring[newest, 0] - ring[oldest, 0]) / steps / period
    # A schedule that runs at the described rate stays behind a loop that slips again before it has
    # caught up.  Where slips are rarer, the ticks between them are apart as described.
    slip = mean - 1.0
    often = slip * slip >= SLIP_SHARE * (leg.spread + slip * slip)
    leg.pace = mean if leg.late == 1 and often else 1.0
    leg.at_ns = due_ns + np.int64(np.rint(SCHEDULE_GAIN * by_ns))
    leg.due_ns = leg.at_ns + np.int64(np.rint(leg.pace * period))
    leg.lateness = (t_ns - leg.at_ns) / (leg.pace * period)
    update_jitter(leg, by_ns / period)
    found_ns = leg.found_ns
    if found_ns != found_ns:
        found_ns = (t_ns - ring[oldest, 0]) / (seq - ring[oldest, 1])
    spread = (periods - found_ns / period) ** 2
    leg.spread += (spread - leg.spread) / min(count, JITTER_MEMORY)
    leg.stretch = 0.0
    if not missed:
        stretch = periods - mean
        leg.stretch = stretch if abs(stretch) > ON_SCHEDULE else 0.0
    at = leg.ring_n % RING
    ring[at, 0], ring[at, 1], ring[at, 2] = t_ns, seq, leg.at_ns
    leg.ring_n += 1


@compiled
def check_rate(leg, ring):
    """Compare the mean of as many steps as their spread asks for with the period."""
    steps = RATE_STEPS
    if leg.spread:
        # Errors of stamps cancel in a mean.  Delays of a loop that slips add up: a few of them in a
        # row are not another rate.
        wanted = RATE_ERRORS * math.sqrt(leg.spread) / MOST_OFF
        most = leg.late == 1 or wanted > MOST_RATE_STEPS
        steps = MOST_RATE_STEPS if most else max(RATE_STEPS, math.ceil(wanted))
    leg.rate_ticks = steps + 1
    if min(leg.ring_n, RING) <= steps:
        return
    first, last = (leg.ring_n - 1 - steps) % RING, (leg.ring_n - 1) % RING
    leg.found_ns = (ring[last, 0] - ring[first, 0]) / (ring[last, 1] - ring[first, 1])
    # Nothing is judged, and no vote is cast, while the rate is off: one that jitters comes back at
    # the limit, or a loop that is 6 % slower in the mean would never come back.
    limit = STEADY_OFF if leg.rate_off and not leg.spread else MOST_OFF
    if leg.late == 1 and not leg.rate_off:
        limit += RATE_SURE * math.sqrt(leg.spread / steps)
    by = leg.found_ns / leg.period_ns - 1.0
    off = abs(by) > limit
    if off and steps < MEAN_STEPS:
        side = math.copysign(limit / 2.0, by)
        count = 0
        for k in range(steps):
            a, b = (leg.ring_n - 1 - steps + k) % RING, (leg.ring_n - steps + k) % RING
            step = (ring[b, 0] - ring[a, 0]) / (ring[b, 1] - ring[a, 1]) / leg.period_ns
            if (step - 1.0) / side > 1.0:
                count += 1
        off = 2 * count >= steps
    leg.rate_off = off


@compiled
def restart_clock(leg):
    """Forget the schedule: the source has started again."""
    leg.ring_n, leg.pace = 0, 1.0
    leg.rate_off = False
    leg.found_ns = np.nan


@compiled
def even_out(leg, t_ns, seq, ring):
    """Return when a tick was, of a burst that was stamped as it arrived: by its number in it.

    As many ticks arrive together as the time until the next ones holds.
    """
    period, ticks = leg.period_ns, seq - leg.burst_seq
    together = t_ns - leg.stamp_ns < TOGETHER * period
    leg.stamp_ns = t_ns
    if leg.ring_n > 0 and together:
        return leg.burst_ns + ticks * period if leg.burst else t_ns
    if (
        leg.ring_n > 0
        and ticks >= LEAST_BURST
        and abs(t_ns - leg.burst_ns - ticks * period) < period
    ):
        if leg.burst == 0 and seq == ring[(leg.ring_n - 1) % RING, 1] + 1:
            leg.ring_n = 0  # the stamps of the first burst were taken as they were
        leg.burst, leg.bursts = ticks, min(leg.bursts + 1, MOST_BURSTS)
    elif leg.bursts > 0:
        leg.bursts -= 1
        leg.burst = leg.burst if leg.bursts else 0
    leg.burst_ns, leg.burst_seq = t_ns, seq
    return t_ns


@compiled
def update_clock(leg, t_ns, seq, ring):
    """Update the clock by time and number of an accepted sample.

    Returns:
        Ticks without a reading since the last one, or :data:`PAUSE`.
    """
    t_ns = even_out(leg, t_ns, seq, ring)
    if leg.ring_n == 0:
        anchor(leg, t_ns, seq, ring)
        return 0
    last = (leg.ring_n - 1) % RING
    steps = seq - ring[last, 1]
    missed = steps - 1
    due_ns = leg.due_ns + missed * leg.period_ns
    if abs(t_ns - due_ns) <= math.floor(ON_SCHEDULE * leg.period_ns):
        anchor(leg, t_ns, seq, ring)
        if leg.jitter_square:
            update_jitter(leg, 0.0)
    else:
        periods = (t_ns - ring[last, 0]) / leg.period_ns
        if periods > PAUSE_PERIODS * steps:
            leg.ring_n, leg.pace = 0, 1.0
            anchor(leg, t_ns, seq, ring)
            return PAUSE
        if leg.late == 1 and periods > LATE_PERIODS:
            missed = max(int(periods + 2.0 - LATE_PERIODS) - 1, missed)
        off_schedule(leg, t_ns, seq, missed, periods / steps, ring)
    if min(leg.ring_n, RING) > RATE_STEPS:
        check_rate(leg, ring)
    return missed


@compiled
def vote_late(leg, residual, moved, sigma):
    """Count whether a free tick off the schedule shows that the leg moved by the longer step."""
    shown = power = 0.0
    for j in range(len(residual)):
        off = residual[j] + (leg.stretch * moved[j] if leg.late == 1 else 0.0)
        by = leg.stretch * moved[j] / sigma[j]
        shown += off / sigma[j] * by
        power += by * by
    if power <= 0.0:
        return
    weight = power / (1.0 + power)
    share = min(max(shown / power, -1.0), 2.0)
    kept = 1.0 - weight / VOTE_MEMORY
    leg.votes = kept * leg.votes + weight
    leg.shown = kept * leg.shown + weight * share
    if leg.votes >= VOTES:
        limit = ON_TIME_SHARE if leg.late == 1 else LATE_SHARE
        leg.late = 1 if leg.shown > limit * leg.votes else 0


@compiled
def update_one_clock(legs, ring, t_ns, seq, restart):
    """Apply :func:`update_clock` to the first leg, by itself."""
    if restart:
        restart_clock(legs[0])
    return update_clock(legs[0], t_ns, seq, ring[0])


@compiled
def restart_phase(leg, parts):
    """Reset the parts of swings: the next sample does not connect to them."""
    leg.has_before = False
    leg.phase_part = UNKNOWN
    leg.part_whole = False
    leg.slow_swings = 0
    parts[1:, TICKS] = 0.0


@compiled
def speed_of(part):
    """Compute the mean speed of a part's command, rad per tick."""
    return part[TRAVEL] / max(part[TICKS], 1.0)


@compiled
def compare_parts(leg, parts, swing, ended):
    """Compare the mean speed of the present part with that of the one beside it."""
    beside = 1 if swing else 2
    if parts[beside, TICKS] == 0.0:
        return
    in_swing, in_stance = (0, beside) if swing else (beside, 0)
    fast, slow = speed_of(parts[in_swing]), speed_of(parts[in_stance])
    if leg.swapped:
        # Of a swing in hand: what is published as a stance begins slowly, too.
        if swing and slow < SWAPPED_RATIO * fast:
            leg.swapped = False
        return
    slower = fast < SWAPPED_RATIO * slow
    if ended:
        leg.slow_swings = leg.slow_swings + 1 if slower else 0
    if slower and not leg.has_lengths:
        leg.swapped = leg.slow_swings >= SLOW_SWINGS
    elif slower and (ended or not swing):
        fall = parts[in_stance, FALL]
        small = parts[in_swing, FALL] <= FALL_SHARE * fall
        leg.swapped = small and fall > LEAST_FALL_M * leg.leg_size


@compiled
def update_phase_parts(leg, phase, desired, height, before, parts):
    """Add a tick to its phase's travel and fall; compare the phases, to detect swapped ones.

    Args:
        leg: its scalars.
        phase: that the sample states.
        desired: (J,) rad, its command.
        height: of the commanded foot, m.
        before: (J,) rad, the last command, changed.
        parts: travel, peak and fall of the phases, changed.
    """
    if phase == UNKNOWN:
        if leg.phase_part != UNKNOWN:
            restart_phase(leg, parts)
            leg.swapped = False
        return
    if phase != leg.phase_part:
        over = leg.phase_part
        if over != UNKNOWN:
            if leg.part_whole and parts[0, TICKS] >= LEAST_TICKS:
                if over == 1:
                    compare_parts(leg, parts, True, True)
                copy_vector(parts[0], parts[1 + over])
            leg.part_whole = True
        leg.phase_part = phase
        parts[0, TICKS] = parts[0, TRAVEL] = parts[0, FALL] = 0.0
        parts[0, PEAK] = -np.inf
    part = parts[0]
    if leg.has_before:
        for j in range(len(desired)):
            part[TRAVEL] += abs(desired[j] - before[j])
    leg.has_before = True
    for j in range(len(desired)):
        before[j] = desired[j]
    part[TICKS] += 1.0
    part[PEAK] = max(part[PEAK], height)
    part[FALL] = max(part[FALL], part[PEAK] - height)
    if leg.part_whole and part[TICKS] >= BEGINNING:
        compare_parts(leg, parts, phase == 1, False)


@compiled
def count_turns(leg, desired, height, turn_at, turning, turns):
    """Count lifts and lowerings that are commanded and over, whatever the phase says.

    By the height of the commanded foot, m; where it is not known by each joint of the command, rad.

    Returns:
        Whether the height shows that a lift begins.
    """
    lifts = False
    least = LEAST_FALL_M * leg.leg_size if leg.has_lengths else LEAST_TURN_RAD
    for j in range(1 if leg.has_lengths else len(desired)):
        at = height if leg.has_lengths else desired[j]
        if leg.restart:
            turning[j], turn_at[j] = LOW, at
        elif turning[j] == LIFTED:
            turn_at[j] = max(turn_at[j], at)
            if at < turn_at[j] - least:
                turning[j], turn_at[j] = LOWERED, at
        elif turning[j] == LOWERED and at >= turn_at[j]:
            turning[j] = LOW
            if not leg.weighed:
                turns[j] += 1
                leg.unjudged = max(leg.unjudged, turns[j])
        elif at > turn_at[j] + least:
            turning[j], turn_at[j] = LIFTED, at
            lifts = leg.has_lengths
        else:
            turn_at[j] = min(turn_at[j], at)
    return lifts


@stage
def update_source_cause(leg, suspects):
    """Stop judging a leg whose readings are false or whose phases are swapped, or go on."""
    cause = leg.false_readings if leg.false_readings else PHASE if leg.swapped else NONE
    if cause == leg.cause:
        return
    leg.cause = cause
    leg.found |= SOURCE
    break_off(leg)
    if cause != NONE:
        let_go(leg)
        leg.weighed, leg.unjudged = False, max(leg.unjudged, UNJUDGED_TURNS)
        return
    if leg.has_model:
        restart_history(leg, suspects)
    leg.loaded, leg.calm = True, 0
