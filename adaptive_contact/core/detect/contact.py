"""Decides on contact, compiled: the statistic of a tick, the state of the leg, the rows held back.

*Statistic.*  Residuals against their variance, over up to three ticks.

*State.*  The phase only gates: it never makes a contact by itself, and outside a swing nothing is
decided.  A swing begins *loaded*: after a pressed stance the foot comes off the ground 100 ms and
more after its command does.  It is *free* once the leg has followed the model for some ticks, or
when the descent begins; only a free leg can touch.  A contact ends in the next swing when the leg
is free, or within its own when the leg has followed the model again.

*Rows.*  What may be learned of a swing is held back until the swing is resolved:
``swing_labels.py`` says what it was.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled, stage
from adaptive_contact.core.detect.layout import (
    BROKE_OFF,
    DECIDED,
    DEPTH,
    TOUCHED,
    WEIGHED,
    copy_vector,
)
from adaptive_contact.core.detect.swing import LEAST_WAY_M, height_gradient
from adaptive_contact.model.noise import (
    AFTER,
    DESCENT,
    LIFT,
    SPEED_EDGES_QUANTA,
    SPEEDS,
    UNFIT_LEVEL,
)

# A tick is calm when its distance from the free model is below this share of the threshold: one
# free tick in a thousand is not, while a foot let go of is at several times the threshold.
CALM_SCORE: Final = 0.5
# Calm ticks in a row that show a foot to be off the ground.  A foot about to leave it may look
# calm for one tick, while the push along and the pull back cancel.
CALM_TICKS: Final = 3
# And within a swing, after a contact, one more, for so long: at 200 Hz a foot on soft ground was
# calm for 20 ms and touched again.
REARM_TICKS: Final = 4
REARM_NS: Final = 80_000_000
# Without calm, the first tick of a lift taken for free: a foot pressed in the stance before has let
# go by the 7th tick of the command (measured in pose, 62 of 62 cases).
FREE_LIFT_TICKS: Final = 8
# A swing longer than this keeps its newest ticks; 400 is a slow descent of 8 s.
MAX_ROWS: Final = 400
# Ticks before a touch that are not taken for free: it is seen late by up to two.
GUARD_TICKS: Final = 3
# A push goes on where residuals against the motion exceed this in the mean, in deviations; one
# tick counts for so much at most, and so much in all is no noise.  With these, of 22,000 rows that
# a hexapod with play in its drives learned, 3.2 % in touch, 0.01 % are left, and 96 % of the free.
FREE_PUSH, MOST_PUSH, SURE_PUSH = 1.0, 6.0, 4.0
# Joints of a foot that has come down by less than this share of its rise may still stick.
TOP_SHARE: Final = 0.1
# In a lift, from so long after the command's first tick on, a foot may have struck something
# (`strike_loss`).  Of a leg from a prior the test ratio exceeds this, too: in 4,500 lifts that
# struck nothing it came to 1.6.  The same is asked for at the top of the swing.
STRIKE_NS: Final = 100_000_000
PRIOR_STRIKE: Final = 2.0
# Ground is not met as high as this share of the foot's rise; an obstacle is, and shows at once.
HIGH_SHARE: Final = 0.5
# Fewer free ticks than this say nothing about a lift, nor about the way to a contact.
MIN_LIFT_ROWS: Final = 3
# A foot that stops sooner than it has come `LEAST_WAY_M` moved as predicted for so many ticks, went
# so far (of a leg of 0.256 m; some two position steps), and met something so many ticks later.  On
# steps 24 of 66 contacts more are reported so; of frozen and turned readings, feet that are caught
# and servos without strength none of 684 (decision 24).
STRIKE_ROWS: Final = 5
STRIKE_WAY_M: Final = 0.003
STRIKE_TICKS: Final = 3
# Contacts after which it is known what is usual.
USUAL_CONTACTS: Final = 8
USUAL_STEP: Final = 0.1  # of the logarithm of their median, a contact


@compiled
def context_of(leg, command, before):
    """Compute the context of a tick, from its command and the one before."""
    speed = 0.0
    for j in range(len(command)):
        speed = max(speed, abs(command[j] - before[j]))
    speed /= leg.quantum
    at = SPEEDS * direction_of(leg, 1)
    for edge in SPEED_EDGES_QUANTA:
        if speed >= edge:
            at += 1
    return at


@compiled
def direction_of(leg, width):
    """Return the part of the swing whose noise a window has: lift, descent, or after the turn.

    A window that reaches back over the turn to stance is of the swing, which was judged before.
    So is the first residual after the turn: it is of the way to that sample.
    """
    if width < leg.after:
        return AFTER
    return DESCENT if leg.descent else LIFT


@compiled
def model_uncertainty(theta, index, per_scale, root, size, joint):
    """Compute a prediction's variance that comes from its coefficients, over the noise's."""
    total = 0.0
    for c in range(size):
        v = 0.0
        for k in range(size):
            v += theta[index[joint, k]] * per_scale[joint, k] * root[joint, k, c]
        total += v * v
    return total


@stage
def statistic(leg, noise, history, gradient, upward):
    """Fill the (windows,) test ratios, NaN where a window reaches too far back.

    A foot about to stand has arrived, and what it is predicted to do says little of where the
    ground is: ``upward``, a push along the (J,) gradient of the foot's height counts as well.

    Returns:
        The squared distance of the last residual from zero, whitened.
    """
    whiten, shrink, scores, sums = noise.whiten, noise.shrink, noise.scores, noise.sums
    joints = history.shape[2]
    distance = 0.0
    for j in range(joints):
        sums[0, j] = sums[1, j] = 0.0
    for width in range(DEPTH):
        for j in range(joints):
            sums[0, j] += history[0, width, j]
            sums[1, j] += history[1, width, j]
        square = product = way = lift = steep = 0.0
        for r in range(joints):
            of_residual = of_increment = of_height = 0.0
            for c in range(joints):
                w = whiten[leg.context, width, r, c] * shrink[c]
                of_residual += w * sums[0, c]
                of_increment += w * sums[1, c]
                if upward:
                    of_height += w * gradient[c]
            square += of_residual * of_residual
            product += of_residual * of_increment
            way += of_increment * of_increment
            lift += of_residual * of_height
            steep += of_height * of_height
        if width == 0:
            distance = square
            leg.opposed = -product / math.sqrt(way) if way > 0.0 else 0.0
        if width + 1 > leg.usable:
            scores[width] = np.nan
        else:
            limit = noise.limits[direction_of(leg, width + 1), width]
            scores[width] = product * product / (way * limit) if product < 0.0 else 0.0
            if upward and lift > 0.0:
                scores[width] = max(scores[width], lift * lift / (steep * limit))
    return distance


@compiled
def strikes(leg, history, score):
    """Return whether a test ratio in a lift is of a foot that struck something.

    A foot that lets go late is off from its first ticks on; one that strikes fitted the model until
    then, and loses more of its predicted way than one that has become slow.  One that does so in
    the same tick as in the swing before does not move as its model says.  While it is not known
    when readings are of, nothing is a strike.
    """
    if leg.ticks * leg.period_ns < STRIKE_NS or leg.clock_left:
        return False
    way = along = 0.0
    for j in range(history.shape[2]):
        way += history[1, 0, j] ** 2
        along += history[0, 0, j] * history[1, 0, j]
    fitting = fitting_before(leg, leg.at_ns) >= MIN_LIFT_ROWS
    least = PRIOR_STRIKE if leg.from_prior else 1.0
    if not (fitting and -along > leg.strike_loss * way and score > least):
        return False
    if leg.struck == 0:
        leg.struck = leg.ticks
    return abs(leg.ticks - leg.struck_before) > 1


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


@compiled
def release(leg, t_ns, score):
    """End a contact, if there is one."""
    if not leg.contact:
        return
    leg.contact, leg.push = False, 0.0
    leg.found |= DECIDED
    leg.onset_ns = leg.calm_since if leg.calm else t_ns
    leg.score = score


@compiled
def swing_tick(leg, score, distance, onset_ns, past_top):
    """Update loaded, free or contact by a tick's test ratio; NaN changes nothing.

    Args:
        leg: its scalars.
        score: test ratio of the tick, the largest over the windows.
        distance: squared length of the last whitened residual over the threshold, for calm.
        onset_ns: of the contact, if it begins here.
        past_top: the descent has begun, after a lift that was seen: free even if not calm.
    """
    if score != score:
        return
    leg.calm = leg.calm + 1 if distance < CALM_SCORE else 0
    if leg.calm == 1:
        leg.calm_since = leg.at_ns
    if leg.loaded:
        if leg.calm < CALM_TICKS and not past_top:
            return
        leg.loaded = False
        release(leg, leg.at_ns, score)
        return
    if leg.contact:
        if leg.calm >= REARM_TICKS and leg.calm * leg.period_ns >= REARM_NS:
            release(leg, leg.at_ns, score)
        return
    if score <= 1.0:
        leg.doubtful_n = 0
        return
    if leg.doubtful_n == 0:
        leg.doubtful_ns = onset_ns
    leg.doubtful_n += 1
    if past_top and is_doubtful(leg, score):
        return
    leg.contact, leg.calm = True, 0
    leg.found |= DECIDED | TOUCHED
    leg.onset_ns, leg.score = max(leg.doubtful_ns, onset_ns - leg.lasting_ns), score
    leg.doubtful_n = 0
    leg.usual_n += 1
    step = max(leg.usual_n**-0.7, USUAL_STEP)
    first = leg.usual_n == 1
    leg.usual = score if first else leg.usual * math.exp(step if score > leg.usual else -step)


@compiled
def is_doubtful(leg, score):
    """Return whether a test ratio is too small for a touch of this leg, and may not last.

    The threshold says how rare free motion is there, and nothing of what a touch is like.  A body
    that another foot's touch shakes passes it, too.  A leg that carries nothing is not shaken.
    """
    if leg.usual_n < USUAL_CONTACTS or (leg.has_lengths and not leg.carried):
        return False
    share = leg.shaken_share if leg.after or leg.from_prior else leg.weak_share
    return score < share * leg.usual and leg.doubtful_n * leg.period_ns < leg.lasting_ns


@compiled
def let_go(leg):
    """Reset the contact state to unknown."""
    leg.release_pending |= leg.reported
    leg.contact, leg.loaded, leg.calm = False, True, 0
    leg.doubtful_n = 0


@compiled
def begin_labels(leg):
    """Begin the rows of a swing: none is held back."""
    leg.hole_ns = -1
    leg.lift_n = leg.row_n = leg.commanded_n = 0
    leg.topped = leg.closed = leg.broken = leg.top_seen = False
    leg.fit_n = leg.fit_before = 0
    leg.push = 0.0
    leg.doubtful_n = 0
    leg.struck_before, leg.struck = leg.struck, 0


@compiled
def fitting_before(leg, onset_ns):
    """Count the ticks in a row that fit the model up to shortly before an onset."""
    if leg.misfit_ns < onset_ns - STRIKE_TICKS * leg.period_ns:
        return leg.fit_n
    return max(leg.fit_n, leg.fit_before)


@compiled
def count_fitting_ticks(leg, level):
    """Count ticks in a row that fit the model; ``level`` is a tick's NIS."""
    if level <= UNFIT_LEVEL:
        leg.fit_n += 1
    elif leg.fit_n:
        leg.fit_before, leg.fit_n, leg.misfit_ns = fitting_before(leg, leg.at_ns), 0, leg.at_ns


@compiled
def assess_fit_before_contact(leg):
    """Assess whether the ticks before a contact fit the model, where the foot came some way.

    A foot that stops against something after it has moved as predicted is not one whose readings
    are frozen or turned around, or which was held from the start.  One that strikes a step soon
    after it began to lift has not come far.
    """
    fit, struck = leg.fit_n, fitting_before(leg, leg.onset_ns)
    if not fit and leg.misfit_ns >= leg.onset_ns - leg.period_ns:
        fit = leg.fit_before
    leg.fits |= fit >= MIN_LIFT_ROWS and leg.moved > LEAST_WAY_M * leg.leg_size
    leg.fits |= struck >= STRIKE_ROWS and leg.moved > STRIKE_WAY_M * leg.leg_size


@compiled
def record_hole(leg, rows):
    """Record the time of lost or bad readings: their ticks have no residuals."""
    if leg.row_n > leg.lift_n:
        leg.hole_ns = rows[leg.row_n - 1].t_ns


@compiled
def add_push(leg):
    """Add up the push of a tick: what no window shows, but lasts (Page's cumulative sum)."""
    before = leg.push
    leg.push = max(before + min(leg.opposed, MOST_PUSH) - FREE_PUSH, 0.0)
    if before == 0.0:
        leg.push_ns = leg.at_ns


@compiled
def push_ratio(leg):
    """Return the sum of pushes over that of a contact; 0 unless touches of the leg are known.

    A leg that never touched may be in a motion that its model does not know.
    """
    return leg.push / leg.touch_push if leg.usual_n >= USUAL_CONTACTS else 0.0


@compiled
def drop_pushed_rows(leg, rows):
    """Drop the held rows from the onset of a push that lasts, or is doubtful and may last.

    What is not learned of a descent is cheap; a touch that is learned hides the next one.
    """
    if leg.push <= SURE_PUSH and not leg.doubtful_n:
        return
    last_ns = leg.push_ns - GUARD_TICKS * leg.period_ns
    while leg.row_n > leg.lift_n and rows[leg.row_n - 1].t_ns > last_ns:
        leg.row_n -= 1
    leg.closed = True


@compiled
def break_off(leg):
    """End the swing without learning it: the next sample does not connect."""
    leg.found |= BROKE_OFF
    leg.whole = leg.stood = False
    begin_labels(leg)
    leg.broken, leg.struck_before = True, 0


@compiled
def push_from_ground(leg, row, aside, residual, target, whiten, unit, gradient):
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
def may_stick(leg, swing):
    """Return whether the foot has hardly begun to come down, of a leg that learns its friction.

    Joints that turn round stick, and a prior does not know how much.
    """
    learns = leg.from_prior and leg.has_lengths
    return learns and swing.foot[2] > leg.top - TOP_SHARE * leg.rise


@compiled
def is_high(leg, swing):
    """Return whether the foot is too high for ground, of a leg that has to learn all its motion.

    A leg with a baseline gains nothing by these rows.
    """
    return (
        leg.from_prior
        and leg.has_lengths
        and swing.foot[2] - swing.start[2] > HIGH_SHARE * leg.rise > 0.0
    )


@stage
def enter_row(leg, swing, past, noise, kept, was_free, past_lift, air):
    """Hold a judged tick back until its swing is resolved.

    Args:
        leg: its scalars.
        swing: its arrays, as those that follow.
        past: what was predicted.
        noise: what residuals are weighed by.
        kept: where the row goes; one of ``row_values`` is as
            :class:`~adaptive_contact.model.labelled_swing.Rows` has it.
        was_free: the leg had been free before this tick, and does not touch.
        past_lift: the command is past the lift.
        air: the leg hangs.
    """
    rows, values, theta, history = kept.rows, kept.row_values, past.thetas[0], past.history
    target = kept.target
    joints = history.shape[2]
    leg.found |= WEIGHED
    if leg.broken or not (leg.topped or leg.rising or past_lift):
        return
    if leg.rising and not leg.topped:
        if leg.closed or not (was_free or air or leg.ticks >= FREE_LIFT_TICKS):
            return
    elif leg.closed:
        leg.topped = True
        return
    at = leg.row_n
    first, most = (
        (0, leg.lift_n) if leg.rising and not leg.topped else (leg.lift_n, at - leg.lift_n)
    )
    if most >= MAX_ROWS:  # the oldest goes
        for k in range(first, at - 1):
            rows[k] = rows[k + 1]
            copy_vector(values[k + 1], values[k])
        at -= 1
        if first == 0:
            leg.lift_n -= 1
            leg.commanded_n = max(leg.commanded_n - 1, 0)
    row = rows[at]
    row.nis = leg.squared * leg.variance_scale / joints
    scores = noise.scores
    row.value, row.ratio = scores[0] * noise.limits[direction_of(leg, 1), 0], scores[0]
    for width in range(1, DEPTH):
        if scores[width] > row.ratio:
            row.ratio = scores[width]
    row.context = leg.context
    row.t_ns = leg.at_ns
    row.high, row.after = is_high(leg, swing), leg.after > 0
    row.was_free, row.cleared, row.push, row.repeats = was_free, leg.cleared, False, leg.repeats
    terms = len(theta)
    for k in range(terms):
        values[at, k] = theta[k]
    for j in range(joints):
        target[j] = history[0, 0, j] + history[1, 0, j]
        values[at, terms + j] = target[j]
    if leg.changed and not leg.rising and leg.has_lengths and leg.has_measured:
        height_gradient(swing.last_measured, swing.links, swing.axis_kinds, swing.gradient)
        aside = values[at, terms + joints :]
        push_from_ground(
            leg, row, aside, history[0, 0], target, noise.whiten, noise.unit, swing.gradient
        )
    leg.row_n = at + 1
    if leg.rising and not leg.topped:
        row.lift = True
        leg.lift_n = at + 1
        if not past_lift:
            leg.commanded_n = leg.lift_n
        return
    leg.topped = True
    row.lift = False
